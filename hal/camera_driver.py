"""What a camera's driver is: the abstract class, and the records that it hands over."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .camera_info import CameraInfo, nominal_info
from .errors import NotSupported
from .pose import Pose
from .specs import CameraSpec

__all__ = ["CameraDriver", "CameraTally", "RawFrame"]


class RawFrame(NamedTuple):
    """One capture as a driver hands it over: already at the output's size, colour as RGB, depth in metres."""

    t: float
    """When it was taken, on the host's clock, s: for a simulated frame, the time of the world that it shows."""
    t_device: float
    seq: int
    """Counts captures, from any number on; a gap is a capture that was lost. May start anew after ``open``."""
    color: NDArray[np.uint8] | None
    depth: NDArray[np.float32] | None
    infrared: NDArray[np.uint8] | None
    segmentation: NDArray[np.int32] | None
    T_world_camera: Pose | None
    """None where the driver does not know it; the rig then works it out from its file and the arm's state."""
    infrared_right: NDArray[np.uint8] | None = None
    skew: float | None = None
    """By how much colour was taken later than depth, s."""


class CameraTally(NamedTuple):
    """What a driver kept back since it was made."""

    repeated: int = 0
    """Sets of pictures in which nothing was new."""
    mismatched: int = 0
    """Sets whose pictures do not belong together."""


class CameraDriver(ABC):
    """One camera. The calls come from one thread, which may be another one than that of ``open``.

    When ``grab`` raises ConnectionLost, the public :class:`~hal.camera.Camera` calls ``close`` and then ``open`` again,
    in the background and at bounded intervals, until it works: a driver needs no way back of its own.
    """

    simulated: ClassVar[bool] = False
    on_demand: bool = False
    """True where no capture is missed however late it is asked for (a recording that is not paced): every ``read`` of
    the camera is then a ``grab``, and no thread takes frames ahead of it."""
    tally: CameraTally = CameraTally()

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        self.spec = spec
        self.source = source
        """Where a simulated camera gets its pictures from; the rig's clock where nothing draws for it."""

    @classmethod
    def plugged(cls) -> tuple[str, ...]:
        """What could be opened at the moment, in words, each with what tells it apart. Opens nothing."""
        return ()

    @property
    def info(self) -> CameraInfo:
        """What the camera is; asked for after every ``open``, because another one may have been plugged in."""
        return nominal_info(self.spec, "simulated" if self.simulated else "hardware")

    @abstractmethod
    def open(self) -> None:
        """Connect and start streaming. Raises DeviceNotFound (lists what is there), ConnectionLost, NotSupported.

        Bounded: what cannot be had within some seconds is an error.
        """

    @abstractmethod
    def grab(self, timeout: float) -> RawFrame | None:
        """The newest frame that was not handed out yet; waits up to ``timeout`` s, then None.

        In lock-step, a simulated camera returns the same frame again while nothing in the world has changed.

        Raises :class:`~hal.errors.ConnectionLost` when the device is gone, or so silent that it must be opened anew.
        """

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Stop streaming, let go of the device. Idempotent, and bounded in time whatever the device does.

        A second call without ``open`` in between means that the camera is closed for good.
        """
