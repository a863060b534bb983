"""A person brings the arm from view to view, with a pad or by guiding it, and says when to look."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..errors import CommandError, MotionStopped

if TYPE_CHECKING:
    from ..gamepad import Gamepad
    from ..rig import Rig
    from ..robot import Robot
    from ..teleop import Teleop

__all__ = ["PadDriver", "enter"]

RATE_HZ = 50.0


def enter() -> bool:
    """Wait for Enter in the terminal. False when it came after a ``q``, or can never come."""
    try:
        answer = input("Enter takes a view; q and Enter ends: ")
    except EOFError:
        return False
    return not answer.strip().lower().startswith("q")


class PadDriver:
    """Drives the arm with a pad until a view is wanted. The gripper stays as it is: it may hold the board."""

    def __init__(self, rig: Rig, robot: Robot, pad: Gamepad, teleop: Teleop, say: Callable[[str], None]) -> None:
        actions = teleop.mapping.actions
        missing = [action for action in ("record", "finish") if action not in actions]
        if missing:
            raise CommandError(f"the mapping has no button for {', '.join(missing)}: add it to its actions")
        self._rig, self._robot, self._pad, self._teleop, self._say = rig, robot, pad, teleop, say
        self._take, self._finish = actions["record"], actions["finish"]
        self._deadman = pad.hold(teleop.mapping.deadman)
        if rig.console is not None:
            rig.console.explain(teleop.labels(actions=("record", "finish")))

    def help(self) -> list[str]:
        """What the controls do, for people."""
        return [*self._teleop.help(self._pad), f"{self._take}: take a view, {self._finish}: no more views"]

    def wait(self) -> bool:
        """Drive until a view is wanted (True), or no more are (False). The arm then rests, and no session is open.

        Whoever takes a view looks at the picture for longer than a command may be late.
        """
        told = ""
        down = self._buttons()  # what is down now was meant for the last view
        with self._robot.control(deadman=self._deadman, rate_hz=RATE_HZ) as control:
            self._teleop.reset()
            for tick in self._rig.clock.rate(RATE_HZ):
                motion, _ = self._teleop.step(self._pad.state(), tick.dt)
                try:
                    control.send(motion)
                    told = ""
                except MotionStopped as stop:
                    if str(stop) != told:
                        told = str(stop)
                        self._say(f"STOPPED: {stop}")
                before, down = down, self._buttons()
                if self._take in down - before:
                    return True
                if self._finish in down - before or self._pad.finished:
                    return False
        return False

    def _buttons(self) -> set[str]:
        state = self._pad.state()
        return {button for button in (self._take, self._finish) if state.pressed(button)}
