"""What can be wrong with a Franka Hand, beyond what its client library says: cause and remedy."""

from __future__ import annotations

from hal.types import Fault

__all__ = ["holding", "lost", "no_answer", "not_homed", "stop_ignored", "stop_released"]


def not_homed(max_width: float, expected: float) -> Fault:
    """It says that its fingers open ``max_width`` m, and the rig says ``expected`` m."""
    return Fault(
        "not_homed",
        f"the hand does not know how far its fingers open: it says {max_width:.4g} m, and the rig {expected:.4g} m",
        "take everything out of its fingers and home it (gripper.home()); if it says so after that, too, set the "
        "gripper's width_max in the rig",
    )


def holding(what: str) -> Fault:
    """It holds something, which keeps it from doing ``what``."""
    return Fault("holding", f"the hand holds something, and cannot {what} while it does", "open the fingers first")


def no_answer(motion: str, bound: float) -> Fault:
    """It has not ended ``motion`` within ``bound`` s."""
    return Fault(
        "no_answer",
        f"the hand did not end its {motion} within {bound:.1f} s",
        "see that nothing is in the way of its fingers; if it stays like that, switch the hand off and on in Desk",
    )


def stop_ignored() -> Fault:
    """The fingers move although they were told to stop."""
    return Fault(
        "stop_ignored",
        "the fingers go on moving although the hand was told to stop (this hand is known for it: libfranka, issue 18)",
        "keep clear until they rest; the next command begins when this motion is over",
    )


def stop_released() -> Fault:
    """A stop took the force away from what the hand held."""
    return Fault(
        "stop_released",
        "the hand let go of what it held when it was told to stop (libfranka, issue 111)",
        "see where it fell; open the fingers, then grasp it again",
    )


def lost(why: str) -> Fault:
    """The connection went while a command was on its way."""
    return Fault("lost", why, "see where the fingers are, then send the command again; none is sent a second time")
