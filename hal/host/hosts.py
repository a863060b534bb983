"""Where a group's cycle runs: in the caller's process, stepped by its clock, or in a process of its own.

Both look the same to the public classes: mailboxes in memory, requests, and a check that somebody is there.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from ..errors import HalError
from ..specs import GroupSpec, to_json
from .cycle import Cycle
from .process import Child, SharedMemory
from .records import AppRecord, GroupMemory

__all__ = ["Host", "LocalHost", "RemoteHost"]

HEARTBEAT = 0.02
"""Period of the app's heartbeat, s."""
SNAPSHOT_CAPACITY = 1024
"""Most numbers in a picture of the world: seven a body, one a joint."""
PAD_PERIOD = 0.01
"""How often pads are polled in lock-step, simulated s."""


class Host(ABC):
    """A group of devices, as the app sees it."""

    spec: GroupSpec
    memory: GroupMemory

    @abstractmethod
    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        """Run something between two steps and return its answer; an error there is raised here."""

    @abstractmethod
    def check(self) -> None:
        """Raise ConnectionLost when the group's process is gone."""

    @abstractmethod
    def stop(self) -> None:
        """Latch a stop of every arm. Any thread may call it, at any time."""

    @abstractmethod
    def close(self) -> None:
        """Bring the arms to rest, let go of the devices. Idempotent."""


class LocalHost(Host):
    """Lock-step: the cycle runs here, whenever the clock is told to go on."""

    def __init__(self, spec: GroupSpec) -> None:
        self.spec = spec
        joints = [(robot.name, len(robot.joints)) for robot in spec.robots]
        self.memory = GroupMemory(memoryview(bytearray(GroupMemory.size(joints))), joints)
        self.cycle = Cycle(spec, self.memory)
        self.pollers: list[Callable[[float], object]] = []
        """Called every :data:`PAD_PERIOD` of simulated time: pads."""
        self._stops = 0
        self._stopping = threading.Lock()
        self._next_poll = 0.0
        self._closed = False
        self.cycle.open(0.0)
        self.memory.host.write(0.0, 0, 0, True)

    def now(self) -> float:
        """Simulated time, s."""
        return self.cycle.ticks * self.cycle.dt

    def advance_to(self, t: float) -> None:
        """Step until simulated time is ``t``, to within half a step."""
        cycle, dt = self.cycle, self.cycle.dt
        steps = round((t - self.now()) / dt)
        for _ in range(steps):
            now = (cycle.ticks + 1) * dt
            if now >= self._next_poll:
                for poll in self.pollers:
                    poll(now)
                self._next_poll = now + PAD_PERIOD
            cycle.step(now, AppRecord(now, self._stops))
        self.publish()

    def publish(self) -> None:
        """Make the present state visible."""
        now = self.now()
        self.cycle.publish(now)
        self.memory.host.write(now, self.cycle.ticks, 0, True)

    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        result = self.cycle.request(method, params or {})
        self.publish()
        return result

    def check(self) -> None:
        if self._closed:
            raise HalError("the rig is closed")

    def stop(self) -> None:
        with self._stopping:
            self._stops += 1

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for _ in range(round(5.0 / self.cycle.dt)):
            if self.cycle.stop_sessions():
                break
            self.cycle.step(self.now() + self.cycle.dt, AppRecord(self.now(), self._stops))
        self.cycle.close()


class RemoteHost(Host):
    """Real time: the cycle runs in a process of its own."""

    def __init__(self, spec: GroupSpec, *, realtime: bool = False) -> None:
        self.spec = spec
        joints = [(robot.name, len(robot.joints)) for robot in spec.robots]
        size = GroupMemory.size(joints)
        from .mailbox import SeriesBox

        self.snapshot_offset = size
        self.shared = SharedMemory(size + SeriesBox.size(SNAPSHOT_CAPACITY))
        self.memory = GroupMemory(self.shared.buffer, joints)
        config = {"group": to_json(spec), "snapshot_capacity": SNAPSHOT_CAPACITY, "realtime": realtime}
        self.child = Child(spec.name, "hal.host.main:main", config, [self.shared])
        self._stops = 0
        self._writing = threading.Lock()
        self._closed = threading.Event()
        self._beat()
        self._thread = threading.Thread(target=self._heartbeat, name=f"hal-heartbeat-{spec.name}", daemon=True)
        self._thread.start()

    def wait_ready(self) -> Any:
        """Wait until every device is open; raises the error that one of them met."""
        return self.child.wait_ready()

    def _beat(self) -> None:
        with self._writing:
            self.memory.app.write(time.monotonic(), self._stops)

    def _heartbeat(self) -> None:
        while not self._closed.wait(HEARTBEAT):
            self._beat()

    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        return self.child.request(method, params)

    def check(self) -> None:
        if self._closed.is_set():
            raise HalError("the rig is closed")
        self.child.check()

    def stop(self) -> None:
        with self._writing:
            self._stops += 1
            self.memory.app.write(time.monotonic(), self._stops)

    def close(self) -> None:
        if self._closed.is_set():
            return
        self.child.close(timeout=8.0)
        self._closed.set()
        self._thread.join(timeout=1.0)
        self.shared.close()
