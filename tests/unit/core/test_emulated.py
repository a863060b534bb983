"""An emulated arm counts as real: it is stepped by the clock, and may be driven by a recording."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from errors_kit import raises_code

import hal
from hal.errors import CommandError, NotSupported

LAB = """
from hal.registry import DriverSpec

DRIVER = DriverSpec(name="lab", robot="hal.drivers.mock.robot:MockRobot", emulated="lab_arm:emulated")

def emulated(options):
    return options.get("host") == "here"
"""


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "lab_arm.py").write_text(LAB)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("lab_arm", None)


def rig(**hosts: str) -> dict[str, Any]:
    """Return a rig of arms without grippers, by name, each at its host."""
    drivers, hand = {"real": "lab_arm:DRIVER"}, {"enabled": False}
    robots = {n: {"model": "panda", "drivers": drivers, "gripper": hand, "real": {"host": h}} for n, h in hosts.items()}
    return {"sim": False, "robots": robots, "gamepads": {"pad": {}}}


@pytest.mark.slow
def test_the_tour_drives_it_in_lock_step() -> None:
    with hal.open(rig(arm="here"), clock="lock_step", pad="demo") as bench:
        assert bench.attended
        assert bench.emulated
        assert any("emulated" in note for note in bench.notes)
        arm, pad = bench.robots["arm"], bench.gamepads["pad"]
        teleop = hal.Teleop(arm, mapping="default")
        start = arm.state().q.copy()
        with arm.control(deadman=pad.hold("l2"), rate_hz=50) as control:
            for tick in bench.clock.rate(50):
                motion, grip = teleop.step(pad.state(), tick.dt)
                control.send(motion, grip=grip)
                if tick.elapsed > 6.0:
                    break
        assert abs(arm.state().q - start).max() > 0.01


def test_cycles_that_switch_its_drives_on_leave_its_time_with_the_clock(tmp_path: Path) -> None:
    (tmp_path / "lab_arm.py").write_text(LAB.replace("hal.drivers.mock.robot:MockRobot", "drives:ArmWithDrives"))
    with hal.open(rig(arm="here"), clock="lock_step", pad="none") as bench:
        arm, clock = bench.robots["arm"], bench.clock
        start = arm.state().q.copy()
        with arm.control(rate_hz=50, unattended=True) as control:
            for tick in clock.rate(50):
                control.send(hal.JointVelocity([0.2] * arm.n))
                if tick.elapsed > 0.5:
                    break
            assert arm.state().stamp.t <= clock.now() + 1e-6
        assert abs(arm.state().q - start).max() > 0.01


def test_it_still_needs_a_dead_man() -> None:
    with (
        hal.open(rig(arm="here"), clock="lock_step", pad="none") as bench,
        raises_code(CommandError, "deadman_required"),
    ):
        bench.robots["arm"].control(rate_hz=50)


def test_a_recording_must_not_drive_a_real_arm() -> None:
    with raises_code(NotSupported, "recording_on_real_arm"):
        hal.open(rig(arm="here", other="there"), pad="demo")
