"""Settings of an arm on a Feetech servo bus: the ``real:`` part of a rig file, checked before a device is opened."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from hal.config.files import DeviceSettings
from hal.specs import GripperSpec, RobotSpec

MotorId = Annotated[int, Field(ge=0, le=252, strict=True)]


class Calibration(NamedTuple):
    """What LeRobot's calibration stores for a motor, in counts of 1/4096 turn."""

    homing_offset: int
    """Subtracted by the motor from what its encoder reads."""
    range_min: int
    range_max: int
    """Ends of the joint's way, as the motor then reports them."""


class FeetechSettings(DeviceSettings):
    """Settings under ``real:`` that an arm and its gripper share."""

    port: str
    """Serial device of the servo bus, best ``/dev/serial/by-id/...``: the number of a ``/dev/ttyACM0`` may change."""
    calibration: str | None = None
    """LeRobot's calibration file of this arm: it must be what the motors hold. None: the motors' own is used."""

    def read_calibration(self) -> dict[int, Calibration]:
        """Return the calibration in the file, by the motors' ids; empty without a file. Raises ValueError, OSError."""
        if self.calibration is None:
            return {}
        found = {}
        for name, entry in json.loads(Path(self.calibration).read_text(encoding="utf-8")).items():
            if entry["drive_mode"]:
                raise ValueError(f"{name} has drive_mode {entry['drive_mode']}: an SO-101's motors all turn forwards")
            found[int(entry["id"])] = Calibration(*(int(entry[key]) for key in Calibration._fields))
        return found


class FeetechArmSettings(FeetechSettings):
    """Settings under ``real:`` of an arm."""

    ids: tuple[MotorId, ...] = (1, 2, 3, 4, 5)
    """Ids of the motors, from base to tip."""


class FeetechGripperSettings(FeetechSettings):
    """Settings under ``real:`` of a gripper with one motor on the bus of its arm."""

    id: MotorId = 6


def group_key(options: Mapping[str, Any]) -> str | None:
    """Return a key that arms on one bus share, since only one process can open it. The options are not checked yet."""
    return str(options.get("port"))


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig file, message and code."""
    settings, problems = FeetechArmSettings.check(spec)
    yield from problems
    if settings is None:
        return
    gripper = spec.gripper
    other = FeetechGripperSettings.check(gripper)[0] if gripper is not None and gripper.driver == spec.driver else None
    ids = [*settings.ids, *([other.id] if other is not None and other.port == settings.port else [])]
    twice = sorted({id for id in ids if ids.count(id) > 1})
    if twice:
        yield "real.ids", f"names motor {twice[0]} twice", "id_collision"
    if len(settings.ids) != len(spec.joints):
        message = f"has {len(settings.ids)} motors for {len(spec.joints)} joints ({', '.join(spec.joints)})"
        yield "real.ids", message, "wrong_count"
    yield from _check_file(settings, settings.ids)


def check_gripper(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a gripper's record: key in the gripper's entry of the rig file, message and code."""
    settings, problems = FeetechGripperSettings.check(spec)
    yield from problems
    if settings is not None:
        yield from _check_file(settings, (settings.id,))


def _check_file(settings: FeetechSettings, ids: tuple[int, ...]) -> Iterator[tuple[str, str, str]]:
    try:
        there = settings.read_calibration()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        yield "real.calibration", f"is no calibration of LeRobot: {error}", "invalid"
        return
    missing = [str(id) for id in ids if there and id not in there]
    if missing:
        yield "real.calibration", f"has no motor with id {', '.join(missing)}", "missing_key"
