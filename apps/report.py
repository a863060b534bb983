"""``--report``: how a run went, measured, as JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.types import RobotState

__all__ = ["RunReport", "check_writable"]


class RunReport:
    """Collects while an app runs; :meth:`write` asks the rig for the rest. Times in ms, lengths in m."""

    def __init__(self, rig: Rig, robot: Robot) -> None:
        from hal.histogram import Histogram

        self._rig = rig
        self._robot = robot
        self.start = rig.clock.now()
        self._ages = Histogram(1e-4, 5000)
        self._travel = 0.0
        self._position: Any = None
        self.trips: list[dict[str, Any]] = []
        self.faults: list[dict[str, Any]] = []

    def follow(self, robot: Robot) -> None:
        """Report about this arm, which is driven from now on. The travel of all of them adds up."""
        self._robot, self._position = robot, None

    def saw(self, state: RobotState) -> None:
        """Note a state that the app looked at."""
        self._ages.add(self._rig.clock.now() - state.stamp.t)
        position = state.tcp.position
        if self._position is not None:
            delta = position - self._position
            self._travel += float(delta @ delta) ** 0.5
        self._position = position

    def tripped(self, reason: str) -> None:
        """Note a trip."""
        self.trips.append({"t_s": round(self._rig.clock.now() - self.start, 3), "reason": reason})

    def faulted(self, cause: str) -> None:
        """Note a fault."""
        self.faults.append({"t_s": round(self._rig.clock.now() - self.start, 3), "cause": cause})

    def collect(self, clean_exit: bool) -> dict[str, Any]:
        """Everything so far. Call it while the rig is open."""
        rig, robot = self._rig, self._robot
        group = next(g for g in rig.statistics().values() if robot.name in g["robots"])
        own = group["robots"][robot.name]
        latency = own["latency_s"]
        cameras = {}
        for name, camera in rig.cameras.items():
            counts = camera.counts()
            cameras[name] = {
                "frames": counts.frames,
                "fps": counts.fps,
                "age_ms_p50": _ms(counts.age_p50),
                "dropped": counts.dropped,
            }
        return {
            "backend": robot.spec.driver,
            "clock": rig.plan.clock,
            "duration_s": rig.clock.now() - self.start,
            "servo": {
                "rate_hz": robot.spec.rate_hz,
                "ticks": group["ticks"],
                "missed": group.get("missed", 0),
                "period_ms": _summary(group.get("period_s")),
                **{key: own[key] for key in ("reanchored", "reports", "report_lag", "report_noise", "mismatches")},
                "driver": own["driver"],
            },
            "latency_ms": {"p50": _ms(latency["p50"]), "p99": _ms(latency["p99"])},
            "state_age_ms": _summary(self._ages.summary()),
            "tcp_travel_m": self._travel,
            "tcp_end": self._end(),
            "peak": own["peak"],
            "cameras": cameras,
            "trips": self.trips,
            "faults": self.faults,
            "clean_exit": clean_exit,
        }

    def _end(self) -> dict[str, list[float]]:
        """Where the tcp is now, in the arm's base frame, m and xyzw."""
        tcp = self._robot.state(max_age=float("inf")).tcp
        return {"position": tcp.position.tolist(), "orientation": tcp.orientation.tolist()}

    @staticmethod
    def write(path: str, report: dict[str, Any]) -> None:
        """Write a report that :meth:`collect` made."""
        Path(path).write_text(json.dumps(report, indent=2) + "\n")


def check_writable(path: str) -> None:
    """Raise CommandError now rather than after the run when no file can be written there."""
    from hal.errors import CommandError

    if os.path.isdir(path) or (os.path.exists(path) and not os.access(path, os.W_OK)):
        raise CommandError(f"--report {path}: is a folder, or a file that cannot be written")
    folder = Path(path).resolve().parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise CommandError(f"--report {path}: the folder {folder} does not exist or cannot be written to")


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def _summary(summary: dict[str, float | None] | None) -> dict[str, float | None] | None:
    return None if summary is None else {name: _ms(value) for name, value in summary.items()}
