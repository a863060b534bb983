"""What the checks share: fixtures, and waiting for what must happen."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator

import pytest
from bench import Bench
from kinds import KINDS, Kind

from hal.drivers.evdev.pad import EvdevPad
from hal.gamepad import Gamepad
from hal.specs import PadSpec, from_json

Measured = Callable[[str], None]

_BENCH: pytest.StashKey[Bench] = pytest.StashKey()

LIMIT = 10.0
"""s; how long a check waits for what must happen. What it really took is measured."""


def eventually(condition: Callable[[], object], what: str, limit: float = LIMIT) -> float:
    """When the condition came true, s on the monotonic clock; fails after ``limit`` s, saying ``what`` did not."""
    end = time.monotonic() + limit
    while not condition():
        if time.monotonic() >= end:
            pytest.fail(f"not within {limit:g} s: {what}")
        time.sleep(0.001)
    return time.monotonic()


def node_of(pad: EvdevPad | Gamepad) -> str:
    """Path of the device that it reads."""
    return pad.describe().removesuffix(")").rpartition(", ")[2]


def kernel_driver(node: str) -> str:
    """Name of the kernel's driver behind a device."""
    return os.path.basename(os.path.realpath(f"/sys/class/input/{os.path.basename(node)}/device/device/driver"))


def shows(pad: Gamepad, axes: dict[str, float], buttons: tuple[str, ...] = ()) -> bool:
    """Does the pad show just that? A trigger that is pulled is a pressed button, too."""
    state = pad.state()
    pressed = {*buttons, *(name for name in axes if name in ("l2", "r2"))}
    off = (abs(value - axes.get(name, 0.0)) for name, value in state.axes.items())
    return state.connected and state.buttons == pressed and max(off) < 0.01


def settle(bench: Bench, pad: Gamepad) -> None:
    """Let go of a pad that is plugged in, and wait until it counts."""
    eventually(lambda: pad.state().connected, "the pad connects")
    bench.show()
    eventually(lambda: not pad.waiting_for, "a pad that nobody touches counts")
    eventually(lambda: shows(pad, {}), "a pad that nobody touches shows nothing")


@pytest.fixture(params=KINDS, ids=str)
def kind(request: pytest.FixtureRequest) -> Kind:
    """Each kind of pad."""
    found: Kind = request.param
    return found


def pytest_configure(config: pytest.Config) -> None:
    """Start the process that plays the pads: it is ready when the checks have been read."""
    config.stash[_BENCH] = Bench()


def pytest_unconfigure(config: pytest.Config) -> None:
    """And end it."""
    config.stash[_BENCH].close()


@pytest.fixture
def bench(pytestconfig: pytest.Config) -> Iterator[Bench]:
    """Synthetic pads; what is plugged in when a check ends is unplugged."""
    bench = pytestconfig.stash[_BENCH]
    yield bench
    bench.unplug()


@pytest.fixture(scope="session")
def spec() -> PadSpec:
    """A pad of whatever kind, as the configuration gives it."""
    return from_json(PadSpec, json.loads(os.environ["HAL_KERNEL_PAD"]))


@pytest.fixture
def driver(spec: PadSpec) -> Iterator[EvdevPad]:
    """The driver under test, open."""
    driver = EvdevPad(spec)
    driver.open()
    yield driver
    driver.close()


@pytest.fixture
def pad(driver: EvdevPad) -> Iterator[Gamepad]:
    """The public pad in front of the driver, polled by its own thread as in a rig."""
    pad = Gamepad(driver)
    pad.open(time.monotonic())
    pad.start_thread(time.monotonic)
    yield pad
    error = pad.error
    pad.close()
    assert error is None


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Measured:
    """Say what was measured."""
    return lambda text: record_property("measured", text)
