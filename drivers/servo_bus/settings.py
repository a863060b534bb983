"""Settings of an arm on a servo bus: the ``real:`` part of a rig file, checked before a device is opened."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from hal.config.files import DeviceSettings
from hal.specs import GripperSpec, RobotSpec

from .dynamixel import Dynamixel
from .feetech import Feetech
from .protocol import Calibration, ServoProtocol

PROTOCOLS: dict[str, type[ServoProtocol]] = {"feetech": Feetech, "dynamixel": Dynamixel}
"""By the driver."""
ANSWER = 0.008
"""Longest time to wait for answers in a cycle of 100 Hz, s."""
MotorId = Annotated[int, Field(ge=0, le=252, strict=True)]


class ServoSettings(DeviceSettings):
    """Settings under ``real:`` that an arm and its gripper share."""

    port: str
    """Serial device of the servo bus, best ``/dev/serial/by-id/...``: the number of a ``/dev/ttyACM0`` may change."""
    baud: Literal[57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000] = 1_000_000
    """Bit/s, to which all motors are set."""
    calibration: str | None = None
    """LeRobot's calibration file of this arm: it must be what the motors hold. None: the motors' own is used."""

    def read_calibration(self) -> dict[int, Calibration]:
        """Return the calibration in the file, by the motors' ids; empty without a file. Raises ValueError, OSError."""
        if self.calibration is None:
            return {}
        found = {}
        for entry in json.loads(Path(self.calibration).read_text(encoding="utf-8")).values():
            found[int(entry["id"])] = Calibration(*(int(entry[key]) for key in Calibration._fields))
        return found


class ServoArmSettings(ServoSettings):
    """Settings under ``real:`` of an arm."""

    ids: tuple[MotorId | Annotated[tuple[MotorId, ...], Field(min_length=1)], ...]
    """Ids of the motors, from base to tip; a list of ids for motors that turn one joint together."""
    reversed: tuple[str, ...] = ()
    """Joints whose motors count against the model's direction."""
    zero: int | None = None
    """Count of every motor where its joint is 0; None for the middle of its calibrated range, as LeRobot has it."""

    @property
    def motors(self) -> tuple[tuple[int, ...], ...]:
        """Ids of the motors of each joint."""
        return tuple(ids if isinstance(ids, tuple) else (ids,) for ids in self.ids)


class ServoGripperSettings(ServoSettings):
    """Settings under ``real:`` of a gripper with one motor on the bus of its arm."""

    id: MotorId
    widths: Annotated[tuple[tuple[float, float], ...], Field(min_length=2)] | None = None
    """Angle of the motor from :attr:`zero`, rad, and width, m, both rising; None: the ends of the calibrated range are
    those of the model, closed at the least count."""
    zero: int = 2048
    """Count at which the angle is 0."""


def check_baud(driver: str, motors: int, baud: int) -> Iterator[tuple[str, str]]:
    """Yield message and code for a rate at which a reading of so many motors takes too long."""
    took = PROTOCOLS[driver]().time_reading(motors, baud)
    if took > ANSWER:
        message = f"{baud} bit/s is too slow: a reading of {motors} motors takes {1e3 * took:.0f} ms, at most "
        yield f"{message}{1e3 * ANSWER:.0f} are allowed; set the motors, and this, to 1000000", "too_slow"


def group_key(options: Mapping[str, Any]) -> str | None:
    """Return a key that arms on one bus share, since only one process can open it. The options are not checked yet."""
    return str(options.get("port"))


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig file, message and code."""
    settings, problems = ServoArmSettings.check(spec)
    yield from problems
    if settings is None:
        return
    gripper = spec.gripper
    other = ServoGripperSettings.check(gripper)[0] if gripper is not None and gripper.driver == spec.driver else None
    own = [id for ids in settings.motors for id in ids]
    ids = [*own, *([other.id] if other is not None and other.port == settings.port else [])]
    twice = sorted({id for id in ids if ids.count(id) > 1})
    if twice:
        yield "real.ids", f"names motor {twice[0]} twice", "id_collision"
    if len(settings.ids) != len(spec.joints):
        message = f"has motors for {len(settings.ids)} joints, not {len(spec.joints)} ({', '.join(spec.joints)})"
        yield "real.ids", message, "wrong_count"
    unknown = [name for name in settings.reversed if name not in spec.joints]
    if unknown:
        yield "real.reversed", f"names {', '.join(unknown)}, which is no joint of the arm", "unknown_joint"
    yield from (("real.baud", *problem) for problem in check_baud(spec.driver, len(ids), settings.baud))
    yield from _check_file(settings, own)


def check_gripper(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a gripper's record: key in the gripper's entry of the rig file, message and code."""
    settings, problems = ServoGripperSettings.check(spec)
    yield from problems
    if settings is None:
        return
    if settings.widths is not None and any(a >= b for k in (0, 1) for a, b in pairwise(w[k] for w in settings.widths)):
        yield "real.widths", "angles and widths must rise", "not_rising"
    yield from _check_file(settings, [settings.id])


def _check_file(settings: ServoSettings, ids: Sequence[int]) -> Iterator[tuple[str, str, str]]:
    try:
        there = settings.read_calibration()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        yield "real.calibration", f"is no calibration of LeRobot: {error}", "invalid"
        return
    missing = [str(id) for id in ids if there and id not in there]
    if missing:
        yield "real.calibration", f"has no motor with id {', '.join(missing)}", "missing_key"
