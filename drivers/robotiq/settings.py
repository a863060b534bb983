"""Settings of a Robotiq gripper: the ``real:`` part of its entry in a rig file, and the figures of the models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, Field

from hal import serial_line
from hal.config.files import DeviceSettings
from hal.config.schema import Host, ValueProblem, is_own_host
from hal.specs import GripperSpec


class Figures(NamedTuple):
    """Speed of the width, m/s, and force, N, for the registers' 0 and 255."""

    speed: tuple[float, float]
    force: tuple[float, float]


MODELS = {
    "2f85": Figures((0.020, 0.150), (20.0, 235.0)),
    "2f140": Figures((0.030, 0.250), (10.0, 125.0)),
    "hand_e": Figures((0.020, 0.150), (20.0, 185.0)),
}
"""Of the instruction manual "2F-85 & 2F-140" (2019-02-06) and, for the Hand-E, of Robotiq's page of these grippers."""


def _check_counts(counts: tuple[int, int]) -> tuple[int, int]:
    if counts[1] - counts[0] < 50:
        raise ValueProblem(f"must be the counts when open and when closed, not {list(counts)}", "wrong_order")
    return counts


Byte = Annotated[int, Field(ge=0, le=255, strict=True)]


class RobotiqSettings(DeviceSettings):
    """Settings under ``real:`` of a Robotiq gripper: a serial ``port``, or the ``host`` of a UR with the URCap."""

    model: Literal["2f85", "2f140", "hand_e"]
    port: str | None = None
    """Serial device of the RS-485 adapter."""
    host: Host | None = None
    """Address of a UR's controller, with Robotiq's URCap on it."""
    slave: Annotated[int, Field(ge=1, le=247, strict=True)] = 9
    """Modbus address; 9 as delivered."""
    counts: Annotated[tuple[Byte, Byte], AfterValidator(_check_counts)] = (3, 230)
    """Position that the gripper reports when open and when closed. The default is what Robotiq names for a 2F-85 with
    its own fingertips (blog.robotiq.com/knowledge/encoder-bytes-adaptive-gripper)."""

    @property
    def place(self) -> str:
        return self.port or f"{self.host}:63352"


def check_gripper(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a gripper's record: key in the gripper's entry of the rig file, message and code."""
    settings, problems = RobotiqSettings.check(spec)
    yield from problems
    if settings is not None and (settings.port is None) == (settings.host is None):
        found = "neither" if settings.port is None else "both"
        text = f"needs either port (/dev/serial/by-id/...) or host (the address of a UR with the URCap), not {found}"
        yield "real.port", text, "missing_key" if settings.port is None else "conflict"


def is_emulated(options: Mapping[str, Any]) -> bool:
    return is_own_host(options) if options.get("port") is None else serial_line.is_emulated(options)
