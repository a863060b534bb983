"""Recordings in the forms that other programs train on.

    from hal.recording.exporters import export

    made = export("data/demo", "zarr", "data/demo.zarr", size=(96, 96), successful_only=True)
    print(made.path, made.episodes, made.rows, *made.notes)

LeRobot needs none of this: it reads a recording as it is (docs/export.md).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from ...errors import CommandError
from ..dataset import Dataset
from .content import EpisodeContent, chosen
from .output import Job, Progress, fresh

__all__ = ["KINDS", "Exported", "Kind", "Progress", "default_path", "export"]


class Kind(NamedTuple):
    """A form, and the module that writes it: ``write(job, path)``, and ``is_one(path)`` knows what it wrote before."""

    module: str
    ending: str
    """Of the name that it gets beside the dataset."""
    what: str


KINDS = {
    "robomimic": Kind("robomimic", ".robomimic.hdf5", "one HDF5 file as robomimic reads it"),
    "zarr": Kind("diffusion_policy", ".zarr", "a zarr folder as diffusion policy's replay buffer reads it"),
    "npz": Kind("npz", "_npz", "a folder with one .npz per episode"),
}


class Exported(NamedTuple):
    """What was made."""

    path: Path
    episodes: int
    rows: int
    size: int
    """Bytes on the disk."""
    notes: tuple[str, ...]
    """What a person should know before training on it."""


def default_path(dataset: str | Path, kind: str) -> Path:
    """Where a form goes unless told otherwise: beside the dataset."""
    folder = Path(dataset).expanduser().absolute()
    return folder.with_name(folder.name + KINDS[kind].ending)


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
    force: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Exported:
    """Write episodes of ``dataset`` as ``kind`` (a key of :data:`KINDS`) to ``out``.

    ``episodes`` are numbers, or a text such as ``0,3-5``; ``successful_only`` leaves out what was not marked a success.
    ``cameras`` are the names of those that are taken along, else all. ``size`` (width, height) crops pictures to that
    shape about their middle and scales them. ``camera`` and ``gripper_camera`` say which cameras an ``.npz`` calls so;
    ``valid`` is the share of episodes that robomimic's filter ``valid`` names. What is there is only overwritten with
    ``force``, and only where it is such an export.

    Whole or not at all: it is written under another name and renamed at the end. Raises CommandError for what does not
    fit, DriverMissing, OSError.
    """
    if kind not in KINDS:
        raise CommandError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if not 0.0 <= valid < 1.0:
        raise CommandError(f"valid must be at least 0 and below 1, not {valid:g}")
    if size is not None and not all(1 <= side <= 8192 for side in size):
        raise CommandError(f"size must be from 1x1 to 8192x8192, not {size[0]}x{size[1]}")
    source = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
    wanted = chosen(source, episodes, successful_only=successful_only)
    job = Job(
        source=source.root,
        contents=tuple(EpisodeContent(episode, cameras, depth=depth, size=size) for episode in wanted),
        camera=camera,
        gripper_camera=gripper_camera,
        valid=valid,
        report=progress,
    )
    job.check()
    writer = import_module(f".{KINDS[kind].module}", __name__)
    path = default_path(source.root, kind) if out is None else Path(out).expanduser().absolute()
    with fresh(path, force=force, is_ours=writer.is_one) as beside:
        writer.write(job, beside)
    rows = sum(content.rows for content in job.contents)
    return Exported(path, len(job.contents), rows, _bytes(path), tuple(job.notes))


def _bytes(path: Path) -> int:
    files = [path] if path.is_file() else path.rglob("*")
    return sum(file.stat().st_size for file in files if file.is_file())
