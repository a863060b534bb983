"""The app's side of the 3D view: it starts the process behind the page and receives the goals of dragged handles."""

from __future__ import annotations

import tempfile
import threading
import time
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from importlib.metadata import version
from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hal import registry
from hal.errors import ConnectionLost, DeviceNotFound, DriverMissing, HalError
from hal.geometry import Pose
from hal.host.process import Child
from hal.specs import to_json
from hal.views import Viewer3D
from hal.world import Contact

from .goals import checked_pose

if TYPE_CHECKING:
    from hal.rig import Rig

_SILENCE = 0.5
"""Time after which a goal that is not repeated does not count: its process hangs, or is gone, s."""
_POLL = 0.05
"""Longest wait for a message of the process before new ones are sent to it, s."""
_CONTACTS = 0.1
"""Time between two looks at the contacts of the simulated arms while a page is open, s."""
_LEAST, _PER_NEWTON, _LONGEST = 0.1, 0.005, 0.5
"""Least force that is drawn, N; length of its arrow, m/N and at most m."""
_WAITING = 1000
"""Number of edits of the world that may wait for the process; more are lost, and it then shows no further edits."""


class _ReportedGoal(NamedTuple):
    """A goal as the process reported it."""

    seq: int
    t: float
    """When it was last reported, on this machine's monotonic clock, s."""
    pose: Pose


class ViserViewer(Viewer3D):
    """Serves the view at :attr:`address` in a folder of this user. Closing its page only ends the page's goals.

    One thread talks to the process, so only ``wait_ready`` and ``close`` ever wait for it.
    """

    def __init__(self, rig: Rig) -> None:
        """Start the process for a rig.

        Raises:
            NotSupported: The rig runs in lock-step.
            DriverMissing: viser is not installed.
        """
        super().__init__(rig)
        groups = rig.shared_states()
        for library, command in registry.find_missing("viser").items():
            raise DriverMissing(f"the 3D view needs {library}; install it with: {command}", name=library)
        self._robots = frozenset(robot.name for group in groups for robot in group.spec.robots)
        self._goals: dict[str, _ReportedGoal] = {}
        self._cleared = dict.fromkeys(self._robots, 0)
        self._to_clear: set[str] = set()
        self._watched, self._contacts_due = False, 0.0
        self._arrows: list[list[list[float]]] = []
        self._edits: deque[dict[str, Any]] = deque(maxlen=_WAITING)
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="hal-3d-", ignore_cleanup_errors=True)
        config = {
            "label": f"robot-hal: {', '.join(sorted(self._robots))}",
            "address": self.address,
            "groups": [to_json(group.spec) for group in groups],
            "cameras": [to_json(camera) for camera in rig.plan.cameras],
        }
        self._child = Child("3D viewer", "hal.drivers.viser.process:main", config, [group.memory for group in groups])

    def wait_ready(self) -> None:
        ready = self._child.wait_ready()
        self.notes = tuple(f"3D view: {note}" for note in dict.fromkeys(ready["notes"]))
        self._thread = threading.Thread(target=self._exchange_messages, name="hal-viewer3d", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        return f"{self._folder.name}/socket"

    def goal(self, robot: str) -> Pose | None:
        """See :meth:`Viewer3D.goal`. Raises DeviceNotFound for an unknown arm."""
        self._check_name(robot)
        with self._lock:
            found = self._goals.get(robot)
        return found.pose if found is not None and time.monotonic() - found.t < _SILENCE else None

    def clear_goal(self, robot: str) -> None:
        """See :meth:`Viewer3D.clear_goal`. Takes effect at once. Raises DeviceNotFound for an unknown arm."""
        self._check_name(robot)
        with self._lock:
            found = self._goals.pop(robot, None)
            if found is not None:
                self._cleared[robot] = found.seq
            self._to_clear.add(robot)

    def _check_name(self, robot: str) -> None:
        if robot not in self._robots:
            raise DeviceNotFound(f"the 3D view has no robot {robot!r}; it has: {', '.join(sorted(self._robots))}")

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Repeat an edit of the simulated world before a snapshot of that revision is shown."""
        with self._lock:
            self._edits.append({"method": method, "params": params, "revision": revision})

    def _exchange_messages(self) -> None:
        """Send to the process and receive from it, until it or the viewer ends."""
        channel = self._child.channel
        try:
            while not self._closed.is_set():
                for method, params in (*self._take_outgoing(), *self._find_forces()):
                    channel.send({"method": method, "params": params})
                message = channel.receive(_POLL)
                if message is None:
                    continue
                self._watched = message["watched"]
                self._set_goals(message["goals"], message["t"])
        except ConnectionLost:
            pass  # the process is gone; the arms work without it
        finally:
            with self._lock:
                self._goals = {}

    def _take_outgoing(self) -> list[tuple[str, dict[str, Any]]]:
        with self._lock:
            found = [("edited", edit) for edit in self._edits] + [("clear", {"robot": r}) for r in self._to_clear]
            self._edits.clear()
            self._to_clear.clear()
        return found

    def _find_forces(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield a message with the forces on the arms, if they changed, while a page is open."""
        now = time.monotonic()
        if not self._watched or now < self._contacts_due:
            return
        self._contacts_due = now + _CONTACTS
        arrows = []
        with suppress(HalError):  # nothing is simulated, or the simulation has ended
            arrows = arrows_of(self.rig.world.contacts(), self._robots)
        if arrows != self._arrows:
            self._arrows = arrows
            yield "forces", {"arrows": arrows}

    def _set_goals(self, goals: dict[str, list[float]], t: float) -> None:
        """Replace the goals by those of a message, without goals that were cleared meanwhile.

        Of the console's pages only the one in control may drag; the handle of another one goes back.
        """
        reported, console = {}, self.rig.console
        for robot, (seq, page, *numbers) in goals.items():
            pose = checked_pose(numbers[:3], numbers[3:])
            if console is not None and console.driver != f"page {page:.0f}":
                self.clear_goal(robot)
            elif pose is not None and robot in self._robots and isfinite(t):
                reported[robot] = _ReportedGoal(int(seq), t, pose)
        with self._lock:
            self._goals = {robot: goal for robot, goal in reported.items() if goal.seq > self._cleared[robot]}

    def describe(self) -> str:
        return f"viser {version('viser')}"

    def close(self) -> None:
        self._closed.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._child.close()
        self._folder.cleanup()


def arrows_of(contacts: Iterable[Contact], robots: Collection[str]) -> list[list[list[float]]]:
    """Return both ends, in the world, m, of an arrow for the force on an arm at each of its contacts."""
    arrows = []
    for contact in contacts:
        for name, sign in ((contact.a, 1.0), (contact.b, -1.0)):
            if name in robots and contact.force > _LEAST:
                way = sign * min(_PER_NEWTON * contact.force, _LONGEST) * contact.normal
                arrows.append([contact.position.tolist(), (contact.position + way).tolist()])
    return arrows
