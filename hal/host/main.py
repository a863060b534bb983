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
from collections.abc import Sequence
from typing import Any

from ..errors import ConnectionLost
from ..specs import GroupSpec, from_json
from .cycle import Cycle
from .mailbox import SeriesBox
from .pace import DevicePace, Pace, Steps, Suspension
from .pacer import Pacer
from .process import Channel, SharedMemory, pack_error
from .records import GroupMemory
from .scheduling import describe, is_realtime, prepare_process

__all__ = ["main"]

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
        self._suspension = Suspension() if self.cycle.attended else None
        self.pace: Pace
        if spec.clock == "lock_step":
            self.pace = Steps(self.cycle, self._attend)
        elif self.cycle.paces_itself:
            self.pace = DevicePace(self.cycle)
        else:
            self.pace = Pacer(self.cycle.dt)

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
        if method == "advance" and isinstance(self.pace, Steps):
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
