"""The process around a group's servos and grippers in real time, and what sets its pace.

It ends by itself if the app is gone, brakes its arms if the app does not answer, and the terminal's signals do not
reach it. The pace is set by time, by a device, or by the app that steps it.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import ConnectionLost
from ..histogram import Histogram
from ..specs import GroupSpec, from_json
from .cycle import Cycle
from .memory import SeriesBox
from .process import STOP_LIMIT, Channel, SharedMemory, end_by_signal, pack_error
from .records import AppRecord, GroupMemory
from .scheduling import describe, is_realtime, prepare_process

_ASLEEP = 0.1
"""A computer that slept for longer than this, s, was suspended."""


class Pace(ABC):
    """Base class: decides when the next cycle begins."""

    def __init__(self) -> None:
        self.periods = Histogram(2e-5, 5000)
        """Time between two cycles, s."""
        self._last = 0.0

    @property
    def missed(self) -> int:
        """Number of cycles that were skipped."""
        return 0

    @property
    def pausing(self) -> bool:
        """Whether time stands still until the app requests more cycles."""
        return False

    @abstractmethod
    def wait(self) -> float:
        """Block until the next cycle; return its time on the group's clock, s."""

    def now(self) -> float:
        """Return the present time on the group's clock, s."""
        return time.monotonic()

    def adjust_heartbeat(self, app: AppRecord) -> AppRecord:
        """Return the app's newest record, with its heartbeat on the group's clock."""
        return app

    def run_free(self) -> None:  # noqa: B027  # most do not wait for the app
        """Continue without the app, which is done."""

    def restart(self) -> None:
        """Continue from now, counting nothing as missed, after work for which the group's time was paused."""
        self._last = 0.0

    def reset_statistics(self) -> None:
        """Set the statistics to zero."""
        self.periods = Histogram(2e-5, 5000)

    def _note(self, now: float) -> None:
        if self._last:
            self.periods.add(now - self._last)
        self._last = now


class DevicePace(Pace):
    """Pace of a device's own cycle (a Franka's state packets)."""

    def __init__(self, cycle: Cycle) -> None:
        super().__init__()
        self._cycle = cycle

    @property
    def missed(self) -> int:
        """Number of the device's cycles that were missed."""
        return self._cycle.lost_cycles

    def wait(self) -> float:
        self._cycle.wait()
        now = time.monotonic()
        self._note(now)
        return now

    def restart(self) -> None:
        """Do nothing: a device does not pause."""


class StepPace(Pace):
    """Lock-step: runs as many cycles as the app requests, then time stands still."""

    def __init__(self, cycle: Cycle, attend: Callable[[float], None]) -> None:
        """Make the pace. ``attend(timeout)`` serves a request of the app, if one comes."""
        super().__init__()
        self._cycle = cycle
        self._attend = attend
        self._granted = 0
        self._free = False

    def grant(self, cycles: int) -> None:
        """Allow this many more cycles."""
        self._granted += cycles

    @property
    def pausing(self) -> bool:
        return self._granted <= 0 and not self._free

    def now(self) -> float:
        return self._cycle.ticks * self._cycle.dt

    def wait(self) -> float:
        while self.pausing:
            self._attend(0.05)
        self._granted -= 1
        if self._cycle.paces_itself:
            self._cycle.wait()
        return (self._cycle.ticks + 1) * self._cycle.dt

    def adjust_heartbeat(self, app: AppRecord) -> AppRecord:
        """Return a record with a heartbeat of now: an app that steps is alive by definition."""
        return AppRecord((self._cycle.ticks + 1) * self._cycle.dt, app.stops)

    def run_free(self) -> None:
        self._free = True


class SuspensionWatch:
    """Detects that the computer was suspended; its monotonic clock stands still meanwhile."""

    def __init__(self) -> None:
        self._clock = getattr(time, "CLOCK_BOOTTIME", None)
        self._asleep = self._measure_sleep()

    def _measure_sleep(self) -> float:
        """Return how long it was suspended since it was started, s; 0 if the system cannot tell."""
        return time.clock_gettime(self._clock) - time.monotonic() if self._clock is not None else 0.0

    def was_suspended(self) -> bool:
        """Return whether it was suspended since the last call."""
        before, self._asleep = self._asleep, self._measure_sleep()
        return self._asleep - before > _ASLEEP


class PeriodicPace(Pace):
    """Pace of absolute deadlines every ``period`` s: what came too late is skipped and counted, never caught up."""

    def __init__(self, period: float) -> None:
        super().__init__()
        self.period = period
        self._missed = 0
        self._next = time.monotonic() + period

    @property
    def missed(self) -> int:
        """Number of periods that were skipped."""
        return self._missed

    def wait(self) -> float:
        """Sleep until the next deadline; return the time of waking, s."""
        now = time.monotonic()
        if now < self._next:
            time.sleep(self._next - now)
            now = time.monotonic()
        late = int((now - self._next) / self.period)
        if late > 0:
            self._missed += late
            self._next += late * self.period
        self._next += self.period
        self._note(now)
        return now

    def restart(self) -> None:
        """Skip the pause. Less than a period does not count as one: many of those would slow time down uncounted."""
        paused = int((time.monotonic() - self._next) / self.period)
        if paused > 0:
            super().restart()
            self._next += paused * self.period

    def reset_statistics(self) -> None:
        super().reset_statistics()
        self._missed = 0


APP_GONE = 30.0
"""An app without a sign of life for so long counts as gone, s. Its arms stopped long before."""
HANG = 15
"""A library that does not return for so long, s, waits for a network that is gone: the process is ended."""
STATES_HZ = 500.0
"""Highest rate at which states are published, about, Hz."""
SNAPSHOTS_HZ = 250.0
"""The same for the world's poses, from which pictures are drawn."""


class HostProcess:
    """Runs a group's cycle until the app closes it or is gone."""

    def __init__(self, channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
        self.channel = channel
        self.parent = os.getppid()
        spec = from_json(GroupSpec, config["group"])
        buffer = memories[0].buffer
        self.memory = GroupMemory.of(buffer, spec)
        self.snapshots: SeriesBox | None = None
        if spec.world is not None:
            self.snapshots = SeriesBox(buffer[GroupMemory.size_of(spec) :], config["snapshot_capacity"])
        others = [from_json(GroupSpec, group) for group in config.get("others", ())]
        pairs = zip(memories[1:], others, strict=True)
        self.cycle = Cycle(spec, self.memory, [GroupMemory.of(memory.buffer, other) for memory, other in pairs])
        self.cycle.turn = self._run_granted_cycle
        self.realtime = bool(config.get("realtime", False))
        # A fast servo publishes less often than it ticks: no reader could follow.
        self._state_every = max(1, round(spec.rate_hz / STATES_HZ))
        self._snapshot_every = max(1, round(spec.rate_hz / SNAPSHOTS_HZ))
        self.closing = False
        self._ended_by = 0
        """Number of the signal that ends this process; 0 for none."""
        self._resting = False
        self._give_up_at = math.inf
        self._owed: int | None = None
        """Number of the request for cycles that is answered when they are done."""
        self._suspension = SuspensionWatch() if self.cycle.attended else None
        self.pace: Pace
        if spec.clock == "lock_step":
            self.pace = StepPace(self.cycle, self._attend)
        elif self.cycle.paces_itself:
            self.pace = DevicePace(self.cycle)
        else:
            self.pace = PeriodicPace(self.cycle.dt)

    def run(self) -> None:
        """Open the devices, cycle until closed, stop the arms, close the devices."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._terminate)
        cycle = self.cycle
        try:
            self._alarm()
            cycle.open(self.pace.now())
            if self._ended_by:
                return
            prepare_process(self.realtime)
            self.pace.restart()
            self._publish(self.pace.now())
            self.channel.send({"ready": {"realtime": is_realtime(), "rate_hz": cycle.spec.rate_hz}})
            self._cycle_until_closed()
        except BaseException:
            self.closing = True
            with contextlib.suppress(Exception):
                self._cycle_until_closed()  # bring the arms to rest if possible, whatever went wrong
            raise
        finally:
            self._alarm()
            cycle.close()
            if self._ended_by:
                end_by_signal(self._ended_by)

    def _cycle_until_closed(self) -> None:
        while not self._is_over():
            self._turn()
            driver = self.cycle.find_looping_driver()
            if driver is not None:
                driver.loop(self._turn)

    def _is_over(self) -> bool:
        """Return whether the app is done with this process, and its arms are at rest or have had their time."""
        if not self.closing:
            return False
        now = time.monotonic()
        if self._give_up_at == math.inf:
            self._give_up_at = now + STOP_LIMIT
        return self._resting or now > self._give_up_at

    def _alarm(self) -> None:
        """End this process if a vendor's library does not return: nothing in Python could end it then.

        Not in lock-step, where the app may take its time. (The signal's default is the end.)
        """
        if isinstance(self.pace, DevicePace):
            signal.alarm(HANG)

    def _terminate(self, signum: int, frame: object) -> None:
        self.closing, self._ended_by = True, signum
        self.pace.run_free()

    def _turn(self) -> None:
        """Run one cycle; a driver's library may be the caller."""
        cycle = self.cycle
        if self.closing:
            self._resting = cycle.stop_sessions()
            if self._is_over():
                driver = cycle.find_looping_driver()
                if driver is not None:
                    driver.halt()
                return
        self._run_cycle()
        self._settle_up()
        if self.pace.pausing or (cycle.ticks + 1) % self._state_every == 0:  # between two states
            self._attend(0.0)

    def _run_cycle(self) -> None:
        self._alarm()
        now = self.pace.wait()
        late = self._suspension is not None and self._suspension.was_suspended()
        self.cycle.step(now, self.pace.adjust_heartbeat(self.memory.get_app()), late)
        self._publish(now)

    def _run_granted_cycle(self) -> None:
        """Run one cycle in the middle of a request, for which an app in lock-step has granted none."""
        if isinstance(self.pace, StepPace):
            self.pace.grant(1)
        self._run_cycle()

    def _settle_up(self) -> None:
        """In lock-step, answer the request for cycles that are done."""
        if self._owed is not None and self.pace.pausing:
            number, self._owed = self._owed, None
            self._answer(number, {"result": None})

    def _publish(self, now: float) -> None:
        cycle = self.cycle
        if cycle.ticks % self._state_every == 0 or self.pace.pausing:
            cycle.publish(now)
        if self.snapshots is not None and cycle.ticks % self._snapshot_every == 0:
            world = cycle.world
            self.snapshots.write(world.stamp(now), world.revision, world.snapshot())
        clock_now = self.pace.now()
        for unit in cycle.arms.values():
            unit.note_latency(clock_now)
        self.memory.host.write(now, cycle.ticks, self.pace.missed, True)

    def _attend(self, timeout: float) -> None:
        """Serve a request, if there is one; check that the app is there."""
        try:
            message = self.channel.receive(timeout) if timeout else self.channel.poll()
        except ConnectionLost:
            self.closing = True
        else:
            if message is not None:
                self._serve(message)
            if self._is_app_gone():
                self.closing = True
        if self.closing:
            self.pace.run_free()

    def _serve(self, message: dict[str, Any]) -> None:
        """Answer a request between two ticks; simulated time stands still meanwhile."""
        method = message["method"]
        if method == "close":
            self.closing = True
            return
        if method == "advance" and isinstance(self.pace, StepPace):
            self.pace.grant(message["params"]["cycles"])
            self._owed = message["id"]
            return
        try:
            answer = {"result": self._ask(method, message["params"])}
        except Exception as error:
            answer = {"error": pack_error(error)}
        if self.pace.pausing:
            self.cycle.publish(self.pace.now())  # the request may have changed the state
        self._answer(message["id"], answer)
        if method.startswith("world."):
            self.pace.restart()  # the world stood still, and its arms with it

    def _answer(self, number: int, answer: dict[str, Any]) -> None:
        try:
            self.channel.send({"id": number, **answer})
        except ConnectionLost:
            self.closing = True  # the app is gone: come to rest first
            self.pace.run_free()

    def _ask(self, method: str, params: dict[str, Any]) -> Any:
        result = self.cycle.request(method, params)
        pace = self.pace
        if method == "statistics":
            result = result | {
                "missed": pace.missed,
                "period_s": pace.periods.summary(),
                "scheduling": describe(),
            }
        elif method == "reset_statistics":
            pace.reset_statistics()
        return result

    def _is_app_gone(self) -> bool:
        if os.getppid() != self.parent:
            return True
        heartbeat = self.memory.get_app().t
        return heartbeat > 0.0 and time.monotonic() - heartbeat > APP_GONE


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the child process of a group."""
    HostProcess(channel, memories, config).run()
