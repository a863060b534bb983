"""One program at a time per arm, on this computer."""

from __future__ import annotations

from hal.lock import DeviceLock

__all__ = ["claim_arm"]


def claim_arm(host: str) -> DeviceLock:
    """Hold the arm at ``host`` for this process. Raises ControlTaken, with the other program's number.

    The arm's process of a program that has just ended brakes first: so it is waited for, 1 s.
    """
    return DeviceLock(f"franka-{host}", f"the arm at {host}", patience=1.0)
