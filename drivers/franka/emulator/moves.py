"""What a Move asks for, read out of its payload."""

from __future__ import annotations

import struct
from math import isfinite
from typing import NamedTuple

from .protocol import Controller, Generator
from .samples import Floats

__all__ = ["MoveOptions", "read_move"]

_MODES = struct.Struct("<II")
_DEVIATIONS = struct.Struct("<6d")
_SPEEDS = struct.Struct("<7d")
_ASYNCHRONOUS = _MODES.size + _DEVIATIONS.size
"""Where protocol 10 goes on, and protocol 5 ends."""


class MoveOptions(NamedTuple):
    """The kind of motion."""

    controller: Controller
    generator: Generator
    asynchronous: bool = False
    """Targets come at any rate, and the robot makes the motion between them."""
    speeds: Floats = (0.0,) * 7
    """Of the asynchronous generator, rad/s."""

    def describe(self) -> str:
        """In words."""
        if self.generator is Generator.NONE:
            return "torques"
        words = f"{self.generator.name}, {self.controller.name}".lower().replace("_", " ")
        return words + (", asynchronous" if self.asynchronous else "")


def read_move(payload: bytes) -> MoveOptions:
    """Raises ValueError for what cannot be."""
    controller_number, generator_number = _MODES.unpack_from(payload)
    controller, generator = Controller(controller_number), Generator(generator_number)
    if not all(isfinite(value) for value in _DEVIATIONS.unpack_from(payload, _MODES.size)):
        raise ValueError("a deviation is not finite")
    if generator is Generator.NONE and controller is not Controller.EXTERNAL:
        raise ValueError("neither positions nor torques")
    if len(payload) == _ASYNCHRONOUS:
        return MoveOptions(controller, generator)
    asynchronous, speeds = payload[_ASYNCHRONOUS] != 0, _SPEEDS.unpack_from(payload, _ASYNCHRONOUS + 1)
    if asynchronous and (generator is not Generator.JOINT_POSITION or controller is Controller.EXTERNAL):
        raise ValueError("only joint positions can be asynchronous")
    if asynchronous and not all(isfinite(speed) and speed > 0.0 for speed in speeds):
        raise ValueError("a speed that is not above 0")
    return MoveOptions(controller, generator, asynchronous, speeds)
