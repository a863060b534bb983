"""Content of an episode for exports and reviews: its arms, columns and pictures, and which episodes are selected."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import CommandError
from ...images import Cropping
from ...types import STREAMS
from ..changing import existing_episodes
from ..dataset import Dataset, Episode
from ..layout import GRIP_FORCE, STATE, TAU_EXT, WRENCH_EXT

_PART = re.compile(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?")


def parse_episodes(text: str) -> list[int]:
    """Return the numbers in a text such as ``0,3-5``. Raises CommandError for anything else (code ``bad_episodes``)."""
    found: list[int] = []
    for part in text.split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise CommandError(f"episodes are numbers and ranges such as 0,3-5, not {text!r}", code="bad_episodes")
        first = int(match[1])
        last = first if match[2] is None else int(match[2])
        if last < first or last - first > 1_000_000:
            raise CommandError(f"{part.strip()} is not a range of episodes", code="bad_episodes")
        found.extend(range(first, last + 1))
    return found


def select_episodes(
    dataset: Dataset, wanted: str | Collection[int] | None, *, successful_only: bool
) -> tuple[Episode, ...]:
    """Return the selected episodes (numbers, or a text such as ``0,3-5``), each once, in the dataset's order.

    Raises:
        CommandError: There is no such episode, or none is left (code ``no_episodes``).
    """
    numbers = range(len(dataset)) if wanted is None else wanted
    chosen = existing_episodes(dataset, parse_episodes(numbers) if isinstance(numbers, str) else numbers)
    found = [dataset.episodes[number] for number in sorted(chosen)]
    found = [episode for episode in found if not successful_only or episode.success]
    if not found:
        raise CommandError("none of these episodes is marked a success", code="no_episodes")
    return tuple(found)


_ARM_TIME = "rig.time.robot."
_OBJECT = "rig.object."
_GRIPPER = "gripper"


class ArmColumns(NamedTuple):
    """One arm of a recording, and how its numbers are named in columns that all arms share."""

    name: str
    lead: str
    """Prefix of each name; empty if there is only one arm."""

    def owns(self, name: str) -> bool:
        """Return whether this number of a shared column is the arm's, and not its gripper's."""
        return name.startswith(self.lead) and name != self.lead + _GRIPPER


@dataclass(frozen=True)
class PictureStream:
    """One stream of pictures, one per row."""

    camera: str
    what: str
    """``rgb``, or another stream by its name."""
    shape: tuple[int, ...]
    """(H, W, 3) or (H, W)."""
    dtype: np.dtype[Any]
    rows: int
    read: Callable[[], Iterator[NDArray[Any]]]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Iterate over the pictures. Raises DatasetError if there is not one per row."""
        return self.read()


class EpisodeContent:
    """One episode, with the selected cameras; pictures are cropped and scaled to ``size``, width and height.

    Raises:
        CommandError: The episode lacks a camera (code ``no_such_camera``).
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
            raise CommandError(
                f"episode {episode.number} has no camera {unknown[0]}; cameras: {there}", code="no_such_camera"
            )
        self.cameras = tuple(name for name in episode.cameras if cameras is None or name in cameras)
        self._depth = depth

    @cached_property
    def arms(self) -> tuple[ArmColumns, ...]:
        """The arms, in the order of the columns."""
        names = [key.removeprefix(_ARM_TIME) for key in self.episode.columns if key.startswith(_ARM_TIME)]
        if not names and self.has(STATE):  # another program removed the times
            leads = [name.rpartition(".")[0] for name in self.episode.names(STATE)]
            one = str(self.episode.info.get("robot_type") or "arm")
            names = list(dict.fromkeys(leads)) if all(leads) else [one]
        return tuple(ArmColumns(name, f"{name}." if len(names) > 1 else "") for name in names)

    def of(self, arm: ArmColumns, key: str) -> NDArray[Any]:
        """Return the arm's part (rows, n) of a column, without its gripper."""
        wanted = [k for k, name in enumerate(self.episode.names(key)) if arm.owns(name)]
        return self._table(key)[:, wanted]

    def _table(self, key: str) -> NDArray[Any]:
        """Return a column (rows, n), also if n is 1."""
        return self.episode.columns[key].reshape(self.rows, -1)

    def joints(self, arm: ArmColumns) -> list[str]:
        """Return the names of the arm's joints."""
        return [name.removeprefix(arm.lead) for name in self.episode.names(STATE) if arm.owns(name)]

    def width(self, arm: ArmColumns, key: str = STATE) -> NDArray[Any] | None:
        """Return the width (rows,) of the arm's gripper, m; None without one."""
        names = self.episode.names(key)
        if arm.lead + _GRIPPER not in names:
            return None
        return self._table(key)[:, names.index(arm.lead + _GRIPPER)]

    def later_force(self, arm: ArmColumns) -> NDArray[Any] | None:
        """Return the force (rows,) that is asked of the arm's gripper one row later, N; None if it is not recorded."""
        force = self.width(arm, GRIP_FORCE) if self.has(GRIP_FORCE) else None
        return None if force is None else np.append(force[1:], force[-1:])

    def has(self, key: str) -> bool:
        """Return whether the episode has a column."""
        return key in self.episode.columns

    @property
    def objects(self) -> dict[str, NDArray[Any]]:
        """Poses (rows, 7) in the world of the simulated objects that can move, by name."""
        columns = self.episode.columns
        return {key.removeprefix(_OBJECT): column for key, column in columns.items() if key.startswith(_OBJECT)}

    @property
    def grid(self) -> NDArray[np.float64]:
        """Due times (rows,) of the rows, since the first, s."""
        times = self.episode.stamps["grid"]
        found: NDArray[np.float64] = times - times[0]
        return found

    @cached_property
    def pictures(self) -> tuple[PictureStream, ...]:
        """Every selected stream of pictures."""
        return tuple(
            self._stream(camera, stream)
            for camera in self.cameras
            for stream in self.episode.files(camera)
            if self._depth or stream != "depth"
        )

    def _stream(self, camera: str, stream: str) -> PictureStream:
        read = partial(self.episode.pictures, camera, stream)
        first, what = next(read()), "rgb" if stream == "color" else stream
        scaling = self._scaling(first.shape[1], first.shape[0])
        if scaling is None:
            return PictureStream(camera, what, first.shape, first.dtype, self.rows, read)
        scaled = scaling.depth if STREAMS[stream].exact else scaling.color
        shape = (*reversed(scaling.size), *first.shape[2:])
        return PictureStream(camera, what, shape, first.dtype, self.rows, lambda: map(scaled, read()))

    def _scaling(self, width: int, height: int) -> Cropping | None:
        return None if self._size is None else Cropping(width, height, *self._size)

    def lenses(self) -> dict[str, dict[str, Any]]:
        """Return size, camera matrix and distortion of each camera's pictures as they are exported, where known."""
        found: dict[str, dict[str, Any]] = {}
        for stream in self.pictures:
            if stream.camera in found:
                continue
            known = self.episode.info["cameras"][stream.camera]
            width, height = self._recorded_size(stream.camera)
            if known["K"] is None:  # a dataset that another program edited
                continue
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
        first: NDArray[Any] = next(self.episode.pictures(camera, next(iter(self.episode.files(camera)))))
        return first.shape[1], first.shape[0]

    def about(self) -> dict[str, Any]:
        """Return the short metadata that a format stores beside an episode's rows."""
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


_OF_AN_ARM = {
    "joint_vel": "observation.velocity",
    "joint_effort": "observation.effort",
    "joint_effort_ext": TAU_EXT,
    "eef_vel": "observation.twist",
    "eef_wrench": WRENCH_EXT,
}


def observations(content: EpisodeContent) -> dict[str, NDArray[Any]]:
    """Return the arrays of an episode under robomimic's names, each (rows, n), SI units, quaternions xyzw.

    ``robot0_joint_pos``, ``robot0_eef_pos`` and so on; a second arm is ``robot1``. ``object`` has the poses of all
    simulated objects, one after the other.
    """
    found: dict[str, NDArray[Any]] = {}
    for k, arm in enumerate(content.arms):
        lead = f"robot{k}_"
        found[lead + "joint_pos"] = content.of(arm, "observation.state")
        pose = content.of(arm, "observation.tcp")
        found[lead + "eef_pos"], found[lead + "eef_quat"] = pose[:, :3], pose[:, 3:]
        for name, key in _OF_AN_ARM.items():
            if content.has(key) and (values := content.of(arm, key)).shape[1]:
                found[lead + name] = values
        if (width := content.width(arm)) is not None:
            found[lead + "gripper_width"] = width[:, None]
    if objects := content.objects:
        found["object"] = np.concatenate(list(objects.values()), axis=1)
    return found


def picture_name(stream: PictureStream) -> str:
    """Return ``wrist_image``, ``wrist_depth``, ``wrist_infrared`` and so on."""
    return f"{stream.camera}_{'image' if stream.what == 'rgb' else stream.what}"


def add_channel(picture: NDArray[Any]) -> NDArray[Any]:
    """Return a picture with channels last: (H, W, 3), or (H, W, 1) for one without colours."""
    return picture if picture.ndim == 3 else picture[:, :, None]


CAMERA, GRIPPER_CAMERA = "camera", "gripper_camera"


def camera_roles(
    content: EpisodeContent, camera: str | None = None, gripper_camera: str | None = None
) -> dict[str, str]:
    """Return the name of each camera in an export.

    By default the first camera on an arm is ``gripper_camera``, the first that is not on an arm is ``camera``, and all
    others keep their names.

    Raises:
        CommandError: There is no such camera (code ``no_such_camera``), or two would have the same name
            (``duplicate_name``).
    """
    there = content.cameras
    for name in (camera, gripper_camera):
        if name is not None and name not in there:
            raise CommandError(
                f"there is no camera {name} in this export; cameras: {', '.join(there) or 'none'}",
                code="no_such_camera",
            )
    if camera is not None and camera == gripper_camera:
        raise CommandError(f"{camera} cannot be both camera and gripper camera", code="duplicate_name")
    carried = _find_carried(content)
    free = [name for name in there if name not in (camera, gripper_camera)]
    gripper_camera = gripper_camera or next((name for name in free if name in carried), None)
    camera = camera or next((name for name in free if name not in carried), None)
    found = {name: CAMERA if name == camera else GRIPPER_CAMERA if name == gripper_camera else name for name in there}
    if len(set(found.values())) < len(found):
        raise CommandError(
            "two cameras would have the same name; choose with --camera and --gripper-camera", code="duplicate_name"
        )
    return found


def _find_carried(content: EpisodeContent) -> set[str]:
    """Return the cameras that an arm carries in the rig's configuration."""
    cameras = content.episode.info["rig"]["resolved"]["cameras"]
    return {spec["name"] for spec in cameras if (spec["view"] or {}).get("robot") is not None}
