"""All errors of this package, in one tree.

    HalError
    ├── ConfigError (ValueError)            a rig, a model or a mapping is wrong; lists every problem
    ├── CommandError (ValueError)           a command or an argument is invalid; nothing was sent
    │   └── CollisionError                  a motion would collide; nothing moved
    ├── DatasetError (ValueError)           a file of a recording is missing or damaged; names the file and the episode
    ├── Unreachable (ValueError)            no joint position reaches the pose, or the way to it ends before
    ├── DriverMissing (ImportError)         a library is not installed; names the command that installs it
    ├── DeviceNotFound (LookupError)        no such device; lists those that are there
    ├── ConnectionLost (ConnectionError)    the device, or the process that owned it, does not answer
    ├── StaleStateError (TimeoutError)      the newest state or frame is too old to act on
    ├── MotionStopped (RuntimeError)        a stop is latched; states its reason and how to acknowledge it
    ├── RobotFault (RuntimeError)           the robot reports a fault; carries cause and remedy
    ├── PolicyError (RuntimeError)          a policy, or its server, does not answer, or answers with nonsense
    ├── ControlTaken (RuntimeError)         another session or program controls this arm
    └── NotSupported (NotImplementedError)  this driver or this rig cannot do that

Each is also the builtin error in brackets. Every error has a ``code``, a stable identifier of the case.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import Any

__all__ = [
    "CollisionError",
    "CommandError",
    "ConfigError",
    "ConnectionLost",
    "ControlTaken",
    "DatasetError",
    "DeviceNotFound",
    "DriverMissing",
    "Fault",
    "HalError",
    "MotionStopped",
    "NotSupported",
    "PolicyError",
    "Problem",
    "RobotFault",
    "StaleStateError",
    "Unreachable",
]


class HalError(Exception):
    """Base class of every error that this package raises on purpose.

    Args:
        args: The message, as for any exception.
        code: Stable identifier of this case, in lower_snake_case; None for the class's own ``code``.
    """

    code: str = "error"
    """Stable identifier of the case, for programs and tests. The wording of a message may change, its code does not."""

    def __init__(self, *args: object, code: str | None = None, **more: object) -> None:
        super().__init__(*args, **more)  # such as the `name` of an ImportError
        if code is not None:
            self.code = code


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a device, with its cause and its remedy."""

    code: str
    """Identifier of the fault, as the device or its driver names it."""
    cause: str
    """The cause, in words."""
    remedy: str
    """The remedy, in words."""

    def __str__(self) -> str:
        return f"{self.cause} ({self.code}); {self.remedy}"


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake in a configuration file."""

    file: str
    """The file, or a description such as ``<dict>`` or ``--set``."""
    key: str
    """Dotted path of the key, for example ``robots.panda.base.position``."""
    message: str
    """The mistake, and what would be right."""
    code: str = "invalid"
    """Stable identifier of the kind of problem, for example ``unknown_key`` or ``missing_file``."""

    def __str__(self) -> str:
        place = f"{self.file}: {self.key}" if self.key else self.file
        return f"{place}: {self.message}"


class ConfigError(HalError, ValueError):
    """A configuration is wrong. ``problems`` holds every problem, not only the first."""

    code = "config"

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        count = len(self.problems)
        head = "1 problem" if count == 1 else f"{count} problems"
        super().__init__(f"{head} in the configuration:\n" + "\n".join(f"  - {problem}" for problem in self.problems))


class CommandError(HalError, ValueError):
    """A command has the wrong shape, a non-finite number or an impossible value. Nothing was sent."""

    code = "bad_command"


class CollisionError(CommandError):
    """A motion would bring two shapes nearer than the margin. Nothing moved."""

    code = "collision"

    def __init__(self, robot: str, first: str, second: str, distance: float, along: float) -> None:
        nearest = f"{1e3 * distance:.0f} mm apart" if distance > 0.0 else "in each other"
        super().__init__(
            f"the motion of {robot} would collide: {first} and {second} are {nearest} {100.0 * along:.0f} % of the way"
        )
        self.first = first
        """Name of the link."""
        self.second = second
        """Name of the other link, or of the box."""
        self.distance = distance
        """Their distance there, m; negative if they overlap."""
        self.along = along
        """Where on the way that is, from 0 (its start) to 1 (its end)."""


class DatasetError(HalError, ValueError):
    """A file of a recording is missing, truncated or damaged, or does not fit the other files."""

    code = "bad_dataset"

    file: str | None = None
    """The file, relative to the dataset's folder; None where the error is not about one file."""
    episode: int | None = None
    """Number of the episode; None where the error is about the whole dataset."""

    def __init__(
        self, message: str, *, file: str | None = None, episode: int | None = None, code: str | None = None
    ) -> None:
        place = [] if episode is None else [f"episode {episode}"]
        super().__init__(": ".join([*place, *([file] if file else []), message]), code=code)
        self.file, self.episode = file, episode


class Unreachable(HalError, ValueError):
    """No joint position within the limits reaches the pose, or the way there cannot be followed.

    ``code`` is ``unreachable``; for a way also ``joint_limit``, ``singular`` or ``outside_workspace``.
    """

    code = "unreachable"

    def __init__(
        self,
        message: str,
        *,
        position_error: float,
        rotation_error: float,
        q: tuple[float, ...] | None = None,
        along: float | None = None,
        distance: float | None = None,
        code: str | None = None,
    ) -> None:
        if along is None or distance is None:
            place = f"closest found: {position_error:.4f} m, {rotation_error:.4f} rad away"
        else:
            place = f"after {100.0 * along:.0f} % of the way, {distance:.3f} m from its start"
        super().__init__(f"{message} ({place})", code=code)
        self.position_error = position_error
        """Distance of the closest position found, m; on a way, at the first pose that is not reached."""
        self.rotation_error = rotation_error
        """Angle to the closest orientation found, rad; likewise."""
        self.q = q
        """The closest joint positions found (n,), rad, or the last ones on a way; None if there are none."""
        self.along = along
        """Share of the way that can be followed, from 0 to 1; None if the error is not about a way."""
        self.distance = distance
        """The same in m along the way of the tcp (rad for a way in joint space); None likewise."""


class DriverMissing(HalError, ImportError):
    """A driver's library is not installed. The message has the command that installs it."""

    code = "driver_missing"

    def __init__(self, *args: object, name: str | None = None, code: str | None = None) -> None:
        super().__init__(*args, code=code)
        self.name = name
        """Import name of the library, as for any ImportError; None if there is no single one."""


def find_closest(word: str, choices: Iterable[str]) -> str | None:
    """Return the one of ``choices`` that ``word`` probably means; None if none is near."""
    return next(iter(get_close_matches(word, sorted(choices), n=1)), None)


def suggest(word: str, choices: Iterable[str]) -> str:
    """Return ``"; did you mean ...? available: ..."`` for a name that is not among ``choices``."""
    known = sorted(choices)
    close = find_closest(word, known)
    hint = f"; did you mean {close!r}?" if close else ";"
    return f"{hint} available: {', '.join(known)}" if known else "; none are available"


def import_library(name: str, why: str, install: str) -> Any:
    """Return the module of a library that is installed on request, as ``robot-hal[export]``.

    Raises DriverMissing, with the command that installs it, if it cannot be imported; ``why`` is what needs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise DriverMissing(f"{why} needs {name} ({error}): pip install '{install}'", name=name) from error


class DeviceNotFound(HalError, LookupError):
    """No such device. The message lists those that are there."""

    code = "device_not_found"


class ConnectionLost(HalError, ConnectionError):
    """A device, or the process that owns it, does not answer."""

    code = "connection_lost"

    fault: Fault | None = None
    """Cause and remedy, if the driver reported them."""
    final: bool = False
    """Whether the device cannot come back (a recording has ended); there is then no attempt to reconnect."""

    @classmethod
    def of(cls, name: str, fault: Fault) -> ConnectionLost:
        """Return the error of the device ``name`` that does not answer because of a fault."""
        error = cls(f"{name}: {fault.cause}; {fault.remedy}", code=fault.code)
        error.fault = fault
        return error


class StaleStateError(HalError, TimeoutError):
    """The newest state or frame is older than the caller allows."""

    code = "stale_state"


class MotionStopped(HalError, RuntimeError):
    """A stop is latched: nothing moves until it is acknowledged (see ``Control.rearm``).

    ``code`` is that of the trip (:attr:`hal.Trip.code`), or names another reason, for example ``deadman_released``.
    """

    code = "motion_stopped"

    def __init__(self, reason: str, remedy: str = "", *, code: str | None = None) -> None:
        super().__init__(f"{reason}; {remedy}" if remedy else reason, code=code)
        self.reason = reason
        self.remedy = remedy


class RobotFault(HalError, RuntimeError):
    """The robot, or a gripper, reports a fault. Only the user clears it, with ``recover()``."""

    code = "robot_fault"

    def __init__(self, cause: str, remedy: str, *, code: str | None = None) -> None:
        super().__init__(f"{cause}; {remedy}" if remedy else cause, code=code)
        self.cause = cause
        self.remedy = remedy


class PolicyError(HalError, RuntimeError):
    """A policy, or the server on which it runs, does not answer in time, or answers with something unusable."""

    code = "policy_error"


class ControlTaken(HalError, RuntimeError):
    """Another control session, or another program, controls this device."""

    code = "control_taken"


class NotSupported(HalError, NotImplementedError):
    """This driver or this rig cannot do that. The message names what can."""

    code = "not_supported"
