"""The process around a group's servos and grippers in real time.

It ends by itself when the app is gone, brakes its arms when the app does not answer, and is not reached by the
terminal's signals.
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
from .process import Channel, SharedMemory, pack_error
from .records import AppRecord, GroupMemory
from .scheduling import describe, is_realtime, prepare_process

__all__ = [
    "DevicePace",
    "Pace",
    "PeriodicPace",
    "StepPace",
    "SuspensionWatch",
    "main",
]

# [pace.py] What sets the pace of a group's cycle in its own process: time, a device, or the app that steps it.

_ASLEEP = 0.1
"""A computer that slept for longer than this, s, was suspended."""


class Pace(ABC):
    """When the next cycle begins."""

    def __init__(self) -> None:
        self.periods = Histogram(2e-5, 5000)
        """Time between two cycles, s."""
        self._last = 0.0

    @property
    def missed(self) -> int:
        """Cycles that were skipped."""
        return 0

    @property
    def pausing(self) -> bool:
        """Does time stand still until somebody asks for more?"""
        return False

    @abstractmethod
    def wait(self) -> float:
        """Block until the next cycle; returns its time on the group's clock, s."""

    def now(self) -> float:
        """The group's clock, s."""
        return time.monotonic()

    def heard(self, app: AppRecord) -> AppRecord:
        """The app's newest word, with its heartbeat on the group's clock."""
        return app

    def run_free(self) -> None:  # noqa: B027  # most do not wait for the app
        """The app is done: go on without it."""

    def restart(self) -> None:
        """Go on from now, counting nothing as missed: after work for which the group's time was paused."""
        self._last = 0.0

    def reset_statistics(self) -> None:
        """Count from zero."""
        self.periods = Histogram(2e-5, 5000)

    def _note(self, now: float) -> None:
        if self._last:
            self.periods.add(now - self._last)
        self._last = now


class DevicePace(Pace):
    """A device's own cycle (a Franka's state packets)."""

    def __init__(self, cycle: Cycle) -> None:
        super().__init__()
        self._cycle = cycle

    @property
    def missed(self) -> int:
        """Cycles of the device of which nothing was seen."""
        return self._cycle.lost_cycles

    def wait(self) -> float:
        self._cycle.wait()
        now = time.monotonic()
        self._note(now)
        return now

    def restart(self) -> None:
        """A device does not pause."""


class StepPace(Pace):
    """Lock-step: so many cycles as the app asks for, then time stands still."""

    def __init__(self, cycle: Cycle, attend: Callable[[float], None]) -> None:
        """``attend(timeout)`` serves a request of the app, if one comes."""
        super().__init__()
        self._cycle = cycle
        self._attend = attend
        self._granted = 0
        self._free = False

    def grant(self, cycles: int) -> None:
        """The app asks for so many."""
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

    def heard(self, app: AppRecord) -> AppRecord:
        """An app that steps is there by definition."""
        return AppRecord((self._cycle.ticks + 1) * self._cycle.dt, app.stops)

    def run_free(self) -> None:
        self._free = True


class SuspensionWatch:
    """Notices that the computer was suspended, in which its monotonic clock stands still."""

    def __init__(self) -> None:
        self._clock = getattr(time, "CLOCK_BOOTTIME", None)
        self._asleep = self._slept()

    def _slept(self) -> float:
        """How long it was suspended since it was started, s; 0 where the system cannot say."""
        return time.clock_gettime(self._clock) - time.monotonic() if self._clock is not None else 0.0

    def ended(self) -> bool:
        """Was it suspended since the last call?"""
        before, self._asleep = self._asleep, self._slept()
        return self._asleep - before > _ASLEEP


# [pacer.py] A periodic loop against absolute deadlines: what came too late is skipped and counted, never caught
# up.


class PeriodicPace(Pace):
    """Wakes its caller every ``period`` s."""

    def __init__(self, period: float) -> None:
        super().__init__()
        self.period = period
        self._missed = 0
        self._next = time.monotonic() + period

    @property
    def missed(self) -> int:
        """Periods that were skipped."""
        return self._missed

    def wait(self) -> float:
        """Sleep until the next deadline; returns the time of waking, s."""
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
        """What took less than a period was no pause: many of those would slow time down, and no count would show it."""
        paused = int((time.monotonic() - self._next) / self.period)
        if paused > 0:
            super().restart()
            self._next += paused * self.period

    def reset_statistics(self) -> None:
        super().reset_statistics()
        self._missed = 0


APP_GONE = 30.0
"""An app that is there but has given no sign of life for so long is taken for gone, s. Its arms stopped long before."""
HANG = 15
"""A library that has not come back for so long, s, waits for a network that is gone: the process is ended."""
STATES_HZ = 500.0
"""States are published at about this rate at most."""
SNAPSHOTS_HZ = 250.0
"""The same for the world's poses, from which pictures are drawn."""
STOP_LIMIT = 5.0
"""Longest time for bringing the arms to rest before the devices are closed all the same, s."""


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
        self.realtime = bool(config.get("realtime", False))
        # A fast servo tells the app and the renderer less often than it ticks: nobody could look that often.
        self._state_every = max(1, round(spec.rate_hz / STATES_HZ))
        self._snapshot_every = max(1, round(spec.rate_hz / SNAPSHOTS_HZ))
        self.closing = False
        self._resting = False
        self._give_up_at = math.inf
        self._owed: int | None = None
        """Number of the request that is answered when time stands still again."""
        self._suspension = SuspensionWatch() if self.cycle.attended else None
        self.pace: Pace
        if spec.clock == "lock_step":
            self.pace = StepPace(self.cycle, self._attend)
        elif self.cycle.paces_itself:
            self.pace = DevicePace(self.cycle)
        else:
            self.pace = PeriodicPace(self.cycle.dt)

    def run(self) -> None:
        """Open, cycle, stop, close."""
        signal.signal(signal.SIGTERM, self._terminate)
        cycle = self.cycle
        try:
            self._alarm()
            cycle.open(self.pace.now())
            prepare_process(self.realtime)
            self.pace.restart()
            self._publish(self.pace.now())
            self.channel.send({"ready": {"realtime": is_realtime(), "rate_hz": cycle.spec.rate_hz}})
            self._cycle_until_closed()
        except BaseException:
            self.closing = True
            with contextlib.suppress(Exception):
                self._cycle_until_closed()  # whatever went wrong, the arms are brought to rest if that can be done
            raise
        finally:
            self._alarm()
            cycle.close()

    def _cycle_until_closed(self) -> None:
        while not self._is_over():
            self._turn()
            driver = self.cycle.looping_driver()
            if driver is not None:
                driver.loop(self._turn)

    def _is_over(self) -> bool:
        """The app is done with this process, and its arms are at rest, or have had their time."""
        if not self.closing:
            return False
        now = time.monotonic()
        if self._give_up_at == math.inf:
            self._give_up_at = now + STOP_LIMIT
        return self._resting or now > self._give_up_at

    def _alarm(self) -> None:
        """Have this process end if a vendor's library does not come back: nothing in Python could end it then.

        Not in lock-step, where the app may take its time. (The signal's default is the end.)
        """
        if isinstance(self.pace, DevicePace):
            signal.alarm(HANG)

    def _terminate(self, signum: int, frame: object) -> None:
        self.closing = True
        self.pace.run_free()

    def _turn(self) -> None:
        """One cycle; a driver's library may be the one who calls it."""
        cycle = self.cycle
        if self.closing:
            self._resting = cycle.stop_sessions()
            if self._is_over():
                driver = cycle.looping_driver()
                if driver is not None:
                    driver.halt()
                return
        self._alarm()
        now = self.pace.wait()
        late = self._suspension is not None and self._suspension.ended()
        cycle.step(now, self.pace.heard(self.memory.get_app()), late)
        self._publish(now)
        self._settle_up()
        self._attend(0.0)

    def _settle_up(self) -> None:
        """Lock-step: the cycles that the app asked for are done."""
        if self._owed is not None and self.pace.pausing:
            number, self._owed = self._owed, None
            self._answer(number, {"result": None})

    def _publish(self, now: float) -> None:
        cycle = self.cycle
        if cycle.ticks % self._state_every == 0 or self.pace.pausing:
            cycle.publish(now)
        if self.snapshots is not None and cycle.ticks % self._snapshot_every == 0:
            self.snapshots.write(now, cycle.world.revision, cycle.world.snapshot())
        clock_now = self.pace.now()
        for unit in cycle.arms.values():
            unit.note_latency(clock_now)
        self.memory.host.write(now, cycle.ticks, self.pace.missed, True)

    def _attend(self, timeout: float) -> None:
        """Serve a request, if there is one."""
        try:
            message = self.channel.receive(timeout) if timeout else self.channel.poll()
        except ConnectionLost:
            self.closing = True
        else:
            if message is not None:
                self._serve(message)
            if self._app_gone():
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
            self.cycle.publish(self.pace.now())  # what was asked for may have changed what the app sees
        self._answer(message["id"], answer)
        self.pace.restart()

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

    def _app_gone(self) -> bool:
        if os.getppid() != self.parent:
            return True
        heartbeat = self.memory.get_app().t
        return heartbeat > 0.0 and time.monotonic() - heartbeat > APP_GONE


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process."""
    HostProcess(channel, memories, config).run()
