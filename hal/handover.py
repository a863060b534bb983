"""From a person's hand to a program's: when may a program's motion begin, or go on after a pause?"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .commands import JointChunk, JointTarget
from .types import RobotStatus

if TYPE_CHECKING:
    from .control import Control

__all__ = ["follows", "wait_here"]


def follows(control: Control) -> bool:
    """Does the arm follow commands now? Until it does, it is told to stay where it is; call it once a turn.

    A command that was sent before the servo has seen a new press of the dead-man does not count. Nothing of a motion
    that has a beginning is lost so, for it is sent only when this is True. Raises what ``control.send`` raises.
    """
    held = control.deadman is None or control.deadman.held
    if held and control.status is RobotStatus.FOLLOWING:
        return True
    control.send(JointTarget(control.robot.state().q_set))
    return False


def wait_here(control: Control, seconds: float) -> None:
    """Stay, for up to so many s (3 at most): until a motion that is not known yet begins. Later than that is a trip."""
    now, q_set = control.robot.clock.now(), control.robot.state().q_set
    control.send(JointChunk([now, now + seconds], [q_set, q_set]))
