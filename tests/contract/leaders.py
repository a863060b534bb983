"""Benches of leaders: the mock, and an SO-101's on a pseudo terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from unittest.mock import patch

from servo_bus_kit import SteppedServos, so101_leader

from hal.config import load
from hal.drivers.mock.leader import MockLeader
from hal.drivers.servo_bus import bus
from hal.testing import PadBench


@contextmanager
def mock_leader() -> Iterator[PadBench]:
    rig = {"leaders": {"lead": {"model": "so101_leader", "sim": True}}}
    with closing(MockLeader(load(rig).resolve().pads[0])) as driver:
        yield PadBench(
            driver=driver,
            lose=lambda: driver.inject(disconnect=True),
            restore=lambda: driver.inject(disconnect=False),
            freeze=lambda: driver.inject(freeze=True),
        )


@contextmanager
def feetech_leader() -> Iterator[PadBench]:
    """An emulated SO-101, whose motors have no torque."""
    with SteppedServos() as far, closing(so101_leader(far)) as driver, ExitStack() as stack:

        def freeze() -> None:
            far.execute("silent all on")
            stack.enter_context(patch.object(bus, "_ANSWER", 0.02))  # no answer comes: nobody has to wait for it long

        yield PadBench(
            driver=driver,
            advance=lambda: far.advance(0.01),
            lose=lambda: far.execute("unplug on") and None,
            restore=lambda: far.execute("unplug off") and None,
            freeze=freeze,
        )
