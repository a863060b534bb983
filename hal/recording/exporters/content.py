"""What an episode holds, taken apart: arms, numbers, pictures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import CommandError, DeviceNotFound
from ...images import Cropping
from ..columns import STATE
from ..reader import Episode

__all__ = ["Arm", "EpisodeContent", "Pictures"]

_ARM_TIME = "observation.time.robot."
_OBJECT = "observation.object."
_HAND = "gripper"


class Arm(NamedTuple):
    """One arm of the rig, and what its numbers are called in columns that all arms share."""

    name: str
    lead: str
    """Before each name; empty where there is only one arm."""

    def owns(self, name: str) -> bool:
        """Is this number of a shared column the arm's?"""
        return name.startswith(self.lead)


@dataclass(frozen=True)
class Pictures:
    """One stream of pictures, one per row."""

    camera: str
    what: str
    """``rgb`` or ``depth``."""
    shape: tuple[int, ...]
    """(H, W, 3) or (H, W)."""
    dtype: np.dtype[Any]
    rows: int
    read: Callable[[], Iterator[NDArray[Any]]]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Return every picture. DatasetError where there is not one per row."""
        return self.read()


class EpisodeContent:
    """One episode, with the cameras that are taken along, their pictures of ``size`` (width, height).

    CommandError for a camera that it does not have.
    """

    def __init__(
        self,
        episode: Episode,
        cameras: Collection[str] | None = None,
        *,
        depth: bool = True,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.episode = episode
        self.rows = episode.length
        self._size = size
        if unknown := [name for name in cameras or () if name not in episode.cameras]:
            there = ", ".join(episode.cameras) or "none"
            raise CommandError(f"episode {episode.number} has no camera {unknown[0]}; cameras: {there}")
        self.cameras = tuple(name for name in episode.cameras if cameras is None or name in cameras)
        self._depth = depth

    # Numbers.

    @cached_property
    def arms(self) -> tuple[Arm, ...]:
        """The rig's arms, in its order."""
        names = [key.removeprefix(_ARM_TIME) for key in self.episode.columns if key.startswith(_ARM_TIME)]
        return tuple(Arm(name, f"{name}." if len(names) > 1 else "") for name in names)

    def of(self, arm: Arm, key: str) -> NDArray[Any]:
        """The arm's part (rows, n) of a column; without the gripper, where that is in it."""
        names = self.episode.names(key)
        wanted = [k for k, name in enumerate(names) if arm.owns(name) and name != arm.lead + _HAND]
        found: NDArray[Any] = self._table(key)[:, wanted]
        return found

    def _table(self, key: str) -> NDArray[Any]:
        """A column (rows, n), also where n is 1."""
        return self.episode.columns[key].reshape(self.rows, -1)

    def joints(self, arm: Arm) -> list[str]:
        """Names of its joints."""
        return [name.removeprefix(arm.lead) for name in self.episode.names(STATE) if self._is_joint(arm, name)]

    @staticmethod
    def _is_joint(arm: Arm, name: str) -> bool:
        return arm.owns(name) and name != arm.lead + _HAND

    def width(self, arm: Arm, key: str = STATE) -> NDArray[Any] | None:
        """Width (rows,) of its gripper, m; None where it has none."""
        names = self.episode.names(key)
        if arm.lead + _HAND not in names:
            return None
        found: NDArray[Any] = self._table(key)[:, names.index(arm.lead + _HAND)]
        return found

    def has(self, key: str) -> bool:
        """Is there such a column?"""
        return key in self.episode.columns

    @property
    def objects(self) -> dict[str, NDArray[Any]]:
        """Poses (rows, 7) in the world of what can move in a simulated one."""
        columns = self.episode.columns
        return {key.removeprefix(_OBJECT): column for key, column in columns.items() if key.startswith(_OBJECT)}

    @property
    def grid(self) -> NDArray[np.float64]:
        """Times (rows,) at which the rows were due, from the first one on, s."""
        times = self.episode.stamps["grid"]
        found: NDArray[np.float64] = times - times[0]
        return found

    # Pictures.

    @cached_property
    def pictures(self) -> tuple[Pictures, ...]:
        """Every stream of pictures that is taken along."""
        found = []
        for camera in self.cameras:
            for what in ("rgb", "depth") if self._depth else ("rgb",):
                if (stream := self._stream(camera, what)) is not None:
                    found.append(stream)
        return tuple(found)

    def _stream(self, camera: str, what: str) -> Pictures | None:
        episode = self.episode

        def plain() -> Iterator[NDArray[Any]]:
            return episode.frames(camera) if what == "rgb" else episode.depth(camera)

        try:
            first = next(plain())
        except DeviceNotFound:  # this one was not kept
            return None
        scaling = self._scaling(first.shape[1], first.shape[0])
        if scaling is None:
            return Pictures(camera, what, first.shape, first.dtype, self.rows, plain)
        scaled = scaling.color if what == "rgb" else scaling.depth
        shape = (*reversed(scaling.size), *first.shape[2:])
        return Pictures(camera, what, shape, first.dtype, self.rows, lambda: map(scaled, plain()))

    def _scaling(self, width: int, height: int) -> Cropping | None:
        return None if self._size is None else Cropping(width, height, *self._size)

    def lenses(self) -> dict[str, dict[str, Any]]:
        """Of each camera: size, and matrix and distortion of its pictures as they are written."""
        found: dict[str, dict[str, Any]] = {}
        for stream in self.pictures:
            if stream.camera in found:
                continue
            known = self.episode.info["cameras"][stream.camera]
            width, height = self._recorded_size(stream.camera)
            K = np.array(known["K"], np.float64)
            scaling = self._scaling(width, height)
            found[stream.camera] = {
                "width": stream.shape[1],
                "height": stream.shape[0],
                "K": (K if scaling is None else scaling.matrix(K)).tolist(),
                "distortion": known["distortion"],
            }
        return found

    def _recorded_size(self, camera: str) -> tuple[int, int]:
        try:
            first: NDArray[Any] = next(self.episode.frames(camera))
        except DeviceNotFound:  # only depth was kept
            first = next(self.episode.depth(camera))
        return first.shape[1], first.shape[0]

    def about(self) -> dict[str, Any]:
        """What a form says of the episode beside its rows, in few words."""
        episode = self.episode
        return {
            "episode": episode.number,
            "rows": self.rows,
            "fps": episode.fps,
            "task": episode.task,
            "success": episode.success,
            "seed": episode.info.get("seed"),
            "started": episode.info.get("started"),
        }
