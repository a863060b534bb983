"""Benches for a PiPER and its gripper: the unmodified drivers, and the emulator at the other end of a bus in memory.

The emulator is stepped by the bench's clock, so nothing here depends on real time. Only while a driver opens, which
waits for the arm's reports, a thread keeps it running.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can

from hal.config import load
from hal.driver import GripperDriver, RobotDriver
from hal.drivers.can.emulator.piper import EmulatedPiperArm as EmulatedPiper
from hal.drivers.can.piper import PiperArm
from hal.drivers.can.piper_gripper import PiperGripper
from hal.specs import RobotSpec
from hal.testing import GripperBench, RobotBench

__all__ = ["PiperNode", "piper_arm", "piper_gripper", "piper_spec"]

_STEP = 0.001
"""s by which the emulator's plant is stepped."""
_channels = itertools.count()


def piper_spec() -> RobotSpec:
    """Return the record of a PiPER on a bus in memory that no other test uses."""
    overrides = ["cameras={}", "sim=false"]
    bus = f"{{interface: virtual, channel: piper{next(_channels)}}}"
    overrides += [f"robots.arm.real={bus}", f"robots.arm.gripper.real={bus}"]
    return load("piper", overrides=overrides).resolve().robots[0]


class PiperNode:
    """An emulated PiPER at the other end of a bus in memory.

    Attributes:
        arm: The emulator; a test may change its state at any time between two calls of :meth:`advance`.
        silent: Whether its frames get lost.
        sent: Every frame that the driver has sent: id and data.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self.arm = EmulatedPiper(spec)
        self.silent = False
        self.sent: list[tuple[int, bytes]] = []
        self._bus = can.Bus(interface="virtual", channel=spec.options["channel"])
        self._lock = threading.Lock()

    def advance(self, seconds: float) -> None:
        """Take the frames that have come, and let time pass."""
        with self._lock:
            while (message := self._bus.recv(0.0)) is not None:
                self.sent.append((message.arbitration_id, bytes(message.data)))
                self.arm.take(message.arbitration_id, bytes(message.data), self.send)
            for _ in range(round(seconds / _STEP)):
                self.arm.step(_STEP, self.send)

    def send(self, id: int, data: bytes, motor: int = 0) -> None:
        """Send a frame to the driver."""
        if not self.silent:
            self._bus.send(can.Message(arbitration_id=id, data=data, is_extended_id=False))

    def while_opening(self, open_device: Callable[[], None]) -> Callable[[], None]:
        """Return ``open_device`` with the emulator running meanwhile."""

        def opened() -> None:
            done = threading.Event()

            def run() -> None:
                while not done.is_set():
                    self.advance(0.005)
                    time.sleep(0.001)

            thread = threading.Thread(target=run, daemon=True)
            thread.start()
            try:
                open_device()
            finally:
                done.set()
                thread.join()

        return opened

    def silence(self) -> None:
        """Lose every frame that the arm sends: its cable is cut."""
        self.silent = True

    def restore(self) -> None:
        """End :meth:`silence`."""
        self.silent = False

    def fail(self) -> str:
        """Report a collision, until the joints' errors are cleared."""
        self.arm.set_status(0, 0x7)
        return "collision"

    def close(self) -> None:
        self._bus.shutdown()


@contextmanager
def _node(driver: RobotDriver | GripperDriver, spec: RobotSpec) -> Iterator[PiperNode]:
    node = PiperNode(spec)
    driver.open = node.while_opening(driver.open)  # type: ignore[method-assign]
    try:
        yield node
    finally:
        driver.close()
        node.close()


@contextmanager
def piper_arm() -> Iterator[RobotBench]:
    """A PiPER at 200 Hz."""
    spec = piper_spec()
    driver = PiperArm(spec)
    with _node(driver, spec) as node:
        yield RobotBench(
            driver=driver,
            advance=lambda: node.advance(1.0 / spec.rate_hz),
            lose=node.silence,
            restore=node.restore,
            fail=node.fail,
            patience=5.0,
        )


@contextmanager
def piper_gripper() -> Iterator[GripperBench]:
    """The gripper of a PiPER, wide open."""
    spec = piper_spec()
    assert spec.gripper is not None
    driver = PiperGripper(spec.gripper)
    with _node(driver, spec) as node:
        node.arm.gripper_width = spec.gripper.width_max
        node.arm.restart()
        yield GripperBench(
            driver=driver,
            dt=1.0 / spec.rate_hz,
            advance=lambda: node.advance(1.0 / spec.rate_hz),
            put_object=node.arm.set_object,
            lose=node.silence,
            restore=node.restore,
            patience=5.0,
        )
