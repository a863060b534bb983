"""What an arm answers to the requests that come over TCP, and what they make it do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .arm import Arm
from .moves import read_move
from .protocol import Generator, Outcome
from .setters import SETTERS

__all__ = ["Files", "Requests"]

_WALL = bytes(24 + 128 + 1)
"""GetCartesianLimit: size, frame, whether it is on. There is no virtual wall."""


@dataclass(frozen=True)
class Files:
    """What a client may ask the robot for."""

    urdf: bytes
    model_library: bytes | None = None
    """A shared object; none here comes from Franka."""


class Requests:
    """Takes requests apart, one at a time, and has the arm act and answer."""

    def __init__(self, arm: Arm, files: Files) -> None:
        self._arm = arm
        self._files = files
        self._handlers: dict[str, Callable[[int, bytes], None]] = {
            "Move": self._move,
            "StopMove": self._stop,
            "AutomaticErrorRecovery": self._recover,
            "GetRobotModel": self._model,
            "LoadModelLibrary": self._library,
            "GetCartesianLimit": self._wall,
        }

    def take(self, name: str, number: int, payload: bytes) -> None:
        """Serve one request, whose payload has the right size."""
        if name in SETTERS:
            self._set(name, number, payload)
        else:
            self._handlers[name](number, payload)

    def _set(self, name: str, number: int, payload: bytes) -> None:
        arm = self._arm
        if arm.motion is not None:  # that nothing can be set then is an assumption
            arm.answer(name, number, Outcome.NOT_POSSIBLE)
            return
        reason = arm.settings.take(name, payload)
        text = "taken" if reason is None else f"refused, {reason}"
        arm.journal.say("setting", f"{name}: {text}", name=name, refused=reason)
        arm.answer(name, number, Outcome.SUCCESS if reason is None else Outcome.INVALID)

    def _move(self, number: int, payload: bytes) -> None:
        arm = self._arm
        try:
            options = read_move(payload)
        except ValueError as error:
            self._refuse(number, Outcome.INVALID, str(error))
            return
        if options.generator in (Generator.CARTESIAN_POSITION, Generator.CARTESIAN_VELOCITY):
            self._refuse(number, Outcome.NOT_POSSIBLE, "Cartesian motions are not emulated")
            return
        reason = arm.move(number, options)
        if reason is not None:
            self._refuse(number, reason, f"the robot's mode is {arm.mode.name.lower()}")

    def _refuse(self, number: int, outcome: Outcome, why: str) -> None:
        self._arm.journal.say("refused", f"Move refused: {why}")
        self._arm.answer("Move", number, outcome)

    def _stop(self, number: int, payload: bytes) -> None:
        self._arm.answer("StopMove", number, self._arm.stop())

    def _recover(self, number: int, payload: bytes) -> None:
        outcome = self._arm.recover()
        self._arm.journal.say("recovery", f"automatic error recovery: {outcome.value}", outcome=outcome.value)
        self._arm.answer("AutomaticErrorRecovery", number, outcome)

    def _model(self, number: int, payload: bytes) -> None:
        self._arm.answer("GetRobotModel", number, Outcome.SUCCESS, self._files.urdf)

    def _library(self, number: int, payload: bytes) -> None:
        library = self._files.model_library
        outcome = Outcome.NOT_POSSIBLE if library is None else Outcome.SUCCESS
        self._arm.answer("LoadModelLibrary", number, outcome, library or b"")

    def _wall(self, number: int, payload: bytes) -> None:
        self._arm.answer("GetCartesianLimit", number, Outcome.SUCCESS, _WALL)
