"""The emulator at work: one thread per bus, which steps its arms in real time, answers frames, and injects faults.

with CanEmulator("yam_emulator") as emulator:
    emulator.execute("status 3 A")           # any command of the console, from any thread
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import can

from hal.drivers.can.settings import BusSettings
from hal.drivers.scene.shared import address_of
from hal.specs import RobotSpec
from hal_emulators.lines import LONGEST_GAP, Losses
from hal_emulators.shared_world import PRIORITY, ArmInWorld, load_real, raise_priority

from .damiao import EmulatedDamiaoArm
from .piper import EmulatedPiperArm

_STEP = 1e-3
"""Step of the mechanics, s."""
EmulatedArm = EmulatedDamiaoArm | EmulatedPiperArm
_ARMS: Mapping[str, Callable[[RobotSpec], EmulatedArm]] = {"damiao": EmulatedDamiaoArm, "piper": EmulatedPiperArm}


class FrameFaults:
    """What happens to the frames of one arm on their way."""

    def __init__(self, seed: int = 0) -> None:
        self.losses = Losses(seed)
        """Replies that are lost, by the number of the motor."""
        self.reset()

    def reset(self) -> None:
        """End all of them."""
        self.losses.clear()
        self.delay = 0.0
        """Lateness of the replies, s."""
        self.copies = 1
        """How often each reply is sent."""
        self.silent_until: dict[int, float] = {}
        """Number of a motor, 0 for all -> time until which it neither hears nor answers, on the monotonic clock, s."""

    def silent(self, motor: int, now: float) -> bool:
        until = self.silent_until
        return bool(until) and (until.get(0, 0.0) > now or until.get(motor, 0.0) > now)


class EmulatedBus:
    """One bus with its arms, served by a thread.

    Attributes:
        arms: The arms on it, with the faults of their frames.
        lock: Held while the thread works; hold it to change an arm.
        cut_until: Time until which no frame passes, s on the monotonic clock.
        stall: Time for which the thread stands still next, s.
        received: Frames so far.
        late: Steps that were left out because the machine had no time.
    """

    def __init__(
        self, settings: BusSettings, arms: Sequence[EmulatedArm], seed: int = 0, realtime: bool = False
    ) -> None:
        self.settings = settings
        self._realtime = realtime
        self.arms = {arm.name: arm for arm in arms}
        self.faults = {arm.name: FrameFaults(seed) for arm in arms}
        self.lock = threading.Lock()
        self.cut_until = 0.0
        self.stall = 0.0
        self.received = self.late = 0
        self.error: Exception | None = None
        self._waiting: list[tuple[float, int, int, bytes]] = []
        """Late frames: time, order, id, data."""
        self._order = itertools.count()
        self._end = threading.Event()
        self._bus: can.BusABC | None = None
        self._thread = threading.Thread(target=self._run, name=f"can-emulator-{settings.channel}", daemon=True)

    def start(self) -> None:
        """Open the bus and start the thread. Raises what python-can raises if it cannot be opened."""
        self.open()
        self._thread.start()

    def open(self) -> None:
        """Open the bus, for a program that calls :meth:`advance` itself instead of :meth:`start`."""
        self._bus = can.Bus(**self.settings.arguments())

    def advance(self, seconds: float) -> None:
        """Answer what has come, and let ``seconds`` pass at once."""
        self._take_all(0.0)
        with self.lock:
            for _ in range(round(seconds / _STEP)):
                self._step_arms()
            self._flush(time.monotonic())

    def stop(self) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        if self._bus is not None:
            self._bus.shutdown()

    def send(self, id: int, data: bytes) -> None:
        fd = self.settings.fd
        message = can.Message(arbitration_id=id, is_extended_id=False, data=data, is_fd=fd, bitrate_switch=fd)
        if self._bus is not None:
            with contextlib.suppress(can.CanError, OSError):  # a full queue, or a bus that is going down
                self._bus.send(message)

    def _run(self) -> None:
        if self._realtime:
            raise_priority(PRIORITY)
        try:
            self._serve()
        except Exception as error:  # reported by whoever looks at it
            self.error = error
            raise

    def _serve(self) -> None:
        due = time.monotonic()
        while not self._end.is_set():
            if self.stall:
                pause, self.stall = self.stall, 0.0
                self._end.wait(pause)
            now = time.monotonic()
            with self.lock:
                if now - due > LONGEST_GAP:
                    self.late += int((now - due) / _STEP)
                    due = now
                while due <= now:
                    due += _STEP
                    self._step_arms()
                self._flush(now)
            self._take_all(max(0.0, due - time.monotonic()))

    def _step_arms(self) -> None:
        for name, arm in self.arms.items():
            arm.step(_STEP, self._sender(name))

    def _take_all(self, patience: float) -> None:
        """Take every frame that has come, or that comes within ``patience`` seconds."""
        bus = self._bus
        assert bus is not None
        message = bus.recv(patience)
        while message is not None:
            if not message.is_error_frame:
                with self.lock:
                    self._take(message.arbitration_id, bytes(message.data))
            message = bus.recv(0.0)

    def _take(self, id: int, data: bytes) -> None:
        now = time.monotonic()
        self.received += 1
        if now < self.cut_until:
            return
        for name, arm in self.arms.items():
            faults = self.faults[name]
            motor = id if id < 0x7FF else data[0] if data else 0
            if not faults.silent(motor, now):
                arm.take(id, data, self._sender(name))

    def _sender(self, name: str) -> Callable[[int, bytes, int], None]:
        faults = self.faults[name]

        def send(id: int, data: bytes, motor: int) -> None:
            now = time.monotonic()
            if now < self.cut_until or faults.silent(motor, now) or faults.losses.take(motor):
                return
            for _ in range(faults.copies):
                if faults.delay > 0.0:
                    heapq.heappush(self._waiting, (now + faults.delay, next(self._order), id, data))
                else:
                    self.send(id, data)

        return send

    def _flush(self, now: float) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            _, _, id, data = heapq.heappop(self._waiting)
            if now >= self.cut_until:
                self.send(id, data)


class CanEmulator:
    """All CAN arms of a rig, each on its bus."""

    def __init__(
        self,
        config: str | Path | Mapping[str, Any],
        overrides: Sequence[str] = (),
        seed: int = 0,
        realtime: bool = False,
        in_world: bool = False,
    ) -> None:
        """Build the arms of a rig, given as for :func:`hal.open`, that have a CAN driver and are not simulated.

        With ``realtime`` its threads have the priority of a servo; with ``in_world`` the arms are in the simulated
        world that :func:`hal_emulators.shared_world.run_world` runs. Raises ConfigError, ValueError if the rig has no
        such arm, and ConnectionLost if there is no such world.
        """
        specs = [spec for spec in load_real(config, overrides).robots if spec.driver in _ARMS]
        if not specs:
            raise ValueError("this rig has no arm on a CAN bus that is not simulated")
        self.arms: dict[str, EmulatedArm] = {spec.name: _ARMS[spec.driver](spec) for spec in specs}
        for spec in specs if in_world else ():
            self.arms[spec.name].world = ArmInWorld(address_of(spec), spec.name)
        keys = {arm.bus.key: arm.bus for arm in self.arms.values()}
        self.buses = [
            EmulatedBus(settings, [arm for arm in self.arms.values() if arm.bus.key == key], seed, realtime)
            for key, settings in keys.items()
        ]

    def execute(self, line: str | Sequence[object]) -> dict[str, Any]:
        """Execute a command of the console, and return its answer. Raises ValueError if it is invalid."""
        from .console import execute

        words = line.split() if isinstance(line, str) else [str(word) for word in line]
        return execute(self, words)

    def bus_of(self, arm: EmulatedArm) -> EmulatedBus:
        return next(bus for bus in self.buses if arm.name in bus.arms)

    def __enter__(self) -> CanEmulator:
        for bus in self.buses:
            bus.start()
        return self

    def __exit__(self, *_: object) -> None:
        for bus in self.buses:
            bus.stop()
