"""Export recordings to the formats that other programs train on.

    from hal.recording.exporters import export

    made = export("data/demo", "zarr", "data/demo.zarr", size=(96, 96), successful_only=True)
    print(made.path, made.episodes, made.rows, *made.notes)

LeRobot reads a recording without any export (docs/export.md).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from ...arguments import choice
from ...errors import CommandError
from ..dataset import Dataset
from ..layout import count_bytes
from .actions import ActionForm, ActionKind, RotationForm
from .content import EpisodeContent, select_episodes
from .output import ExportJob, write_atomically

__all__ = ["KINDS", "ExportResult", "default_path", "export"]


KINDS = {"robomimic": ("robomimic", ".robomimic.hdf5"), "zarr": ("diffusion_policy", ".zarr"), "npz": ("npz", "_npz")}
"""Kind of export -> the module that writes it, and what is appended to the dataset's name for the default path.

A module has ``write(job, path)``, and ``is_export(path)``, which recognises what it wrote before.
"""


class ExportResult(NamedTuple):
    """The result of an export."""

    path: Path
    episodes: int
    rows: int
    size: int
    """Size on the disk, bytes."""
    notes: tuple[str, ...]
    """Warnings to read before training on it."""


def default_path(dataset: str | Path, kind: str) -> Path:
    """Return the default path of an export: beside the dataset."""
    folder = Path(dataset).expanduser().absolute()
    return folder.with_name(folder.name + KINDS[kind][1])


def export(
    dataset: Dataset | str | Path,
    kind: str,
    out: str | Path | None = None,
    *,
    episodes: str | Collection[int] | None = None,
    successful_only: bool = False,
    cameras: Collection[str] | None = None,
    depth: bool = True,
    size: tuple[int, int] | None = None,
    camera: str | None = None,
    gripper_camera: str | None = None,
    valid: float = 0.1,
    action: ActionKind = "joint_position",
    rotation: RotationForm | None = None,
    force: bool = False,
    on_episode: Callable[[int, int], object] = lambda done, total: None,
) -> ExportResult:
    """Write episodes of a dataset in another format. The output appears only when complete.

    Args:
        dataset: The dataset, or its folder.
        kind: A key of :data:`KINDS`.
        out: File or folder to write; None for :func:`default_path`.
        episodes: Numbers, or a text such as ``0,3-5``; None for all.
        successful_only: Leave out episodes that are not marked a success.
        cameras: Names of the cameras to export; None for all.
        depth: False leaves depth out.
        size: Width and height; pictures are cropped about their centre to that shape, and scaled.
        camera: Camera that ``npz`` calls ``camera``.
        gripper_camera: Camera that ``npz`` calls ``gripper_camera``.
        valid: Share of the episodes in robomimic's filter ``valid``, at least 0 and below 1.
        action: What an action is: ``joint_position``, ``joint_velocity``, ``tcp_pose`` or ``tcp_delta``; see
            :class:`~hal.recording.exporters.actions.ActionForm`.
        rotation: Rotation of ``tcp_pose`` and ``tcp_delta``: ``quaternion`` (if None), ``axis_angle``, ``rotation_6d``.
        force: Overwrite an existing export; other files are never overwritten.
        on_episode: Called with the number of written episodes and of all, after each.

    Raises:
        CommandError: An argument is wrong, the episodes differ, or something exists at ``out`` (codes ``bad_export``,
            ``no_episodes``, ``episodes_differ``, ``exists``).
        DatasetError: The dataset is damaged.
        DriverMissing: A library is not installed.
        OSError: The disk refuses.
    """
    choice("kind", kind, KINDS, "bad_export")
    if not 0.0 <= valid < 1.0:
        raise CommandError(f"valid must be at least 0 and below 1, not {valid:g}", code="bad_export")
    if size is not None and not all(1 <= side <= 8192 for side in size):
        raise CommandError(f"size must be from 1x1 to 8192x8192, not {size[0]}x{size[1]}", code="bad_export")
    form = ActionForm(action, rotation).checked()
    source = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
    wanted = select_episodes(source, episodes, successful_only=successful_only)
    job = ExportJob(
        source=source.root,
        contents=tuple(EpisodeContent(episode, cameras, depth=depth, size=size) for episode in wanted),
        camera=camera,
        gripper_camera=gripper_camera,
        valid=valid,
        action=form,
        on_episode=on_episode,
        notes=list(source.notes),
    )
    job.check()
    if early := [str(episode.number) for episode in wanted if episode.trouble]:
        job.notes.append(f"recordings that ended by themselves, perhaps before the task: {', '.join(early)}")
    writer = import_module(f".{KINDS[kind][0]}", __name__)
    path = default_path(source.root, kind) if out is None else Path(out).expanduser().absolute()
    with write_atomically(path, force=force, is_ours=writer.is_export) as beside:
        writer.write(job, beside)
    rows = sum(content.rows for content in job.contents)
    return ExportResult(path, len(job.contents), rows, count_bytes(path), tuple(job.notes))
