"""The process around a group's servos in real time.

It ends by itself when the app is gone, brakes its arms when the app does not answer, and is not reached by the
terminal's signals.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Sequence
from typing import Any

from ..errors import ConnectionLost
from ..specs import GroupSpec, from_json
from .cycle import Cycle
from .mailbox import SeriesBox
from .pacer import Pacer, prepare_process
from .process import Channel, SharedMemory, pack_error
from .records import GroupMemory

__all__ = ["main"]

APP_GONE = 30.0
"""An app that is there but has given no sign of life for so long is taken for gone, s. Its arms stopped long before."""
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
        joints = [(robot.name, len(robot.joints)) for robot in spec.robots]
        buffer = memories[0].buffer
        self.memory = GroupMemory(buffer, joints)
        self.snapshots: SeriesBox | None = None
        if spec.world is not None:
            self.snapshots = SeriesBox(buffer[GroupMemory.size(joints) :], config["snapshot_capacity"])
        self.cycle = Cycle(spec, self.memory)
        self.realtime = bool(config.get("realtime", False))
        # A fast servo tells the app and the renderer less often than it ticks: nobody could look that often.
        self._state_every = max(1, round(spec.rate_hz / STATES_HZ))
        self._snapshot_every = max(1, round(spec.rate_hz / SNAPSHOTS_HZ))
        self.closing = False
        self.pacer = Pacer(self.cycle.dt)

    def run(self) -> None:
        """Open, cycle, stop, close."""
        signal.signal(signal.SIGTERM, self._terminate)
        cycle = self.cycle
        try:
            cycle.open(time.monotonic())
            scheduling = prepare_process(self.realtime)
            self.pacer.restart()
            self._publish(time.monotonic())
            self.channel.send({"ready": {"scheduling": scheduling, "rate_hz": cycle.spec.rate_hz}})
            while not self.closing:
                self._turn()
                if self._app_gone():
                    self.closing = True
            self._stop()
        except BaseException:
            with contextlib.suppress(Exception):
                self._stop()  # whatever went wrong, the arms are brought to rest if that can still be done
            raise
        finally:
            cycle.close()

    def _terminate(self, signum: int, frame: object) -> None:
        self.closing = True

    def _turn(self) -> None:
        now = time.monotonic() if self.cycle.paces_itself else self.pacer.wait()
        self.cycle.step(now, self.memory.get_app())
        self._publish(now)
        try:
            message = self.channel.poll()
        except ConnectionLost:
            self.closing = True
            return
        if message is not None:
            self._serve(message)

    def _publish(self, now: float) -> None:
        cycle = self.cycle
        if cycle.ticks % self._state_every == 0:
            cycle.publish(now)
        if self.snapshots is not None and cycle.ticks % self._snapshot_every == 0:
            self.snapshots.write(now, cycle.world.revision, cycle.world.snapshot())
        clock_now = time.monotonic()
        for unit in cycle.arms.values():
            unit.note_latency(clock_now)
        self.memory.host.write(now, cycle.ticks, self.pacer.missed, True)

    def _serve(self, message: dict[str, Any]) -> None:
        """Answer a request between two ticks; simulated time stands still meanwhile."""
        method = message["method"]
        if method == "close":
            self.closing = True
            return
        try:
            answer = {"result": self._ask(method, message["params"])}
        except Exception as error:
            answer = {"error": pack_error(error)}
        try:
            self.channel.send({"id": message["id"], **answer})
        except ConnectionLost:
            self.closing = True  # the app is gone: come to rest first
        if not self.cycle.paces_itself:
            self.pacer.restart()

    def _ask(self, method: str, params: dict[str, Any]) -> Any:
        result = self.cycle.request(method, params)
        pacer = self.pacer
        if method == "statistics":
            result = result | {"missed": pacer.missed, "period_s": pacer.periods.summary()}
        elif method == "reset_statistics":
            pacer.reset_statistics()
        return result

    def _app_gone(self) -> bool:
        if os.getppid() != self.parent:
            return True
        heartbeat = self.memory.get_app().t
        return heartbeat > 0.0 and time.monotonic() - heartbeat > APP_GONE

    def _stop(self) -> None:
        """Bring every arm to rest before the devices are closed."""
        deadline = time.monotonic() + STOP_LIMIT
        while not self.cycle.stop_sessions() and time.monotonic() < deadline:
            now = time.monotonic() if self.cycle.paces_itself else self.pacer.wait()
            self.cycle.step(now, self.memory.get_app())
            self._publish(now)


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process."""
    HostProcess(channel, memories, config).run()
