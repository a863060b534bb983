"""Faults of an emulated UFACTORY arm, as a program meets them: named in 150 ms with the remedy, the arm at rest."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from math import inf

import pytest
from waiting import wait_until

import hal

from .network_kit import XArmEmulator
from .test_ur_faults import find_code, recover, wait_code

pytestmark = [pytest.mark.slow, pytest.mark.pair]

NAMED_WITHIN = 0.150
FAULTS = {
    "C31": ("error 31", ""),
    "C24 after a jump": ("jump 0.3", ""),
    "C77 that nobody knows": ("error 77", ""),
    "C1": ("estop on", "estop off"),
    "STOPPED": ("state 4", ""),
    "STOPPED by motors that were switched off": ("power off", ""),
    "PAUSED": ("state 3", ""),
    "OTHER_MODE": ("mode 0", ""),
    "OTHER_MODE by hand": ("mode 2", "mode 0"),
    "SILENT": ("silence 0.6", ""),
    "SILENT to commands": ("mute 0.6", ""),
    "SILENT without a connection": ("cut 0.6", ""),
    "SILENT as reports are lost": ("lose 1", "lose 0"),
    "SILENT until late reports come": ("late 0.4", "late 0"),
}
"""Code, and what it is -> what causes it, and what ends that."""


@pytest.fixture(scope="module")
def emulator() -> Iterator[XArmEmulator]:
    emulator = XArmEmulator()
    yield emulator
    emulator.close()


@pytest.fixture(scope="module")
def rig(emulator: XArmEmulator) -> Iterator[hal.Rig]:
    with hal.open(emulator.rig(load={"mass": 1.5, "com": [0.0, 0.0, 0.05]})) as rig:
        yield rig


def drive(rig: hal.Rig, emulator: XArmEmulator, cause: str, code: str, speed: float = 0.2) -> float:
    """Move until a fault that is caused in the motion ends the session; return the time until it was named, s."""
    arm, named = rig.robots["arm"], inf
    arm.move_to(arm.home, unattended=True, speed=0.3)
    with pytest.raises(hal.HalError), arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, speed, 0, 0, 0]))
            if named == inf and max(emulator.status()["dq"]) > 0.8 * speed:
                emulator.control.send(cause)
                began = time.monotonic()
                wait_code(arm, code)
                named = time.monotonic() - began
            assert tick.elapsed < 10.0
    return named


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_motion_is_named_and_the_arm_continues_after_recover(
    rig: hal.Rig, emulator: XArmEmulator, name: str
) -> None:
    arm, (cause, end) = rig.robots["arm"], FAULTS[name]
    named = drive(rig, emulator, cause, name.partition(" ")[0])
    print(f"{name}: {1e3 * named:.0f} ms")
    assert named < NAMED_WITHIN
    emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3, 0.5)
    if end:
        emulator.control.send(end)
    recover(rig, arm)
    arm.move_to(arm.home, unattended=True, speed=0.3)
    wait_until(lambda: abs(arm.state().q - arm.home).max() < 2e-3)


def test_an_answer_that_is_late_stops_the_arm_and_no_set_point_jumps(rig: hal.Rig, emulator: XArmEmulator) -> None:
    """The arm stands meanwhile, and goes on."""
    arm = rig.robots["arm"]
    arm.move_to(arm.home, unattended=True, speed=0.3)
    with arm.control(rate_hz=50, unattended=True) as control:
        muted = 0.0
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, 0, 0, 0, 0.9]))
            if not muted and max(emulator.status()["dq"]) > 0.7:
                emulator.control.send("mute 0.08")
                muted = tick.elapsed
            if muted and tick.elapsed > muted + 0.8:
                break
        assert max(emulator.status()["dq"]) > 0.7, "it moves again"
    assert not emulator.status()["error"]


def test_an_arm_that_was_moved_by_hand_stays_there_when_the_next_session_opens(
    rig: hal.Rig, emulator: XArmEmulator
) -> None:
    arm = rig.robots["arm"]
    drive(rig, emulator, "state 4", "STOPPED")
    emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3)
    emulator.control.send("jog 6 -0.3")
    moved = emulator.status()["q"]
    recover(rig, arm)
    with arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0.0] * 7))
            if tick.elapsed > 0.3:
                break
    assert emulator.status()["target_q"] == pytest.approx(moved, abs=1e-4)


def test_an_arm_that_is_held_back_is_stopped(rig: hal.Rig, emulator: XArmEmulator) -> None:
    arm = rig.robots["arm"]
    arm.move_to(arm.home, unattended=True, speed=0.3)
    emulator.control.send("block on")
    with pytest.raises(hal.RobotFault, match="not where its set-points are"):
        arm.move_to(arm.home + [0, 0, 0, 0, 0, 0, 1.5], unattended=True, speed=0.3)
    wait_code(arm, "NOT_FOLLOWING")
    stopped = emulator.wait_for(lambda status: status["state"] == 4)
    emulator.control.send("block off")
    time.sleep(0.2)
    assert emulator.status()["q"] == pytest.approx(stopped["q"], abs=1e-3), "nothing moves once it is free"
    recover(rig, arm)


def test_positions_that_are_no_numbers_stop_the_arm(rig: hal.Rig, emulator: XArmEmulator) -> None:
    arm = rig.robots["arm"]
    arm.move_to(arm.home, unattended=True, speed=0.3)
    with pytest.raises(hal.HalError), arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, 0.2, 0, 0, 0]))
            if max(emulator.status()["dq"]) > 0.1:
                emulator.control.send("nan on")
            assert tick.elapsed < 10.0
    status = emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3, 0.5)
    assert all(map(math.isfinite, status["target_q"]))
    emulator.control.send("nan off")
    recover(rig, arm)


def test_a_pressed_emergency_stop_cannot_be_cleared(rig: hal.Rig, emulator: XArmEmulator) -> None:
    arm = rig.robots["arm"]
    emulator.control.send("estop on")
    wait_code(arm, "C1", 0.5)
    with pytest.raises(hal.RobotFault) as refused:
        arm.recover()
    assert refused.value.code == "C1"
    with pytest.raises(hal.RobotFault):
        arm.move_to(arm.home, unattended=True)
    assert not emulator.status()["enabled"], "nothing switches the motors on"
    emulator.control.send("estop off")
    recover(rig, arm)


def test_an_arm_that_is_led_by_hand_opens_no_session() -> None:
    other = XArmEmulator()
    try:
        other.control.send("power on")
        with hal.open(other.rig()) as rig:
            other.control.send("mode 2")
            time.sleep(0.05)
            with pytest.raises(hal.RobotFault) as refused:
                rig.robots["arm"].move_to(rig.robots["arm"].home, unattended=True)
            assert refused.value.code == "MANUAL_MODE"
            assert other.status()["mode"] == 2
    finally:
        other.close()


def test_the_load_of_the_rig_is_set_when_a_session_opens(rig: hal.Rig, emulator: XArmEmulator) -> None:
    rig.robots["arm"].move_to(rig.robots["arm"].home, unattended=True)
    assert emulator.status()["load"] == pytest.approx([1.5, 0, 0, 50])


def test_a_warning_stops_nothing(rig: hal.Rig, emulator: XArmEmulator) -> None:
    arm = rig.robots["arm"]
    emulator.control.send("warn 11")
    assert abs(arm.move_to(arm.home + 0.2, unattended=True, speed=0.3).q - arm.home - 0.2).max() < 2e-3
    assert find_code(arm) == ""
    wait_until(lambda: rig.statistics()["arm"]["robots"]["arm"]["driver"]["warning"] == 11, "the warning is known")
    arm.recover()
    emulator.control.send("warn 0")
