"""Write one HDF5 file for robomimic: a group per episode, and lists of episodes for training and validation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import import_library
from .actions import action_dict
from .content import EpisodeContent, PictureStream, add_channel, picture_name
from .output import ExportJob

_GYM = 2
"""robomimic's number of a Gymnasium environment, the only kind that needs none of its simulators."""
_MAGIC = b"\x89HDF\r\n\x1a\n"


def is_export(path: Path) -> bool:
    """Return whether this is an HDF5 file."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def write(job: ExportJob, path: Path) -> None:
    """Write the file. Raises DriverMissing without h5py."""
    h5py = import_library("h5py", "an export for robomimic", "robot-hal[export]")
    with h5py.File(path, "w") as file:  # in HDF5's oldest version, which every library reads
        data = file.create_group("data")
        for k, content in enumerate(job.episodes()):
            _write_episode(job, content, data.create_group(f"demo_{k}"), h5py)
        data.attrs["total"] = sum(content.rows for content in job.contents)
        about = job.about()  # there is no environment for a rig, and training needs none
        kind = {"env_name": about["robot_type"] or "rig", "type": _GYM, "env_kwargs": {"fps": about["fps"]}}
        data.attrs["env_args"], data.attrs["about"] = json.dumps(kind), json.dumps(about)
        for name, demos in _filters(job).items():
            file[f"mask/{name}"] = np.array([f"demo_{k}" for k in demos], dtype="S")


def _write_episode(job: ExportJob, content: EpisodeContent, group: Any, h5py: Any) -> None:
    actions = job.action.values(content)
    seen = job.observations(content)
    forms = {f"action_dict/{name}": values for name, values in action_dict(content).items()}
    job.unknown(content, seen | {"actions": actions} | forms)
    last = np.zeros(content.rows)
    last[-1] = 1.0
    group["actions"] = actions
    for name, values in forms.items():
        group[name] = values
    group["dones"] = last
    group["rewards"] = last * bool(content.episode.success)
    group.attrs["num_samples"] = content.rows
    group.attrs["info"] = json.dumps(content.about())
    for name, values in seen.items():
        group[f"obs/{name}"] = values
        group[f"next_obs/{name}"] = np.concatenate([values[1:], values[-1:]])
    for stream in content.pictures:
        _write_pictures(stream, group, h5py)


def _write_pictures(stream: PictureStream, group: Any, h5py: Any) -> None:
    name = picture_name(stream)
    shape = stream.shape if len(stream.shape) == 3 else (*stream.shape, 1)
    pictures = group["obs"].create_dataset(
        name,
        (stream.rows, *shape),
        stream.dtype,
        chunks=(1, *shape),  # training reads pictures in random order
        compression="gzip",
        compression_opts=1,
        shuffle=stream.dtype.itemsize > 1,
    )
    for k, picture in enumerate(stream):
        pictures[k] = add_channel(picture)
    # The next picture is already in the file, one row further: a view of it instead of a copy.
    view = h5py.VirtualLayout(pictures.shape, pictures.dtype)
    source = h5py.VirtualSource(".", pictures.name, shape=pictures.shape, dtype=pictures.dtype)
    if stream.rows > 1:
        view[:-1] = source[1:]
    view[stream.rows - 1 :] = source[stream.rows - 1 :]
    group["next_obs"].create_virtual_dataset(name, view)


def _filters(job: ExportJob) -> dict[str, list[int]]:
    """Return the episodes of each filter, by name. The same episodes are split in the same way every time."""
    count = len(job.contents)
    order: NDArray[np.int64] = np.random.default_rng(count).permutation(count)
    held = min(max(1, round(job.valid * count)), count - 1) if job.valid > 0.0 else 0
    found = {"train": sorted(order[held:].tolist()), "valid": sorted(order[:held].tolist())}
    found["successful"] = [k for k, content in enumerate(job.contents) if content.episode.success]
    if job.valid > 0.0 and held == 0:
        job.notes.append("one episode cannot be split: the filter valid is missing")
    return {name: demos for name, demos in found.items() if demos}
