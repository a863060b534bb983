"""Stops that are latched: in words, and until somebody acknowledges them."""

from __future__ import annotations

from .errors import MotionStopped
from .types import Trip

__all__ = ["StopLatch", "trip_text"]

_TRIPS = {
    Trip.COMMAND_LATE: "the commands stopped coming",
    Trip.DEADMAN_SILENT: "the dead-man's pad gave no sign of life",
    Trip.DEADMAN_LOST: "the dead-man's pad was disconnected",
    Trip.STOP: "rig.stop() was called",
    Trip.APP_SILENT: "the app did not answer",
    Trip.FAULT: "the robot reported a fault",
    Trip.DEVICE_LOST: "the robot does not answer",
    Trip.BAD_READING: "the robot reported numbers that cannot be",
    Trip.HOST_LATE: "the servo's own process was stopped, or could not run, for too long",
    Trip.LIMIT: "driven by torques, the arm came to a limit of speed, position or workspace, or did not come to rest",
}


class StopLatch:
    """Remembers that ``rig.stop()`` was called until somebody acknowledges it."""

    def __init__(self) -> None:
        self.stopped = False

    def check(self) -> None:
        """Raise MotionStopped while the stop is not acknowledged."""
        if self.stopped:
            raise MotionStopped("rig.stop() was called", "call rig.rearm() when it is safe to move again")


def trip_text(trip: Trip) -> str:
    """A trip in words."""
    return _TRIPS.get(trip, trip.name.lower())
