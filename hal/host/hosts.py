"""Where a group's cycle runs: in the caller's process, stepped by its clock, or in a process of its own.

Both look the same to the public classes: mailboxes in memory, requests, and a check that the host is alive.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from .. import registry
from ..commands import StopLatch
from ..errors import ConnectionLost, HalError
from ..specs import GripperSpec, GroupSpec, RobotSpec, to_json
from .process import STOP_LIMIT, Child, SharedMemory
from .records import AppRecord, GroupMemory

if TYPE_CHECKING:
    from ..specs import Plan

GRIPPER_HZ = 100.0
"""Rate of a gripper that has a process of its own."""


def make_groups(plan: Plan) -> list[GroupSpec]:
    """Return the groups of a rig: the devices of its simulated world together, and each other arm alone.

    Arms with the same :attr:`.RobotSpec.group` are one group, and so are those at one other computer. A gripper is in
    the group of its arm, except for one whose driver needs a process of its own. In lock-step the first group runs in
    the caller's process, and the others, if there are any, keep in step with it.
    """
    world, clock, collisions = plan.world, plan.clock, plan.collisions
    here = tuple(r for r in plan.robots if r.at is None)
    inside = tuple(r for r in here if world is not None and r.driver == world.driver)
    outside = tuple(r for r in here if r not in inside)
    apart = [
        GroupSpec(f"{r.name}.gripper", clock, GRIPPER_HZ, (), grippers=(r.gripper,))
        for r in here
        if r.gripper is not None and _is_apart(r.gripper)
    ]
    shared: dict[str, list[RobotSpec]] = {}
    for robot in outside:
        if _is_alone(robot, clock):
            shared.setdefault(robot.group or robot.name, []).append(robot)
    alone = [
        GroupSpec(
            "+".join(r.name for r in arms), clock, arms[0].rate_hz, tuple(arms), None, _grippers(arms), collisions
        )
        for arms in shared.values()
    ]
    if clock == "lock_step":
        robots = inside + tuple(r for r in outside if not r.emulated)
        rate = world.physics_hz if world else max((r.rate_hz for r in outside), default=240.0)
        first = GroupSpec("simulation", clock, rate, robots, world, _grippers(robots), collisions)
        return _add_neighbours([first, *alone, *apart])
    groups = []
    if world is not None:
        groups = [GroupSpec("simulation", clock, world.physics_hz, inside, world, _grippers(inside), collisions)]
    return _add_neighbours(groups + alone + apart) + _make_remote_groups(plan)


def _make_remote_groups(plan: Plan) -> list[GroupSpec]:
    """Return a group for each computer that serves arms of this rig, with their grippers."""
    served: dict[str, list[RobotSpec]] = {}
    for robot in plan.robots:
        if robot.at is not None:
            served.setdefault(robot.at, []).append(robot)
    return [
        GroupSpec(
            name=at,
            clock=plan.clock,
            rate_hz=min(robot.rate_hz for robot in arms),
            robots=tuple(arms),
            grippers=tuple(robot.gripper for robot in arms if robot.gripper is not None),
        )
        for at, arms in served.items()
    ]


def _add_neighbours(groups: Sequence[GroupSpec]) -> list[GroupSpec]:
    """Return the groups, each with the arms of the others that its own must not touch."""
    return [
        replace(group, neighbours=tuple(r for other in groups if other is not group for r in other.robots))
        if group.robots and group.collisions is not None and group.collisions.arms
        else group
        for group in groups
    ]


def _is_alone(robot: RobotSpec, clock: str) -> bool:
    """Return whether an arm outside of the simulated world needs a process of its own."""
    return clock != "lock_step" or robot.emulated


def _is_apart(gripper: GripperSpec) -> bool:
    return "gripper" in registry.driver(gripper.driver).own_process


def _grippers(robots: Iterable[RobotSpec]) -> tuple[GripperSpec, ...]:
    """Return the grippers that run beside their arms."""
    return tuple(r.gripper for r in robots if r.gripper is not None and not _is_apart(r.gripper))


HEARTBEAT = 0.02
"""Period of the app's heartbeat, s."""
SNAPSHOT_CAPACITY = 8192
"""Largest count of numbers in a snapshot of the world: seven a body, one a joint."""
SILENT = 1.5
"""A host that has published nothing for so long does not answer any more, s. (A Franka's library waits 1 s for a
state.)"""
CLOSE_LIMIT = 8.0
"""Longest time that one arm's driver may take to close, s: an arm without brakes is lowered slowly first."""


class Host(ABC):
    """A group of devices, as the app sees it."""

    spec: GroupSpec
    memory: GroupMemory

    def __init__(self, latch: StopLatch | None = None) -> None:
        self.latch = StopLatch() if latch is None else latch
        """The rig's latched stop."""

    @property
    def forked(self) -> bool:
        """Whether this is a copy in a forked process, whose end must not be that of the original's sessions."""
        return False

    @abstractmethod
    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        """Run a request between two steps and return its answer; an error in it is raised here."""

    @abstractmethod
    def check(self) -> None:
        """Raise ConnectionLost if the group's process is gone."""

    def beat(self) -> None:  # noqa: B027  # in lock-step every cycle has them
        """Send the app's sign of life and the number of stops now. Any thread may call it, at any time."""

    def wake(self) -> None:  # noqa: B027  # hosts look for commands in every cycle
        """Make known that there is a new command."""

    def request_close(self) -> None:  # noqa: B027  # most have nothing to do before
        """Begin to close, without waiting, where that is possible: the hosts of a rig close at the same time."""

    @abstractmethod
    def close(self) -> None:
        """Bring the arms to rest and close the devices. Idempotent."""


class LocalHost(Host):
    """Lock-step: the cycle runs in this process, whenever the clock is advanced."""

    def __init__(
        self,
        spec: GroupSpec,
        others: Sequence[SteppedHost] = (),
        latch: StopLatch | None = None,
        shared: SharedMemory | None = None,
    ) -> None:
        """Open the devices."""
        from .cycle import Cycle  # with the servo's libraries, so only in the process that runs it

        super().__init__(latch)
        self.spec = spec
        self._shared = shared
        buffer = memoryview(bytearray(GroupMemory.size_of(spec))) if shared is None else shared.buffer
        self.memory = GroupMemory.of(buffer, spec)
        self._others = others
        self.cycle = Cycle(spec, self.memory, [other.memory for other in others])
        self.cycle.turn = self._step
        self.pollers: list[Callable[[float], object]] = []
        """Functions (pads) that are called with the time in every step."""
        self._busy = threading.RLock()
        """Held while time advances: in one thread only."""
        self._closed = False
        self.cycle.open(0.0)
        self.memory.host.write(0.0, 0, 0, True)

    def now(self) -> float:
        """Simulated time, s."""
        return self.cycle.ticks * self.cycle.dt

    def advance_to(self, t: float) -> None:
        """Advance simulated time to ``t`` (s), to within half a step; by one step at least if ``t`` is ahead.

        Raises:
            HalError: After :meth:`close`, so that a thread that waits for time to advance does not wait for ever.
        """
        with self._busy:
            self.check()
            ahead = (t - self.now()) / self.cycle.dt
            if ahead > 1e-6:
                for _ in range(max(1, round(ahead))):
                    self._step()
                self.publish()

    def _step(self) -> None:
        cycle = self.cycle
        now = (cycle.ticks + 1) * cycle.dt
        for poll in self.pollers:
            poll(now)
        for other in self._others:
            other.advance_to(now)
        cycle.step(now, AppRecord(now, self.latch.stops))
        if self._others:
            self.publish()

    def publish(self) -> None:
        """Publish the present state."""
        now = self.now()
        self.cycle.publish(now)
        self.memory.host.write(now, self.cycle.ticks, 0, True)

    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        with self._busy:
            self.check()
            result = self.cycle.request(method, params or {})
            # Of the world's requests, only these change what arms and grippers report.
            if not method.startswith("world.") or method in ("world.reset", "world.restore"):
                self.publish()
            return result

    def check(self) -> None:
        if self._closed:
            raise HalError("the rig is closed", code="closed")

    def close(self) -> None:
        with self._busy:
            if self._closed:
                return
            self._closed = True
            try:
                for _ in range(round(STOP_LIMIT / self.cycle.dt)):
                    if self.cycle.stop_sessions():
                        break
                    self._step()
            finally:
                self.cycle.close()
                if self._shared is not None:
                    self._shared.close()


class RemoteHost(Host):
    """Real time: the cycle runs in a process of its own."""

    def __init__(
        self,
        spec: GroupSpec,
        *,
        realtime: bool = False,
        shared: SharedMemory | None = None,
        others: Sequence[tuple[GroupSpec, SharedMemory]] = (),
        latch: StopLatch | None = None,
    ) -> None:
        """Start the process. Arms of ``others`` have copies in this one's world, are kept off, or have its gripper."""
        super().__init__(latch)
        self.spec = spec
        self._pid = os.getpid()
        self.snapshot_offset = GroupMemory.size_of(spec)
        self.shared = self.allocate(spec) if shared is None else shared
        self.memory = GroupMemory.of(self.shared.buffer, spec)
        config = {"group": to_json(spec), "snapshot_capacity": SNAPSHOT_CAPACITY, "realtime": realtime}
        config["others"] = [to_json(other) for other, _ in others]
        memories = [self.shared, *(memory for _, memory in others)]
        target = "hal.host.main:main" if spec.at is None else "hal.remote.client:main"
        self.child = Child(spec.name, target, config, memories)
        self._close_by: float | None = None
        """Time at which the process is killed, s; None before it was asked to close."""
        self._asking = threading.Lock()
        self._writing = threading.RLock()  # a signal handler may stop the rig in the middle of a beat
        self._lent = False
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._heartbeat, name=f"hal-heartbeat-{spec.name}", daemon=True)
        self.beat()
        self._thread.start()

    @staticmethod
    def allocate(spec: GroupSpec) -> SharedMemory:
        """Return memory for a group, which others may be given before its process starts."""
        from .memory import SeriesBox

        return SharedMemory(GroupMemory.size_of(spec) + SeriesBox.size(SNAPSHOT_CAPACITY))

    def wait_ready(self) -> Any:
        """Wait until every device is open. Raises the error that stopped one of them."""
        return self.child.wait_ready()

    @property
    def forked(self) -> bool:
        return os.getpid() != self._pid

    def beat(self) -> None:
        if self.forked:
            raise self._make_fork_error()
        with self._writing:
            if not self._lent:
                self.memory.app.write(time.monotonic(), self.latch.stops)

    def lend(self, lent: bool) -> None:
        """Leave the heartbeat to the program at another computer that has the group, or write it again."""
        with self._writing:
            self._lent = lent

    def wake(self) -> None:
        if self.spec.at is not None:
            with contextlib.suppress(ConnectionLost):  # the next check says how it ended
                self.child.channel.send_if_free(None)

    def _heartbeat(self) -> None:
        while not self._closed.wait(HEARTBEAT):
            self.beat()

    @staticmethod
    def _make_fork_error() -> HalError:
        text = "this rig belongs to the process that opened it, of which this one is a fork: open a rig of its own here"
        return HalError(text, code="forked")

    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        with self._asking:  # one at a time: no other request runs in the middle of the cycles of an "advance"
            return self.child.request(method, params)

    def check(self) -> None:
        if self.forked:
            raise self._make_fork_error()
        if self._closed.is_set():
            raise HalError("the rig is closed", code="closed")
        try:
            self.child.check()
        except ConnectionLost:
            self.child.raise_last_error()  # a link says why it ended
            raise
        silence = self._silence()
        if silence > SILENT:
            raise ConnectionLost(
                f"the {self.spec.name} process has not answered for {silence:.1f} s", code="process_silent"
            )

    def _silence(self) -> float:
        """Return how long the host has published nothing although no request keeps it busy, s."""
        host = self.memory.get_host()
        return time.monotonic() - host.t if host.ready and not self.child.busy else 0.0

    def request_close(self) -> None:
        if self._close_by is None and not self._closed.is_set():
            lasts = STOP_LIMIT + CLOSE_LIMIT * max(1, len(self.spec.robots))
            self._close_by = time.monotonic() + (1.0 if self._silence() > SILENT else lasts)
            self.child.request_close()

    def close(self) -> None:
        if self._closed.is_set() or self.forked:
            return
        RemoteHost.request_close(self)
        assert self._close_by is not None
        self.child.close(timeout=max(0.0, self._close_by - time.monotonic()))
        self._closed.set()
        self._thread.join(timeout=1.0)
        self.shared.close()


def start_processes(
    groups: Sequence[GroupSpec], realtime: bool, latch: StopLatch | None = None
) -> Iterator[RemoteHost]:
    """Start the process of each group in real time, and yield its host at once, so that the caller can close it.

    That of the simulated world is started last, because it mirrors the arms of the others. The arguments are those of
    :class:`RemoteHost`.
    """
    memories = [(group, RemoteHost.allocate(group)) for group in groups]
    for group, shared in sorted(memories, key=lambda pair: pair[0].world is not None):
        seen = group.world is not None or bool(group.neighbours) or not group.robots
        others = [pair for pair in memories if seen and pair[0] is not group and pair[0].at is None]
        urgent = realtime and bool(group.robots)
        yield RemoteHost(group, realtime=urgent, shared=shared, others=others, latch=latch)


class SteppedHost(RemoteHost):
    """Lock-step with a process of its own, for a driver whose library cannot live in the app's."""

    def advance_to(self, t: float) -> None:
        """Advance the process to the simulated time ``t`` (s), to within half a step."""
        cycles = round(t * self.spec.rate_hz) - self.memory.get_host().ticks  # a request may have run some, too
        if cycles > 0:
            self.request("advance", {"cycles": cycles})

    def request_close(self) -> None:
        """Do nothing: it is stepped until the arms of the group that steps it are at rest."""

    def _silence(self) -> float:
        return 0.0  # silent while it is not stepped; a request without an answer shows that it is gone
