"""A robot of LeRobot as an arm of a rig (``driver: lerobot``), with its gripper: the servo stands in front of it.

A thread reads observations and sends actions in turn, as LeRobot's loops do, so a slow robot delays no cycle. What a
robot of LeRobot does not tell stays unknown: when it measured, its speeds and torques, whether it took an action, and
what it does when nothing comes any more.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from math import degrees, inf, isfinite, radians
from pathlib import Path
from statistics import median
from typing import Any, ClassVar

from pydantic import Field

from hal.config.files import DeviceSettings
from hal.config.schema import Flag
from hal.driver import GripperDriver, GripperReading, Reading, RobotDriver, Setpoint
from hal.errors import ConnectionLost, Fault
from hal.host.library_thread import LibraryThread
from hal.lock import DeviceLock
from hal.preflight import CheckResult
from hal.registry import DriverSpec
from hal.specs import GripperSpec, RobotSpec

__all__ = ["DRIVER", "LeRobotArm", "LeRobotGripper"]

DRIVER = DriverSpec(
    name="lerobot",
    robot="lerobot_robot_hal.follower:LeRobotArm",
    gripper="lerobot_robot_hal.follower:LeRobotGripper",
    camera="lerobot_robot_hal.camera:LeRobotCamera",
    checks={"robot": "lerobot_robot_hal.follower:check_arm", "camera": "lerobot_robot_hal.camera:check_camera"},
    steppable=False,
    preflight="lerobot_robot_hal.follower:check",
    shared_options=("type", "config"),
    requires={"lerobot": "pip install lerobot"},
)
_CONNECT = 30.0
"""Longest time that the robot takes to connect, s."""
_SAMPLES = 20
"""Observations by which its rate is measured."""
_SILENCE = 0.15
"""Time without an observation after which it counts as lost, s; or five of its own periods, if that is more."""
_RETRY = 0.2
"""Time between attempts to read a robot that failed, s."""
_APART = 0.5
"""Distance of a joint from its set-point at which it does not follow, rad."""
_NEAR, _REST = 0.002, 0.3
"""Distance from its goal at which a gripper is there, m, and time without motion after which it rests, s."""
_SILENT = Fault(
    "SILENT", "the robot sends no observations any more", "check its cable and its power; open the rig anew"
)
_NOT_FOLLOWING = Fault("NOT_FOLLOWING", "the robot does not follow its set-points", "look for an obstacle; recover()")
_UNKNOWN = "not known: when it measured, its speeds and torques, what it does when this program dies"


class RobotSettings(DeviceSettings):
    """Settings under ``real:`` of an arm."""

    type: str
    """Of the robot, as in ``--robot.type``."""
    config: dict[str, Any] = Field(default_factory=dict)
    """Keys of its configuration, as ``--robot.KEY``."""
    numbers: tuple[str, ...]
    """Names of its numbers for the joints of the model, in their order, as ``shoulder_pan.pos``."""
    degrees: Flag = True
    """Whether they are in degrees; else in rad."""
    signs: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    """Joint positions of the model are sign * number + offset, rad."""


class GripperSettings(DeviceSettings):
    """Settings under ``real:`` of its gripper."""

    type: str
    config: dict[str, Any] = Field(default_factory=dict)
    number: str = "gripper.pos"
    closed: float = 0.0
    opened: float = 100.0
    """The number when closed and when open."""


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig file, message and code."""
    settings, problems = RobotSettings.check(spec)
    yield from problems
    n = len(spec.joints)
    for key in ("numbers", "signs", "offsets") if settings is not None else ():
        found = len(getattr(settings, key))
        if found != n and (found or key == "numbers"):
            yield f"real.{key}", f"must have {n} entries, for {', '.join(spec.joints)}", "wrong_count"


def find_config(what: str, package: Any, choices: Any, type_: str) -> Any:
    """Return the class of the configuration of a robot or a camera. Raises ValueError for an unknown type."""

    def known() -> Any:
        with suppress(Exception):  # of draccus, for an unknown name
            return choices.get_choice_class(type_)
        return None

    for module in pkgutil.iter_modules(getattr(package, "__path__", [])):
        if known() is None and module.ispkg:
            with suppress(ImportError):  # the libraries of another one
                importlib.import_module(f"{package.__name__}.{module.name}")
    if known() is None:
        with suppress(ImportError):
            from lerobot.utils.import_utils import register_third_party_plugins

            register_third_party_plugins()
    if known() is None:
        raise ValueError(f"LeRobot knows no {what} {type_!r}, or a library that it needs is missing")
    return known()


def make_robot(type_: str, config: dict[str, Any]) -> Any:
    """Return a robot of LeRobot. Raises ValueError for an unknown type or configuration."""
    from lerobot import robots

    known = find_config("robot", robots, robots.RobotConfig, type_)
    given = config | ({"calibration_dir": Path(config["calibration_dir"])} if "calibration_dir" in config else {})
    if "disable_torque_on_disconnect" in getattr(known, "__dataclass_fields__", {}):
        given.setdefault("disable_torque_on_disconnect", False)  # an arm that is closed holds
    try:
        return robots.make_robot_from_config(known(**given))
    except TypeError as error:
        raise ValueError(f"config of {type_}: {error}") from None


class Link(LibraryThread):
    """The robot, and the thread that talks to it. An arm and its gripper share it."""

    LIBRARY: ClassVar[str] = "lerobot"
    opened: ClassVar[dict[str, Link]] = {}

    def __init__(self, name: str, type_: str, config: dict[str, Any]) -> None:
        super().__init__(name)
        self.type, self.config = type_, config
        self.key = f"lerobot-{type_}-{config.get('port') or config.get('id') or name}"
        self.users: set[object] = set()
        self.robot: Any = None
        self.seq, self.t, self.values = 0, -inf, dict[str, float]()
        """Number, time (s) and numbers of the newest observation."""
        self.past: deque[tuple[float, dict[str, float]]] = deque(maxlen=5)
        """Time and numbers of the newest observations, over which speeds are measured."""
        self.took: list[float] = []
        """Of each of the first observations, s."""
        self.period = 0.01
        """Longest time between two observations, s."""
        self.trouble = ""
        """Why the robot does not answer."""
        self.goal: dict[str, float] = {}
        """Numbers that were sent last, as the robot returned them."""
        self._news: dict[str, float] = {}

    @classmethod
    def of(cls, name: str, type_: str, config: dict[str, Any]) -> Link:
        """Return the link to a robot, the same for all who use it."""
        link = cls(name, type_, config)
        return cls.opened.setdefault(link.key, link)

    @property
    def silence(self) -> float:
        """Longest time without an observation, s."""
        return max(_SILENCE, 5.0 * (self.period + max(self.took, default=0.0)))

    def open(self, user: object) -> None:
        """Connect the first time, and measure how fast the robot is. Raises ConnectionLost and ControlTaken."""
        if not self.users:
            self.reserve(DeviceLock(self.key, f"the robot {self.type}", patience=1.0))
            self.took, self.goal, self.trouble, self.t = [], {}, "", -inf
            self.past.clear()
            self.begin(self._turn, self._leave)
            if not self.finish(lambda _: self._connect(), _CONNECT):
                self.close()
                raise ConnectionLost(f"{self.name}: {self.type}: {self.trouble or 'it does not connect'}")
            print(f"{self.name}: {self.describe()}; {_UNKNOWN}", file=sys.stderr)
        self.users.add(user)

    def leave(self, user: object) -> None:
        """Disconnect, if nobody else uses it. Idempotent."""
        self.users.discard(user)
        if not self.users:
            self.close()

    def describe(self) -> str:
        """Return how fast it is."""
        usual, most = (1e3 * f(self.took) for f in (median, max))
        return f"{self.type} answers in {usual:.1f} ms, at most {most:.1f}: at most {1e3 / usual:.0f} Hz"

    def send(self, numbers: dict[str, float]) -> None:
        """Send numbers soon, with the newest of all others."""
        with self._wake:
            self._news |= numbers
            self._target = []
            self._wake.notify()

    # The thread.

    def _connect(self) -> None:
        try:
            self.robot = make_robot(self.type, self.config)
            self.robot.connect(calibrate=False)
            for _ in range(_SAMPLES):
                began = time.monotonic()
                self._observe()
                self.took.append(time.monotonic() - began)
        except BaseException as error:
            self.trouble = f"{type(error).__name__}: {error}"
            raise

    def _turn(self, ended: threading.Event) -> None:
        job, target = self.take(self.period)
        if job is not None:
            job()
        elif self.took:
            if target is not None:
                self._act()
            self._observe()

    def _act(self) -> None:
        with self._wake:
            news, self._news = self._news, {}
        action = {**{name: self.values[name] for name in self.robot.action_features}, **self.goal, **news}
        self.goal = {name: float(value) for name, value in self.robot.send_action(action).items()}

    def _observe(self) -> None:
        found = self.robot.get_observation()
        now = time.monotonic()
        values = {name: float(value) for name, value in found.items() if isinstance(value, (int, float))}
        values |= {name: float(value) for name, value in found.items() if getattr(value, "shape", None) == ()}
        self.past.append((now, values))
        self.values, self.t = values, now
        self.seq, self.trouble = self.seq + 1, ""

    def fail(self, ended: threading.Event) -> None:
        self.trouble = self.trouble or "it fails, see above"
        ended.wait(_RETRY)

    def _leave(self) -> None:
        robot, self.robot, self.took = self.robot, None, []
        if robot is not None and robot.is_connected:
            robot.disconnect()


class LeRobotArm(RobotDriver):
    """The joints of a robot of LeRobot (settings: :class:`RobotSettings`)."""

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = s = RobotSettings.of(spec)
        n = len(spec.joints)
        self._signs, self._offsets = s.signs or (1.0,) * n, s.offsets or (0.0,) * n
        self._link = Link.of(spec.name, s.type, s.config)
        self._link.period = 0.5 / spec.rate_hz
        self._is_open = False
        self._fault: Fault | None = None

    def open(self) -> None:
        """Connect. What LeRobot's ``connect`` switches on holds."""
        self._link.open(self)
        self._is_open, self._fault = True, None

    def close(self) -> None:
        """Disconnect: the arm holds, where LeRobot's robot lets it. Idempotent."""
        self._is_open = False
        self._link.leave(self)

    def _check(self, now: float) -> Link:
        link = self._link
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open")
        if now - link.t > link.silence:
            raise ConnectionLost.of(self.spec.name, _SILENT)
        return link

    def _joints(self, values: dict[str, float]) -> list[float]:
        turn = radians if self.settings.degrees else float
        numbers = [turn(values[name]) for name in self.settings.numbers]
        return [s * x + o for s, x, o in zip(self._signs, numbers, self._offsets, strict=True)]

    def read(self, now: float) -> Reading:
        """Return the newest observation; its time is when it came."""
        link = self._check(now)
        (t, before), (newest, values) = link.past[0], link.past[-1]
        q, dt = self._joints(values), max(newest - t, 1e-6)
        dq = [(y - x) / dt for x, y in zip(self._joints(before), q, strict=True)]
        taken = self._joints(link.goal) if set(self.settings.numbers) <= set(link.goal) else None
        if taken is not None and self._fault is None:
            off = max(abs(a - b) for a, b in zip(taken, q, strict=True))
            self._fault = None if isfinite(sum(q)) and off < _APART else _NOT_FOLLOWING
        return Reading(link.t, link.t, link.seq, q, dq, q_commanded=taken, fault=self._fault)

    def write(self, setpoint: Setpoint) -> bool:
        """Send a set-point soon."""
        link = self._check(time.monotonic())
        if self._fault is not None:
            return False
        back = degrees if self.settings.degrees else float
        numbers = [back((x - o) * s) for s, x, o in zip(self._signs, setpoint.q, self._offsets, strict=True)]
        link.send(dict(zip(self.settings.numbers, numbers, strict=True)))
        return True

    def halt(self) -> None:
        """Leave the arm at its last set-point."""

    def recover(self) -> None:
        """Begin again where the arm is. Raises ConnectionLost."""
        link = self._check(time.monotonic())
        for name in self.settings.numbers:
            link.goal.pop(name, None)
        self._fault = None

    def statistics(self) -> dict[str, Any]:
        """Return how long observations took when it was opened, s."""
        return {
            "observation_s": median(self._link.took or [0.0]),
            "longest_observation_s": max(self._link.took or [0.0]),
        }


class LeRobotGripper(GripperDriver):
    """One number of the same robot as a gripper (settings: :class:`GripperSettings`). Its force cannot be chosen."""

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = s = GripperSettings.of(spec)
        self._link = Link.of(spec.name, s.type, s.config)
        self._is_open = False

    def open(self) -> None:
        """Connect. Nothing moves."""
        self._link.open(self)
        self._is_open = True
        self._target: float | None = None
        self._ramp = self._speed = 0.0
        self._now, self._t_moved, self._still_at = -inf, -inf, -inf

    def close(self) -> None:
        """Disconnect. Idempotent."""
        self._is_open = False
        self._link.leave(self)

    def _width(self) -> float:
        s = self.settings
        share = (self._link.values[s.number] - s.closed) / (s.opened - s.closed)
        return min(self.spec.width_max, max(0.0, self.spec.width_at(share)))

    def _check(self, now: float) -> Link:
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open")
        if now - self._link.t > self._link.silence:
            raise ConnectionLost.of(self.spec.name, _SILENT)
        return self._link

    def read(self, now: float) -> GripperReading:
        """Return the newest observation, and move the goal along."""
        link, dt, self._now = self._check(now), min(now - self._now, 0.1), now
        width, goal = self._width(), self._target
        if abs(width - self._still_at) > _NEAR / 4.0:
            self._still_at, self._t_moved = width, now
        if goal is not None and self._ramp != goal:
            step = self._speed * dt
            self._ramp += max(-step, min(step, goal - self._ramp))
            s = self.settings
            link.send({s.number: s.closed + self.spec.travel_at(self._ramp) * (s.opened - s.closed)})
        apart = 0.0 if goal is None else width - goal
        moving = (goal is not None and self._ramp != goal) or (abs(apart) > _NEAR and now - self._t_moved < _REST)
        grasped = goal is not None and not moving and apart > _NEAR
        return GripperReading(link.t, link.t, link.seq, width, width if goal is None else goal, moving, grasped)

    def move(self, width: float, speed: float, force: float) -> None:
        """Move its goal along to ``width`` (m) at ``speed`` (m/s)."""
        self._check(time.monotonic())
        self._target, self._speed = min(max(width, 0.0), self.spec.width_max), speed
        self._ramp, self._t_moved = self._width(), self._now

    def stop(self) -> None:
        """Keep the goal that was sent last."""
        if self._is_open and self._target is not None:
            self._target = self._ramp


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Connect to a robot, and say how fast it is. LeRobot's ``connect`` may switch its torque on."""
    driver = LeRobotArm(spec)
    try:
        driver.open()
        found, fastest = driver._link.describe(), 1.0 / median(driver._link.took)
    except ConnectionLost as error:
        yield CheckResult("robot", "fail", str(error), "try it with LeRobot's own programs first")
        return
    finally:
        driver.close()
    if fastest < spec.rate_hz:
        yield CheckResult(
            "robot", "warn", found, f"the model has rate_hz {spec.rate_hz:g}: some set-points are left out"
        )
    else:
        yield CheckResult("robot", "ok", found)
    yield CheckResult("limits", "unknown", _UNKNOWN, "try with a hand on its power switch what happens")
