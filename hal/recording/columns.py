"""The columns of a recording: one row of plain numbers per grid time, and how a dataset announces them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

__all__ = [
    "ACTION",
    "BOOKKEEPING",
    "GRID",
    "MORE_STREAMS",
    "PAD",
    "SEGMENTATION",
    "SETPOINT",
    "STATE",
    "TIMES",
    "Column",
    "CameraSetup",
    "features_of",
    "video_key",
]

STATE = "observation.state"
SETPOINT = "observation.setpoint"
ACTION = "action"
PAD = "observation.pad"
"""No ``action.pad``: LeRobot takes every column whose name begins with ``action`` for an action."""
TIMES = "observation.time."
"""What stands first in these columns is a time, s: on the rig's clock while it is recorded, in the dataset since the
episode's first row."""
GRID = f"{TIMES}grid"

SEGMENTATION = "segmentation"
MORE_STREAMS = ("infrared", "infrared_right", SEGMENTATION)
"""Streams of a camera that are recorded on request."""
BOOKKEEPING: dict[str, str] = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that every LeRobotDataset has, with their types."""


class Column(NamedTuple):
    """One column of the dataset: ``len(names)`` numbers in every row."""

    key: str
    dtype: str
    """``float32``, ``float64`` or ``int64``, on disk; while a row is on its way, every number is a double."""
    names: tuple[str, ...]

    @property
    def feature(self) -> dict[str, Any]:
        """As ``meta/info.json`` says it."""
        return {"dtype": self.dtype, "shape": [len(self.names)], "names": list(self.names)}


class CameraSetup(NamedTuple):
    """How the pictures of one camera are kept."""

    name: str
    width: int
    height: int
    color: bool
    depth_unit: float | None
    """Metres in one unit of the stored depth; None where no depth is kept."""
    depth_lossless: bool
    """Does the camera itself measure in that unit?"""
    seq: int
    """Which number of a row counts this camera's frames."""
    more: Sequence[str] = ()
    """Streams that are kept besides colour and depth: some of :data:`MORE_STREAMS`."""

    @property
    def videos(self) -> dict[str, str]:
        """Names of the videos, each with its stream: ``wrist`` has the colour, ``wrist_infrared`` the infrared."""
        color = {self.name: "color"} if self.color else {}
        return color | {f"{self.name}_{stream}": stream for stream in self.more if stream != SEGMENTATION}

    @property
    def depths(self) -> dict[str, str]:
        """Names of the files of lossless pictures, each with its stream: depth, segmentation."""
        depth = {self.name: "depth"} if self.depth_unit is not None else {}
        return depth | {f"{self.name}_{stream}": stream for stream in self.more if stream == SEGMENTATION}


def video_key(video: str) -> str:
    """Return the dataset's key of a video: of a camera's colour, or of ``<camera>_infrared``."""
    return f"observation.images.{video}"


def features_of(
    columns: Sequence[Column], cameras: Sequence[CameraSetup], fps: int, video: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """``features`` of ``meta/info.json``; ``video`` is what the encoder says of itself."""
    found = {column.key: column.feature for column in columns}
    features = {STATE: found.pop(STATE), ACTION: {**found[SETPOINT]}, **found}
    for camera in cameras:
        for name in camera.videos:
            features[video_key(name)] = {
                "dtype": "video",
                "shape": [camera.height, camera.width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": camera.height,
                    "video.width": camera.width,
                    **video,
                    "video.is_depth_map": False,
                    "video.fps": fps,
                    "video.channels": 3,
                    "has_audio": False,
                },
            }
    features |= {key: {"dtype": dtype, "shape": [1], "names": None} for key, dtype in BOOKKEEPING.items()}
    return features
