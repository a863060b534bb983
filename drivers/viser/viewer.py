"""The app's side of the page: it starts the process behind it and hears what people drag."""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from importlib.metadata import version
from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hal import registry
from hal.errors import ConnectionLost, DeviceNotFound, DriverMissing
from hal.geometry import Pose
from hal.host.process import Child
from hal.specs import to_json
from hal.views import Viewer3D

from .goals import checked_pose

if TYPE_CHECKING:
    from hal.rig import Rig

__all__ = ["ViserViewer"]

_SILENT = 0.5
"""A goal that was not said again for so long does not count: its process hangs, or is gone, s."""
_LOOK = 0.05
"""Longest wait for the process's word before there is a look at what to tell it, s."""
_WAITING = 1000
"""Edits of the world that may wait while the process does not take them; more are lost, and it draws none any more."""


class _Said(NamedTuple):
    """A goal, as the process said it."""

    seq: int
    t: float
    """When it was last said, on this machine's monotonic clock, s."""
    pose: Pose


class ViserViewer(Viewer3D):
    """A page on this machine, at :attr:`link`. Closing it in the browser ends nothing but its goals.

    One thread talks to the process, so that no call here ever waits for it but ``wait_ready`` and ``close``.

    Raises:
        NotSupported: the rig runs in lock-step.
        DriverMissing: viser is not installed.
    """

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        groups = rig.shared_states()
        for library, command in registry.missing("viser").items():
            raise DriverMissing(f"the 3D view needs {library}; install it with: {command}", name=library)
        self._robots = frozenset(robot.name for group in groups for robot in group.spec.robots)
        self._goals: dict[str, _Said] = {}
        self._cleared = dict.fromkeys(self._robots, 0)
        self._to_clear: set[str] = set()
        self._edits: deque[dict[str, Any]] = deque(maxlen=_WAITING)
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._secret = secrets.token_urlsafe(16)
        self._address = ""
        config = {
            "label": f"robot-hal: {', '.join(sorted(self._robots))}",
            "secret": self._secret,
            "groups": [to_json(group.spec) for group in groups],
        }
        self._child = Child("3D viewer", "hal.drivers.viser.process:main", config, [group.memory for group in groups])

    def wait_ready(self) -> None:
        ready = self._child.wait_ready()
        self._address = ready["address"]
        self.notes = tuple(f"3D view: {note}" for note in dict.fromkeys(ready["notes"]))
        self._thread = threading.Thread(target=self._talk, name="hal-viewer3d", daemon=True)
        self._thread.start()

    @property
    def link(self) -> str:
        return f"{self._address}/?token={self._secret}"

    def goal(self, robot: str) -> Pose | None:
        """See :meth:`Viewer3D.goal`. Raises DeviceNotFound for an arm that is not there."""
        self._check(robot)
        with self._lock:
            said = self._goals.get(robot)
        return said.pose if said is not None and time.monotonic() - said.t < _SILENT else None

    def clear_goal(self, robot: str) -> None:
        """See :meth:`Viewer3D.clear_goal`. Counts at once. Raises DeviceNotFound for an arm that is not there."""
        self._check(robot)
        with self._lock:
            said = self._goals.pop(robot, None)
            if said is not None:
                self._cleared[robot] = said.seq
            self._to_clear.add(robot)

    def _check(self, robot: str) -> None:
        if robot not in self._robots:
            raise DeviceNotFound(f"the 3D view has no robot {robot!r}; it has: {', '.join(sorted(self._robots))}")

    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        """The simulated world was edited: do the same before a snapshot of that revision is shown."""
        with self._lock:
            self._edits.append({"method": method, "params": params, "revision": revision})

    def _talk(self) -> None:
        """Tell and hear the process, until it or the viewer ends."""
        channel = self._child.channel
        try:
            while not self._closed.is_set():
                for method, params in self._news():
                    self._child.notify(method, params)
                message = channel.receive(_LOOK)
                if message is None:
                    continue
                if message.get("stop"):
                    self.rig.stop()
                if "goals" in message:
                    self._take(message["goals"], message["t"])
        except ConnectionLost:
            pass  # it is gone; an arm does without it
        finally:
            with self._lock:
                self._goals = {}

    def _news(self) -> list[tuple[str, dict[str, Any]]]:
        with self._lock:
            news = [("edited", edit) for edit in self._edits] + [("clear", {"robot": r}) for r in self._to_clear]
            self._edits.clear()
            self._to_clear.clear()
        return news

    def _take(self, goals: dict[str, list[float]], t: float) -> None:
        """What was said replaces what was said before, but for goals that were cleared meanwhile."""
        said = {}
        for robot, (seq, *numbers) in goals.items():
            pose = checked_pose(numbers[:3], numbers[3:])
            if pose is not None and robot in self._robots and isfinite(t):
                said[robot] = _Said(int(seq), t, pose)
        with self._lock:
            self._goals = {robot: goal for robot, goal in said.items() if goal.seq > self._cleared[robot]}

    def describe(self) -> str:
        return f"viser {version('viser')}"

    def close(self) -> None:
        """See :meth:`Viewer3D.close`."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._child.close()
