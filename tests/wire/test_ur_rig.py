"""An emulated UR arm with the unmodified ur_rtde: in a program of its own, and behind hal.open."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hal
from hal.config import load
from hal.drivers.ur.arm import find_tcp
from hal.drivers.ur.preflight import check
from hal_emulators.ur.controller import Controller
from hal_emulators.ur.motion import forward

from .network_kit import UrEmulator, check_same_poses, kill_app
from .test_ur_faults import recover, wait_code

pytestmark = [pytest.mark.slow, pytest.mark.pair]

STOPS_WITHIN = 0.150
"""From the end of the host's messages to the end of the program, s."""


@pytest.fixture
def emulator() -> Iterator[UrEmulator]:
    emulator = UrEmulator()
    yield emulator
    emulator.close()


def test_a_program_of_its_own_moves_the_arm_with_ur_rtde(emulator: UrEmulator) -> None:
    command = [sys.executable, str(Path(__file__).with_name("ur_client.py")), emulator.host]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    done: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    assert done["dashboard"] == [True, "Robotmode: RUNNING", "UR5"]
    assert done["moveJ"] == pytest.approx([0, 0, 0, 0, 0, 0.4], abs=1e-3)
    assert done["servoJ"] == pytest.approx([0, 0, 0, 0, 0.1, 0.4], abs=1e-3)
    assert done["speed"] == pytest.approx(0.3, abs=0.01)
    assert done["still"][0] < 0.01
    assert done["still"][1]
    assert done["jump"][0]
    assert not done["jump"][2]
    assert abs(done["jump"][1]) < 0.05, "it does not follow a jump"
    assert "5s" in done["too early"]
    assert done["unlocked"] == [False, True]
    assert [done["again"], done["watchdog"]] == [True, False]


def find_children() -> set[int]:
    return set(map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()))


def drive(rig: hal.Rig, emulator: UrEmulator, act: Any) -> None:
    """Move until the session ends; ``act`` once the arm moves."""
    with (
        pytest.raises(hal.HalError),
        rig.robots["arm"].control(rate_hz=50, unattended=True) as control,
    ):
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, 0.2, 0, 0]))
            if tick.elapsed > 0.4 and act is not None:
                assert max(emulator.status()["dq"]) > 0.1
                act = act()
            assert tick.elapsed < 10.0


def test_the_controller_stops_its_program_when_the_host_is_killed(emulator: UrEmulator) -> None:
    before = find_children()
    with hal.open(emulator.rig()) as rig:
        (host,) = find_children() - before
        drive(rig, emulator, lambda: os.kill(host, signal.SIGKILL))
        killed = emulator.wait_for(lambda status: not status["program"])
        assert "watchdog" in killed["events"][-1]
    rest = emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3, 0.5)
    time.sleep(0.1)
    assert emulator.status()["q"] == pytest.approx(rest["q"], abs=1e-3), "it stands"


def test_the_arm_stands_150_ms_after_the_last_message(emulator: UrEmulator) -> None:
    before = find_children()
    times: list[float] = []
    with hal.open(emulator.rig()) as rig:
        (host,) = find_children() - before

        def freeze() -> None:
            os.kill(host, signal.SIGSTOP)
            times.append(emulator.status()["now"])
            status = emulator.wait_for(lambda status: not status["program"] and max(map(abs, status["dq"])) < 1e-3)
            times.append(status["now"])
            os.kill(host, signal.SIGCONT)

        drive(rig, emulator, freeze)
        arm = rig.robots["arm"]
        wait_code(arm, "WATCHDOG")
        recover(rig, arm)
        assert abs(arm.move_to(arm.home, unattended=True, speed=0.3).q - arm.home).max() < 2e-3
    print(f"at rest {1e3 * (times[1] - times[0]):.0f} ms after the last message")
    assert times[1] - times[0] < STOPS_WITHIN


def test_the_arm_stands_when_the_app_is_killed(emulator: UrEmulator) -> None:
    kill_app(emulator)
    emulator.wait_for(lambda status: not status["program"], 20.0)


def test_the_same_program_ends_at_the_same_poses_on_the_arm_and_in_simulation(emulator: UrEmulator) -> None:
    pytest.importorskip("airo_models", reason="needs airo-models: pip install 'robot-hal[robots]'")
    check_same_poses(emulator, [0.2, -0.1, 0.1, 0, 0, 0.3], [-0.2, 0.1, -0.2, 0.2, 0.1, 0])


def test_a_lost_state_now_and_then_stops_nothing(emulator: UrEmulator) -> None:
    with hal.open(emulator.rig()) as rig:
        emulator.control.send("lose 0.3")
        arm = rig.robots["arm"]
        assert abs(arm.move_to(arm.home + 0.2, unattended=True, speed=0.3).q - arm.home - 0.2).max() < 2e-3
        assert arm.state(max_age=inf).fault is None
        assert emulator.status()["lost"] > 20


def test_another_arm_is_driven_by_its_model() -> None:
    """A CB3, with 125 Hz and without remote control."""
    emulator = UrEmulator(robot="ur5")
    try:
        with hal.open(emulator.rig()) as opened:
            arm = opened.robots["arm"]
            goal = arm.home + 0.1
            assert arm.move_to(goal, unattended=True).q == pytest.approx(goal, abs=2e-3)
        assert not emulator.status()["program"]
    finally:
        emulator.close()


def test_the_check_names_the_calibration_and_another_arm() -> None:
    emulator = UrEmulator("--calibrated", robot="ur10e")
    try:
        spec = load(emulator.rig()).resolve().robots[0]
        found = {result.name: result for result in check(spec, 0.2)}
        assert list(found) == ["controller", "state", "calibration", "tcp", "payload", "states"]
        assert found["state"].level == found["payload"].level == found["calibration"].level == "ok"
        twin = Controller("ur10e", spec.home)
        tcp = find_tcp(spec)
        assert tcp is not None
        before = forward(twin.dh, spec.home, tcp)[:3]
        twin.calibrate(0)
        off = 1e3 * np.linalg.norm(np.subtract(before, forward(twin.dh, spec.home, tcp)[:3]))
        assert "a factory calibration, not used here: the model" in found["calibration"].found
        assert found["calibration"].found.endswith(f"by {off:.1f} mm at home")
        rig = emulator.rig()
        rig["robots"]["arm"]["model"] = "ur16e"
        found = {result.name: result for result in check(load(rig).resolve().robots[0], 0.2)}
        assert found["calibration"].level == "fail"
    finally:
        emulator.close()
