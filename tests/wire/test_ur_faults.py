"""Faults of an emulated UR arm, as a program meets them: named in 150 ms with the remedy, the arm at rest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import inf

import pytest
from waiting import wait_until

import hal
from hal_emulators.control import EmulatorControl

from .network_kit import UrEmulator

pytestmark = [pytest.mark.slow, pytest.mark.pair]

NAMED_WITHIN = 0.150
FAULTS = {
    "PROTECTIVE_STOP": ("protective", ""),
    "PROTECTIVE_STOP after a jump": ("jump 0.5", ""),
    "EMERGENCY_STOP": ("estop on", "estop off"),
    "SAFETY_VIOLATION": ("safety 8", "safety 1"),
    "SAFEGUARD_STOP": ("safeguard on", "safeguard off"),
    "NOT_RUNNING": ("power off", "power on"),
    "LOCAL_CONTROL": ("remote off", "remote on"),
    "PROGRAM_STOPPED": ("program", ""),
    "PROGRAM_STOPPED by a pause": ("pause on", ""),
    "PROGRAM_STOPPED by another program": ("program thief", "program"),
    "SPEED_SLIDER": ("slider 0.5", "slider 1"),
    "SPEED_SCALED": ("limit 0.5", "limit 1"),
    "SILENT": ("silence 0.6", ""),
    "SILENT without a connection": ("cut 0.6", ""),
    "SILENT as states are lost": ("lose 1", "lose 0"),
    "SILENT until late states come": ("late 0.4", "late 0"),
}
"""Code, and what it is -> what causes it, and what ends that."""


@pytest.fixture(scope="module")
def emulator() -> Iterator[UrEmulator]:
    emulator = UrEmulator()
    yield emulator
    emulator.close()


@pytest.fixture(scope="module")
def rig(emulator: UrEmulator) -> Iterator[hal.Rig]:
    with hal.open(emulator.rig(load={"mass": 1.5, "com": [0.0, 0.0, 0.05]})) as rig:
        yield rig


def find_code(arm: hal.Robot) -> str:
    """Return the code of the arm's present fault, or an empty text."""
    try:
        fault = arm.state(max_age=inf).fault
    except hal.ConnectionLost as error:
        return error.code
    assert fault is None or fault.remedy
    return fault.code if fault is not None else ""


def wait_code(arm: hal.Robot, code: str, timeout: float = 8.0) -> None:
    end = time.monotonic() + timeout
    while find_code(arm) != code:
        assert time.monotonic() < end, f"{find_code(arm)!r} in place of {code!r}"
        time.sleep(0.002)


def recover(rig: hal.Rig, arm: hal.Robot) -> None:
    """Recover, as soon as the controller allows it."""
    end = time.monotonic() + 8.0
    while True:
        try:
            arm.recover()
            wait_code(arm, "")
            return
        except (hal.RobotFault, hal.ConnectionLost):
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_motion_is_named_and_the_arm_continues_after_recover(
    rig: hal.Rig, emulator: UrEmulator, name: str
) -> None:
    arm, (cause, end) = rig.robots["arm"], FAULTS[name]
    code, named = name.partition(" ")[0], inf
    arm.move_to(arm.home, unattended=True, speed=0.3)
    with (
        pytest.raises(hal.HalError),
        arm.control(rate_hz=50, unattended=True) as control,
    ):
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, 0.2, 0, 0]))
            if named == inf and max(emulator.status()["dq"]) > 0.1:
                emulator.control.send(cause)
                began = time.monotonic()
                wait_code(arm, code)
                named = time.monotonic() - began
            assert tick.elapsed < 10.0
    print(f"{name}: {1e3 * named:.0f} ms")
    assert named < NAMED_WITHIN
    emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3, 0.5)
    if end:
        emulator.control.send(end)
    if code in ("EMERGENCY_STOP", "SAFETY_VIOLATION"):
        emulator.control.send("power on")
    recover(rig, arm)
    assert abs(arm.move_to(arm.home, unattended=True, speed=0.3).q - arm.home).max() < 2e-3


def test_a_controller_that_ignores_set_points_is_stopped_before_they_run_away(
    rig: hal.Rig, emulator: UrEmulator
) -> None:
    arm = rig.robots["arm"]
    arm.move_to(arm.home, unattended=True)
    emulator.control.send("stuck on")
    with pytest.raises(hal.RobotFault):
        arm.move_to(arm.home + 0.5, unattended=True)
    assert find_code(arm) == "NOT_FOLLOWING"
    emulator.wait_for(lambda status: not status["program"])
    emulator.control.send("stuck off")
    recover(rig, arm)
    assert arm.move_to(arm.home, unattended=True).q == pytest.approx(arm.home, abs=2e-3)


def stop_in_motion(rig: hal.Rig, emulator: UrEmulator, cause: str) -> None:
    """Stop the arm by a fault in a motion, and wait until it rests."""
    arm = rig.robots["arm"]
    arm.move_to(arm.home, unattended=True, speed=0.3)
    with pytest.raises(hal.HalError), arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, 0.5, 0, 0]))
            if max(emulator.status()["dq"]) > 0.3:
                emulator.control.send(cause)
            assert tick.elapsed < 10.0
    emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3)


def test_a_safeguard_that_is_closed_again_moves_nothing(rig: hal.Rig, emulator: UrEmulator) -> None:
    """It only pauses a program, which would go on to its last set-point by itself."""
    stop_in_motion(rig, emulator, "safeguard on")
    emulator.wait_for(lambda status: not status["program"])
    before = emulator.status()["q"]
    emulator.control.send("safeguard off")
    time.sleep(0.3)
    assert emulator.status()["q"] == pytest.approx(before, abs=1e-6)
    recover(rig, rig.robots["arm"])


def test_an_arm_that_was_moved_by_hand_stays_there_when_the_next_session_opens(
    rig: hal.Rig, emulator: UrEmulator
) -> None:
    """The register of the controller still had the set-point at which the last program was stopped."""
    arm = rig.robots["arm"]
    stop_in_motion(rig, emulator, "program")
    emulator.control.send("jog 3 -0.3")
    moved, events = emulator.status()["q"], emulator.status()["events"]
    recover(rig, arm)
    with arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0.0] * 6))
            if tick.elapsed > 0.4:
                break
    assert emulator.status()["target_q"] == pytest.approx(moved, abs=1e-4)
    assert not any("C153" in event for event in emulator.status()["events"] if event not in events)


def test_a_program_that_was_being_started_as_the_connection_was_lost_is_ended() -> None:
    """Nothing asks for its program any more: it must not run on, with its watchdog fed."""
    from hal.drivers.ur.link import UrLink
    from hal.drivers.ur.settings import UrSettings

    other = UrEmulator()
    link = UrLink("arm", UrSettings(host=other.host), 500.0, None)
    link.open()
    try:
        for _ in range(2):  # a link that is opened again begins anew
            link.start()
            other.wait_for(lambda status: status["program"] == "rtde_control")
            link.lose()
            other.wait_for(lambda status: not status["program"])
            assert not link.ready
            link.close()
            link.open()
            assert not link.starting
    finally:
        link.close()
        other.close()


def test_a_push_is_a_force_in_the_axes_of_the_models_base(rig: hal.Rig, emulator: UrEmulator) -> None:
    """The controller's base is turned by half a turn."""
    emulator.control.send("push 3 4 5")
    arm = rig.robots["arm"]
    wait_until(lambda: arm.state().wrench_ext[:3] == pytest.approx([-3, -4, 5]), "the force is known")


def test_a_session_gives_the_controller_load_and_tcp_of_the_rig(rig: hal.Rig, emulator: UrEmulator) -> None:
    rig.robots["arm"].move_to(rig.robots["arm"].home, unattended=True)
    status = emulator.status()
    assert status["payload"] == 1.5
    assert status["tcp"][:3] == pytest.approx([0, 0, 0.14])


def test_an_arm_that_runs_another_program_opens_no_session(emulator: UrEmulator) -> None:
    other = UrEmulator()
    try:
        with hal.open(other.rig()) as rig, EmulatorControl(other.host) as control:
            control.send("program gluing")
            other.wait_for(lambda status: status["program"] == "gluing")
            with pytest.raises(hal.RobotFault) as refused:
                rig.robots["arm"].move_to(rig.robots["arm"].home, unattended=True)
            assert refused.value.code == "OTHER_PROGRAM"
            control.send("pause on")
            with pytest.raises(hal.RobotFault) as refused:
                rig.robots["arm"].move_to(rig.robots["arm"].home, unattended=True)
            assert refused.value.code == "OTHER_PROGRAM"
            assert other.status()["program"] == "gluing", "it goes on"
        assert other.status()["program"] == "gluing"
    finally:
        other.close()


def test_registers_of_another_client_are_named_and_can_be_avoided() -> None:
    other = UrEmulator()
    import rtde_control

    client = rtde_control.RTDEControlInterface(other.host, 500.0, rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT)
    try:
        with pytest.raises(hal.ConnectionLost) as refused:
            hal.open(other.rig())
        assert refused.value.code == "REGISTERS_TAKEN"
        client.stopScript()
        with hal.open(other.rig(upper_registers=True)) as rig:
            arm = rig.robots["arm"]
            assert abs(arm.move_to(arm.home + 0.05, unattended=True).q - arm.home - 0.05).max() < 2e-3
    finally:
        client.disconnect()
        other.close()
