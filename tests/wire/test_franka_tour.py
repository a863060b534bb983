"""One recorded drive, four arms: simulated and emulated FR3 and Panda end at the same pose, through the same app."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hal
from hal.geometry import Pose

from .calm_tour import write_tour
from .franka_kit import Emulator
from .rig_kit import arm_of, rig_of

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")
pytestmark = pytest.mark.slow

APP = Path(__file__).parents[2] / "apps" / "teleop.py"
RUNS = 20 if os.environ.get("HAL_SOAK") == "1" else 1
APART, TURNED = 0.002, 0.02
"""By how much the ends may differ, m and rad."""


def teleop(tour: Path, report: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start the app on the tour, in lock-step."""
    command = [sys.executable, str(APP), "--config", "franka_emulator", "--pad", str(tour), "--speed", "0.3"]
    command += ["--set", "cameras={}", "--set", "simulation.clock=lock_step", "--report", str(report), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end_of(report: dict[str, Any]) -> Pose:
    end = report["tcp_end"]
    return Pose(end["position"], end["orientation"])


def test_the_same_drive_ends_at_the_same_pose(fr3: Emulator, panda: Emulator, tmp_path: Path) -> None:
    tour = write_tour(tmp_path / "calm.jsonl")
    places = {"simulated": ["--sim"], "FR3": ["--real", *at(fr3, "fr3")], "Panda": ["--real", *at(panda, "panda")]}
    reports: dict[str, Any] = {}
    with contextlib.ExitStack() as stack:
        apps = {name: stack.enter_context(teleop(tour, tmp_path / name, *where)) for name, where in places.items()}
        for name, app in apps.items():
            said, _ = app.communicate(timeout=100)
            assert app.returncode == 0, said
            reports[name] = json.loads((tmp_path / name).read_text())
    for name, report in reports.items():
        assert report["tcp_travel_m"] >= 0.3, name
        assert report["trips"] == report["faults"] == [], name
        assert report["clean_exit"], name
    for emulator in (fr3, panda):
        assert not emulator.events("reflex")
        assert "success" in emulator.events("motion ended")[-1]["text"]
    for one in reports:
        for other in reports:
            distance, angle = end_of(reports[one]).distance(end_of(reports[other]))
            assert distance <= APART, (one, other)
            assert angle <= TURNED, (one, other)


def at(emulator: Emulator, model: str) -> list[str]:
    options = [f"robots.arm.real.host={emulator.host}", f"robots.arm.model={model}", "robots.arm.gripper.enabled=false"]
    return [word for option in options for word in ("--set", option)]


LOSSES = (
    # until s, command to the emulator, repeated every so many s
    (0.4, "lose-commands next 1", 0.02),
    (0.8, "lose-commands next 5", 0.05),
    (1.6, "lose-commands next 19", 0.2),
    (1.9, "lose-commands 0.01", 1.0),
    (2.3, "lose-commands 0.05", 1.0),
    (3.0, "lose-commands 0.2", 1.0),
    (3.4, "lose-states 0.05", 1.0),
)
"""More than what a cable loses, but no 20 set-points in a row: only these are a fault, by the robot's own rule."""


@pytest.mark.timeout(60 + 30 * RUNS)
@pytest.mark.parametrize(("robot", "stream"), [("fr3", "velocity"), ("fr3", "torque"), ("panda", "position")])
def test_packets_that_are_lost_end_no_motion(emulator: Emulator, robot: str, stream: str) -> None:
    """One drive through all losses: 20 runs each with HAL_SOAK=1, else one."""
    options = [f"robots.arm.real.stream={stream}"] if stream != "torque" else []
    controller = hal.JointImpedance() if stream == "torque" else None
    for _ in range(RUNS):
        emulator.refresh()
        with rig_of(emulator.host, robot, *options, lock_step=True) as rig:
            arm = arm_of(rig)
            start, due, schedule = rig.clock.now(), 0.0, list(LOSSES)
            with arm.control(rate_hz=50, unattended=True, controller=controller) as control:
                for tick in rig.clock.rate(50):
                    t = tick.t - start
                    if t > schedule[0][0]:
                        emulator.control.send("lose-commands 0")
                        del schedule[0]
                        due = t
                    if not schedule:
                        break
                    if t >= due:
                        emulator.control.send(schedule[0][1])
                        due += schedule[0][2]
                    turn = np.array([0.06 * np.sin(2 * t), 0.05 * np.cos(3 * t), 0.04 * np.sin(t)])
                    control.send(hal.Twist(turn, [0.0, 0.0, 0.2 * np.sin(2 * t)]))
                emulator.control.send("lose-states 0")
            statistics = rig.statistics()["arm"]["robots"]["arm"]
        assert not emulator.events("reflex")
        assert "success" in emulator.events("motion ended")[-1]["text"]
        assert emulator.control.send("stats")["thrown_away"] > 200, "nothing was lost: the test shows nothing"
        assert statistics["driver"]["lost_states"] > 10
        if stream != "torque":
            assert statistics["lost"] > 200
            assert max(statistics["peak"].values()) < 1.01, "as fast as the robot's own rule goes on"


def test_the_app_outlives_an_arm_that_is_lost(tmp_path: Path) -> None:
    """Robot and cable come back now and then; the program that drives is still there when they do."""
    tour = write_tour(tmp_path / "calm.jsonl")
    with Emulator("--lockstep") as emulator:
        command = [sys.executable, str(APP), "--real", "--config", "franka_emulator", "--pad", str(tour)]
        command += ["--set", "cameras={}", *at(emulator, "fr3")]
        command += ["--duration", "6", "--report", str(tmp_path / "r.json")]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as app:
            emulator.wait_event("motion started", timeout=20.0)
            emulator.control.send("restart 0.3")
            said, _ = app.communicate(timeout=60)
        assert app.returncode == 0, said
        assert "does not answer" in said
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["trips"]
    assert report["servo"]["driver"]["reconnects"] == 1


@pytest.mark.parametrize("robot", ["fr3", "panda"])
def test_velocities_instead_of_positions_go_to_the_same_place(emulator: Emulator, robot: str) -> None:
    with rig_of(emulator.host, robot, "robots.arm.real.stream=velocity", lock_step=True) as rig:
        arm = arm_of(rig)
        goal = arm.home.copy()
        goal[[0, 3, 6]] += (0.2, 0.1, -0.3)
        emulator.control.send("lose-commands 0.05")
        arm.move_to(goal, unattended=True, speed=0.3)
        emulator.control.send("lose-commands 0")
        assert np.abs(arm.state().q - goal).max() < 1e-4
    assert not emulator.events("reflex")
    assert "joint velocity" in emulator.events("motion started")[-1]["text"]
    assert "success" in emulator.events("motion ended")[-1]["text"]


@pytest.mark.parametrize("robot", ["fr3", "panda"])
def test_a_straight_line_is_kept(emulator: Emulator, robot: str) -> None:
    with rig_of(emulator.host, robot, lock_step=True) as rig:
        arm = arm_of(rig)
        start = arm.state().tcp_set
        goal = Pose(start.position + [0.1, 0.15, -0.1], start.orientation)
        motion = arm.start_move_to(goal, straight=True, speed=1.0, unattended=True)
        away = turned = 0.0
        way = (goal.position - start.position) / np.linalg.norm(goal.position - start.position)
        while not motion.done:
            rig.clock.sleep(0.01)
            tcp = arm.state().tcp
            off = tcp.position - start.position
            away = max(away, float(np.linalg.norm(off - (off @ way) * way)))
            turned = max(turned, tcp.distance(start)[1])
        assert motion.wait()
        assert away <= 2e-3
        assert turned <= 5e-3
        assert arm.state().tcp.distance(goal)[0] <= 2e-3
    assert not emulator.events("reflex")
    assert "success" in emulator.events("motion ended")[-1]["text"]
