"""Write a folder with one ``.npz`` per episode: plain arrays that ``numpy.load`` reads without pickle.

The names are those of the tutorial that many users start from. Every column of the dataset is there too, under its own
key, so that no number is lost.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CommandError
from ..layout import STATE
from .content import EpisodeContent, camera_roles
from .output import ExportJob

_ABOUT = "export.json"
_LEVEL = 1  # higher levels take far longer and save little


def is_export(path: Path) -> bool:
    """Return whether this folder was written here."""
    return path.is_dir() and (path / _ABOUT).is_file()


def write(job: ExportJob, path: Path) -> None:
    """Write the folder."""
    path.mkdir()
    files = []
    for content in job.episodes():
        name = f"episode_{content.episode.number:06d}.npz"
        _write_episode(job, content, path / name)
        files.append({"file": name, **content.about()})
    about = job.about() | {
        "camera_names": camera_roles(job.contents[0], job.camera, job.gripper_camera),
        "episodes": files,
    }
    (path / _ABOUT).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


def _write_episode(job: ExportJob, content: EpisodeContent, path: Path) -> None:
    numbers = _numbers(job, content)
    job.unknown(content, {name: numbers[name] for name in ("joint_states", "action") if name in numbers})
    called = camera_roles(content, job.camera, job.gripper_camera)
    texts: dict[str, str | list[str]] = {
        "info": json.dumps(content.episode.info | {"cameras_written": content.lenses()})
    }
    texts["observation.state.names"] = content.episode.names(STATE)
    texts["action.names"] = job.action.names(content)
    for camera, name in called.items():
        if f"camera.{camera}" in content.episode.stamps:
            numbers[f"{name}_stamps"] = content.episode.stamps[f"camera.{camera}"]
    streams = {f"{called[stream.camera]}_{stream.what}": stream for stream in content.pictures}
    if double := sorted(set(streams) & set(numbers)):
        raise CommandError(
            f"two arrays would be called {double[0]}; choose with --camera and --gripper-camera", code="duplicate_name"
        )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as file:
        for name, values in (numbers | {name: np.array(text) for name, text in texts.items()}).items():
            _add(file, name, values.shape, values.dtype, iter([values]))
        for name, stream in streams.items():
            _add(file, name, (stream.rows, *stream.shape), stream.dtype, iter(stream))


def _numbers(job: ExportJob, content: EpisodeContent) -> dict[str, NDArray[Any]]:
    episode = content.episode
    found: dict[str, NDArray[Any]] = {}
    for arm in content.arms:
        lead = f"{arm.name}_" if len(content.arms) > 1 else ""
        found[lead + "joint_states"] = content.of(arm, "observation.state")
        pose = content.of(arm, "observation.tcp")
        found[lead + "eef_position"], found[lead + "eef_orientation"] = pose[:, :3], pose[:, 3:]
        if (width := content.width(arm)) is not None:
            found[lead + "gripper"] = width
    found["action"] = job.action.values(content)
    found["stamps"] = episode.stamps["grid"]
    return found | {key: values for key, values in episode.columns.items() if key not in found}


def _add(
    file: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], parts: Iterator[NDArray[Any]]
) -> None:
    """Write one array part by part: an episode's pictures need not fit into memory."""
    head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
        np.lib.format.write_array_header_1_0(entry, head)
        for part in parts:
            entry.write(np.ascontiguousarray(part, dtype).data)
