"""One HDF5 file as robomimic reads it: a group per episode, and lists of episodes to train and to validate with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DriverMissing
from ..layout import ACTION
from .content import EpisodeContent, Pictures, observations, picture_name, with_channel
from .output import Job

__all__ = ["is_one", "write"]

_GYM = 2
"""robomimic's number of a Gymnasium environment: of its kinds the one that needs no simulator of theirs."""
_MAGIC = b"\x89HDF\r\n\x1a\n"


def is_one(path: Path) -> bool:
    """Is this an HDF5 file?"""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def write(job: Job, path: Path) -> None:
    """Make the file. DriverMissing."""
    h5py = _library()
    with h5py.File(path, "w") as file:  # in HDF5's oldest form: the newest one is read by the newest library only
        data = file.create_group("data")
        for k, content in enumerate(job.contents):
            _write_episode(job, content, data.create_group(f"demo_{k}"), h5py)
        data.attrs["total"] = sum(content.rows for content in job.contents)
        data.attrs["env_args"] = json.dumps(_environment(job))
        data.attrs["about"] = json.dumps(job.about())
        for name, demos in _filters(job).items():
            file[f"mask/{name}"] = np.array([f"demo_{k}" for k in demos], dtype="S")


def _library() -> Any:
    try:
        import h5py
    except ImportError:
        raise DriverMissing(
            "an export for robomimic needs h5py; install with: pip install 'robot-hal[export]'", name="h5py"
        ) from None
    return h5py


def _write_episode(job: Job, content: EpisodeContent, group: Any, h5py: Any) -> None:
    actions = content.episode.columns[ACTION]
    seen = observations(content)
    job.unknown(content, seen | {"actions": actions})
    last = np.zeros(content.rows)
    last[-1] = 1.0
    group["actions"] = actions
    group["dones"] = last
    group["rewards"] = last * bool(content.episode.success)
    group.attrs["num_samples"] = content.rows
    group.attrs["info"] = json.dumps(content.about())
    for name, values in seen.items():
        group[f"obs/{name}"] = values
        group[f"next_obs/{name}"] = np.concatenate([values[1:], values[-1:]])
    job.numbers_done(content)
    for stream in content.pictures:
        _write_pictures(job, content, stream, group, h5py)


def _write_pictures(job: Job, content: EpisodeContent, stream: Pictures, group: Any, h5py: Any) -> None:
    name = picture_name(stream)
    shape = stream.shape if len(stream.shape) == 3 else (*stream.shape, 1)
    pictures = group["obs"].create_dataset(
        name,
        (stream.rows, *shape),
        stream.dtype,
        chunks=(1, *shape),  # a batch takes pictures from everywhere
        compression="gzip",
        compression_opts=1,
        shuffle=stream.dtype.itemsize > 1,
    )
    for k, picture in enumerate(job.pictures(content, stream)):
        pictures[k] = with_channel(picture)
    # The next picture is already there, a row further on: a view of it instead of a copy.
    view = h5py.VirtualLayout(pictures.shape, pictures.dtype)
    source = h5py.VirtualSource(".", pictures.name, shape=pictures.shape, dtype=pictures.dtype)
    if stream.rows > 1:
        view[:-1] = source[1:]
    view[stream.rows - 1 :] = source[stream.rows - 1 :]
    group["next_obs"].create_virtual_dataset(name, view)


def _environment(job: Job) -> dict[str, Any]:
    """What robomimic would make an environment from. It has none for a rig, and needs none to train."""
    about = job.about()
    return {"env_name": about["robot_type"] or "rig", "type": _GYM, "env_kwargs": {"fps": about["fps"]}}


def _filters(job: Job) -> dict[str, list[int]]:
    """Lists of episodes by the names of their filters. The same episodes are split in the same way every time."""
    count = len(job.contents)
    order: NDArray[np.int64] = np.random.default_rng(count).permutation(count)
    held = min(max(1, round(job.valid * count)), count - 1) if job.valid > 0.0 else 0
    found = {"train": sorted(order[held:].tolist()), "valid": sorted(order[:held].tolist())}
    found["successful"] = [k for k, content in enumerate(job.contents) if content.episode.success]
    if job.valid > 0.0 and held == 0:
        job.notes.append("one episode cannot be split: there is no filter valid")
    return {name: demos for name, demos in found.items() if demos}
