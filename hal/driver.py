"""The driver interface: one abstract class for each kind of device, with the records that it hands over.

A driver talks to one device and does nothing else. Limits, smoothing, deadlines, the dead-man, stops and the ages of
states are handled above it, and are the same for every driver. To support a new device, subclass one of

    RobotDriver      open, read, write, halt, close
    GripperDriver    open, read, move, stop, close
    CameraDriver     open, grab, close
    GamepadDriver    open, poll, close

with the methods listed (all others are optional), and name the class in a :class:`hal.registry.DriverSpec`.

Rules for every driver:

* ``__init__`` stores the device's record (``self.spec``; ``spec.options`` holds the driver's options from the rig
  file) and opens nothing.
* ``open`` connects and never moves anything. ``close`` may be called at any time, more than once, and stops safely
  first.
* A device that does not answer raises :class:`~hal.errors.ConnectionLost`, at every call. Any other exception counts
  as a mistake in the driver and ends the process that runs it.
* Methods return within one cycle of the device, except those whose docstring grants a timeout.
* SI units and radians. Times named ``t`` are on the host's monotonic clock (``time.monotonic()``; in lock-step the
  simulated time), ``t_device`` is on the device's own clock. An unknown value is None, never 0.

``docs/write-a-driver.md`` shows a complete driver; :mod:`hal.testing` holds the contract tests for every driver.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .arguments import freeze
from .errors import Fault, NotSupported
from .geometry import Pose
from .types import STREAMS, GripperOutcome

if TYPE_CHECKING:
    from .specs import CameraSpec, GripperSpec, PadSpec, RobotSpec

__all__ = [
    "CameraDriver",
    "CameraInfo",
    "CameraTally",
    "DeviceDriver",
    "GamepadDriver",
    "GripperDriver",
    "GripperReading",
    "PadReading",
    "Plugged",
    "RawFrame",
    "Reading",
    "RobotDriver",
    "Setpoint",
    "StreamInfo",
]

Array = NDArray[np.float64]
Floats = Sequence[float]


class DeviceDriver(ABC):
    """Base class of the drivers of all kinds of device."""

    simulated: ClassVar[bool] = False
    """Whether no real device is behind this driver: nothing real moves, no person presses a button."""

    @abstractmethod
    def open(self) -> None:
        """Connect to the device, within some seconds. Nothing moves.

        Raises:
            DeviceNotFound: No such device; the message lists those that are there.
            ConnectionLost: The device does not answer.
            NotSupported: The device cannot do what its record requests, for example a camera's stream.
        """

    def inject(self, **faults: object) -> None:
        """Switch simulated faults on or off, for tests; a driver without faults raises NotSupported."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    def statistics(self) -> dict[str, Any]:
        """Return figures about the device and its connection, as plain numbers and texts, for reports."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """Stop safely and release the device, within 8 s. Idempotent; a lost link is no error.

        A gripper keeps the object that it holds.
        """


# Robot arms


class Reading(NamedTuple):
    """State of an arm, as its driver reports it once per cycle. Plain floats, no arrays: this is the hot path."""

    t: float
    """Time of the measurement on the host's clock, s."""
    t_device: float
    """Time of the measurement on the device's own clock, s."""
    seq: int
    """Number of the device's sample; a gap is a lost sample."""
    q: Floats
    """Joint positions (n,), rad."""
    dq: Floats
    """Joint velocities (n,), rad/s."""
    tau: Floats | None = None
    """Joint torques (n,), Nm."""
    q_commanded: Floats | None = None
    """Set-point (n,) that the device reports as the last one it took, rad; None if it does not report one. The servo
    detects lost set-points by it."""
    dq_commanded: Floats | None = None
    """Velocity of that set-point (n,), rad/s."""
    tau_ext: Floats | None = None
    """External joint torques (n,), Nm."""
    wrench_ext: Floats | None = None
    """External force and torque (6,) at the tcp, N and Nm."""
    fault: Fault | None = None
    """Fault of the device; it stops the arm and latches the stop."""
    tau_commanded: Floats | None = None
    """In torque mode: torques (n,) that the device reports as the last ones it took, Nm; None until it has changed its
    mode. The servo continues from them, as it does from ``q_commanded``."""


class Setpoint(NamedTuple):
    """Set-point that the servo writes to an arm's driver once per cycle: continuous, and within all limits.

    A driver may keep the sequences and report them as ``q_commanded``, but must not change them.
    """

    q: Floats
    """Joint positions (n,), rad."""
    dq: Floats
    """Joint velocities (n,), rad/s."""
    ddq: Floats
    """Joint accelerations (n,), rad/s^2."""
    tau: Floats | None = None
    """Joint torques (n,), Nm, in torque mode only: to be applied on top of those that carry the arm's own weight.
    ``q`` and ``dq`` are then the measured ones."""
    q_from: Floats | None = None
    """Position (n,) of the device at present, as far as the servo can tell: the set-point before this one, rad. In
    position mode only."""


class RobotDriver(DeviceDriver):
    """Driver of one arm.

    All methods are called from one thread of the process that runs the arm's servo. ``wait`` (where the device sets
    the pace) and ``read`` are called once per cycle, ``write`` once per cycle while a control session is open. Between
    sessions ``read`` sends what an arm needs to hold and to report its state. A device that hears nothing any more
    must come to rest by itself, because the process may be killed, and hold if it can.

    Args:
        spec: Record of the arm: joints, limits, rate, options.
        world: Simulated world that the arm stands in; None for a real arm.
    """

    modes: ClassVar[frozenset[str]] = frozenset({"position"})
    """Kinds of set-point that the device takes: ``position``, ``velocity``, ``torque``."""
    paces_itself: ClassVar[bool] = False
    """Whether the device sets the pace: :meth:`wait` then blocks until its next cycle (a Franka's state packets)."""
    extrapolates: ClassVar[bool] = False
    """Whether the device continues at constant acceleration while it gets no set-point (a Franka); any other one stays.
    Such a device counts its cycles in ``seq``, and reports in ``q_commanded`` and ``dq_commanded`` what it commands
    itself in that cycle, in single precision or better. The servo continues from there, and answers it at once."""
    engaged: bool = True
    """Whether the drives are on, so that the arm holds and follows. A driver that has to switch them on (see
    :meth:`engage`) sets it to False until then, and again when a fault or a lost link switched them off."""

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        self.spec, self.world = spec, world

    def wait(self) -> None:
        """Block until the device's next cycle, for a bounded time. Needed if :attr:`paces_itself` is True.

        Raises nothing for the device: :meth:`read` reports what went wrong.
        """
        raise NotSupported(f"driver {type(self).__name__} does not pace itself")

    @abstractmethod
    def read(self, now: float) -> Reading:
        """Return the newest state of the arm; does not block.

        If nothing new has come, return the last reading again: its age shows that the device has frozen.

        Args:
            now: Time on the host's clock, s, for devices that report no time of measurement.

        Raises:
            ConnectionLost: The device does not answer. It is read again in the next cycle, so a driver that can
                reconnect does it here.
        """

    def engage(self) -> None:  # most arms are ready as soon as they are open
        """Switch the drives on, or continue to: the arm then holds where it is. Nothing moves.

        It is called once per cycle, before a :meth:`read`, until :attr:`engaged` is True: when a control session opens,
        and when the arm is to move again after a fault or a lost link. About 0.3 s is usual, 1 s the limit. Neither
        ``open`` nor ``recover`` engages, since a user may be holding the arm; :meth:`halt` keeps it engaged.

        Raises:
            RobotFault: A drive does not switch on; the message names it. No session is opened.
            ConnectionLost: The device does not answer.
        """

    @abstractmethod
    def write(self, setpoint: Setpoint) -> bool | None:
        """Send the next set-point to the device. Not called while :attr:`engaged` is False.

        Returns:
            False if it was not passed on, for example because the device has to start a motion first: the servo then
            continues from the position of the next reading. True or None otherwise.

        Raises:
            ConnectionLost: The device does not take it.
        """

    @abstractmethod
    def halt(self) -> None:
        """End streaming: the device stops, and holds where it is. Idempotent."""

    def lower(self) -> bool:
        """Lower an arm without brakes by one cycle, before :meth:`close`; return whether it is down.

        Called in place of :meth:`read` and :meth:`write` until it returns True, for 7 s at most, as are the other
        arms of the group; its grippers hold. A lost link is no error. ``close`` may come without it.
        """
        return True

    def recover(self) -> None:
        """Clear a fault of the device, only on the user's request. Devices without faults need nothing."""

    @property
    def wants_loop(self) -> bool:
        """Whether the device's library takes over the cycle from now on (see :meth:`loop`)."""
        return False

    def loop(self, turn: Callable[[], None]) -> None:
        """Run the device's own control loop, which calls ``turn`` once per cycle until the motion is over.

        For libraries that take set-points only as the result of a callback. During a turn, :meth:`wait` does not block,
        :meth:`read` returns the state that the callback was given, and :meth:`write` keeps the callback's result.

        Args:
            turn: Runs one whole cycle of all devices in this process.
        """
        raise NotSupported(f"driver {type(self).__name__} does not own a loop")

    def mass_matrix(self, q: Floats) -> Any:
        """Return the joint-space inertia of the arm. Needed if :attr:`modes` has ``torque``.

        The servo brakes by it and bounds the torques by it. A factor of three in either direction is good enough;
        the invented inertias of many URDFs are not.

        Args:
            q: Joint positions (n,), rad.

        Returns:
            (n, n) in kg m^2, as nested sequences or an array.
        """
        raise NotSupported(f"driver {type(self).__name__} does not know the arm's inertia")

    def own_tcp(self) -> Floats | None:
        """Return the pose of the tcp at the last reading, as computed by the device.

        It is compared with the model's forward kinematics when the arm is opened, and a mismatch is refused.

        Returns:
            Homogeneous matrix (16,) in column-major order, base frame, m; None if the device reports none.
        """
        return None

    def reset_statistics(self) -> None:
        """Start the figures of :meth:`statistics` again from zero."""


# Grippers


class GripperReading(NamedTuple):
    """State of a gripper, as its driver reports it; ``t``, ``t_device`` and ``seq`` are as in :class:`Reading`."""

    t: float
    t_device: float
    seq: int
    width: float
    """Distance between the fingers, m."""
    width_target: float
    """Width that the newest command asked of the fingers, m: 0 after a grasp, whose fingers press beyond the object."""
    moving: bool
    grasped: bool | None = None
    """Whether the fingers hold an object; None if unknown."""
    force: float | None = None
    """Grip force, N; None if unknown."""
    outcome: GripperOutcome | None = None
    """Outcome of the newest command, from the return of its call on; None if the driver cannot tell: it is then derived
    from ``moving`` and the width."""
    fault: Fault | None = None
    """Why the newest command failed, with the remedy."""


class GripperDriver(DeviceDriver):
    """Driver of one gripper.

    ``move``, ``grasp`` and ``home`` start a motion and return at once, because a gripper must never block the arm. The
    newest command replaces the one in progress. ``stop`` and ``close`` never open the fingers. All methods are called
    from one thread and return within a few ms; where the vendor's calls block, announce
    ``own_process=frozenset({"gripper"})`` in the :class:`~hal.registry.DriverSpec`. A command whose call raises counts
    as failed.

    Args:
        spec: Record of the gripper: widths, speed, force, options.
        world: Simulated world that the gripper is part of; None for a real one.
    """

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        self.spec, self.world = spec, world

    @abstractmethod
    def read(self, now: float) -> GripperReading:
        """Return the newest state; does not block. ``now`` is the time on the host's clock, s."""

    @abstractmethod
    def move(self, width: float, speed: float, force: float) -> None:
        """Start to move the fingers.

        Args:
            width: Distance between the fingers at the end, m.
            speed: Speed, m/s.
            force: Greatest force on an object in between, N.
        """

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Start to close on an object and hold it.

        By default it is a :meth:`move` until the fingers are closed, which presses on what is in between.

        Args:
            width: Expected width of the object, m.
            speed: Speed, m/s.
            force: Force to hold it with, N.
            inner: The object counts as held if it is at most so much narrower than ``width``, m,
            outer: and at most so much wider, m.
        """
        self.move(0.0, speed, force)

    def home(self) -> None:
        """Start to measure how far the fingers open. Some grippers need it once after they are switched on."""

    @abstractmethod
    def stop(self) -> None:
        """Keep the fingers where they are, and the grip force as it is."""


# Cameras


@dataclass(frozen=True, slots=True, eq=False)
class StreamInfo:
    """One stream as the sensor takes it: before alignment, crop and scaling."""

    format: str | None
    """Pixel format of the device (``bgr8``, ``z16``, ...); None if it has none."""
    width: int
    height: int
    rate_hz: float
    K: Array
    """Camera matrix (3, 3), pixels; the centre of the upper left pixel is (0, 0)."""
    distortion: Array
    """(5,) k1, k2, p1, p2, k3 (OpenCV's order)."""
    T_color_stream: Pose
    """Pose of this sensor's optical frame in the colour sensor's; the identity for colour itself."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """Identity and calibration of an open camera. A real one reports its own figures, a simulated one the model's."""

    title: str
    """Make and model, for messages."""
    K: Array
    """Camera matrix (3, 3) of the colour and depth images of a frame: aligned, cropped and scaled; pixels."""
    distortion: Array
    """(5,) of the same images, in OpenCV's order."""
    K_infrared: Array | None
    """Camera matrix (3, 3) of both infrared images of a frame, which are never aligned; None without infrared."""
    clock: str
    """Clock of ``Stamp.t_device``: ``hardware`` (the sensor's own), ``global`` (the sensor's, converted by its library
    to the host's time of day), ``system`` (the host's at arrival), ``kernel`` (the host's monotonic one, stamped by its
    kernel), ``video`` (the time in a video) or ``simulated``."""
    serial: str | None = None
    firmware: str | None = None
    usb: str | None = None
    """USB version of the link, for example ``3.2``; ``2.1`` offers fewer modes, and is often a matter of the cable."""
    depth_scale: float | None = None
    """Metres per unit of the raw depth image."""
    streams: Mapping[str, StreamInfo] = field(default_factory=lambda: MappingProxyType({}))
    """The streams that are on, by their names in the rig file."""
    options: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """The device's settings, with their present values."""


class RawFrame(NamedTuple):
    """One capture of a camera.

    Images have the output's size: colour (H, W, 3) RGB, depth (H, W) in m with 0 where nothing was measured, the others
    (H, W); None for a stream that is off.
    """

    t: float
    """Time of the exposure on the host's clock, s; of a simulated frame, the time of the world that it shows."""
    t_device: float
    """Time of the exposure on the device's own clock, s."""
    seq: int
    """Number of the capture; a gap is a lost capture. It may start again at any number after ``open``."""
    color: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None
    infrared: NDArray[np.uint8] | None = None
    segmentation: NDArray[np.int32] | None = None
    """Number of the body in each pixel, -1 for none; simulation only."""
    T_world_camera: Pose | None = None
    """Pose of the camera in the world; None if the driver does not know it: it is then computed from the rig file and
    the state of the arm that carries the camera."""
    infrared_right: NDArray[np.uint8] | None = None
    skew: float | None = None
    """Time of the colour image minus that of the depth image, s."""


class CameraTally(NamedTuple):
    """Sets of images that a camera's driver has dropped since it was created."""

    repeated: int = 0
    """Sets without any new image."""
    mismatched: int = 0
    """Sets whose images do not belong together."""


class CameraDriver(DeviceDriver):
    """Driver of one camera.

    Its methods are called from one thread at a time, ``open`` not always from the same as the others. A driver need not
    reconnect by itself: when ``grab`` raises ConnectionLost, :class:`~hal.camera.Camera` calls ``close`` and ``open``
    in the background, at bounded intervals, until the camera is back. A second ``close`` without ``open`` in between
    means that the camera is closed for good.

    Args:
        spec: Record of the camera: streams, size, rate, options.
        source: What a simulated camera takes its images from; the rig's clock if nothing renders for it.
    """

    on_demand: bool = False
    """Whether no capture is missed however late it is read (a recording without pace): every ``read`` of the camera
    then calls ``grab``, and no thread reads ahead."""
    tally: CameraTally = CameraTally()
    """Sets of images dropped so far."""

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        self.spec, self.source = spec, source

    @classmethod
    def list_plugged(cls) -> tuple[str, ...]:
        """Describe the cameras that could be opened now, each with what identifies it. Opens nothing."""
        return ()

    @property
    def info(self) -> CameraInfo:
        """Identity and calibration; read after every ``open``, because another camera may have been plugged in."""
        return self.nominal_info()

    def nominal_info(self, title: str = "") -> CameraInfo:
        """Return the figures of the model, for a camera that reports none itself; ``title`` is its make and model."""
        spec, streams = self.spec, {}
        distortion = freeze(spec.distortion)
        for name, s in spec.sensors.items():
            pose = Pose(s.position, s.orientation)
            streams[name] = StreamInfo(s.format, s.width, s.height, s.rate_hz, freeze(s.K), distortion, pose)
        infrared = spec.K_infrared or (spec.K if any(STREAMS[name].unaligned for name in spec.streams) else None)
        K_infrared = None if infrared is None else freeze(infrared)
        clock = "simulated" if self.simulated else "hardware"
        made = MappingProxyType(streams)
        return CameraInfo(title or spec.model, freeze(spec.K), distortion, K_infrared, clock, streams=made)

    @abstractmethod
    def grab(self, timeout: float) -> RawFrame | None:
        """Return the newest frame that was not returned yet.

        In lock-step, a simulated camera returns the same frame again while nothing in the world has changed.

        Returns:
            The frame; None if none came within ``timeout`` s.

        Raises:
            ConnectionLost: The device is gone, or has been silent for so long that it must be opened again.
        """


# Gamepads


class PadReading(NamedTuple):
    """State of a gamepad, as its driver reports it: names of ``hal.types.AXES`` and ``BUTTONS``, without dead zone."""

    t: float
    """Time of the newest event on the host's clock, s."""
    t_alive: float
    """Time of the last proof that the pad is connected and sending, s. The dead-man's watchdog uses it."""
    t_device: float
    """Time of the newest event on the device's own clock, s."""
    seq: int
    """Number of the newest event."""
    axes: Mapping[str, float]
    """Axis -> value: sticks -1..1, right and up positive; triggers 0..1. A trigger that is only a button is 0 or 1, or
    missing."""
    buttons: frozenset[str]
    """The buttons that are pressed."""
    connected: bool
    unknown: Collection[str] = ()
    """Axes that the pad has not reported yet; their value is 0, and no control counts until they have moved."""
    joints: tuple[float, ...] = ()
    """Joint positions of a leader arm (n,), rad; empty for a gamepad."""
    pose: tuple[float, ...] = ()
    """Pose of a hand that is tracked, see :attr:`hal.PadState.pose`; empty for others."""


class Plugged(NamedTuple):
    """Gamepads that a driver could open now."""

    pads: tuple[str, ...]
    """A description of each."""
    notes: tuple[str, ...] = ()
    """Reasons why others cannot be opened, each with the command that fixes it."""
    devices: tuple[str, ...] = ()
    """Value of ``options.device`` for each of :attr:`pads`; empty if the driver has no such option."""


class GamepadDriver(DeviceDriver):
    """Driver of one gamepad.

    ``poll`` is called from one thread for as long as the rig is open. A pad that is not plugged in is no error, neither
    for ``open`` nor for ``poll``: the reading has ``connected=False``, and the pad is found when it is plugged in.

    Args:
        spec: Record of the pad: dead zone, options.
        source: What a pad in another process gets its readings from; for ``playback``, the world's time.
    """

    proves_liveness: bool = False
    """Whether silence means that the pad is gone (it streams, or an unplugged cable is detected). Only then may its
    buttons serve as the dead-man of a real arm. It may change when another pad is plugged in."""

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        self.spec, self.source = spec, source
        self.notes: tuple[str, ...] = ()
        """Messages for the user about this pad, each with the remedy."""
        self.flat: Mapping[str, float] = MappingProxyType({})
        """Axis -> share of its travel (0..1) that the pad itself calls neutral."""
        self.absolute: Collection[str] = ()
        """Axes that stay where they are put (a lever), and need not be at rest before the pad counts."""

    @classmethod
    def list_plugged(cls) -> Plugged:
        """Return the pads that could be opened now. Quick; opens nothing; a missing pad is no error."""
        return Plugged(())

    @abstractmethod
    def poll(self, now: float, timeout: float) -> PadReading:
        """Return the present state, after waiting up to ``timeout`` s for a change; ``now`` is the rig's clock, s."""

    def describe(self) -> str:
        """Return a few words that identify the input device, for the banner."""
        return type(self).__name__

    def details(self) -> Mapping[str, str]:
        """Return facts about the connected pad, topic -> text, for troubleshooting."""
        return {}

    @property
    def control_names(self) -> Mapping[str, str]:
        """Control -> its name as printed on the connected pad; others have :data:`hal.gamepad.CONTROL_NAMES`."""
        return {}

    @property
    def mapping(self) -> str | None:
        """Name of the teleoperation mapping made for the connected pad; None if any mapping fits."""
        return None

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        """Start the heavy and the light motor (powers 0..1) without blocking; return whether the pad vibrates."""
        return False

    @property
    def can_hold(self) -> bool:
        """Whether a control can be held down. If not (keys of a terminal), each press is one small step."""
        return True

    @property
    def finished(self) -> bool:
        """Whether a recording has come to its end; always False for a device."""
        return False
