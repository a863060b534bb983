"""The app as a person starts it: the recorded tour, the report, and what it says when something is wrong."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from app_kit import run_here

from hal.apps.teleop import main

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "teleop.py"
TOUR = ROOT / "tests" / "data" / "pads" / "tour.jsonl"


def teleop(*arguments: str, timeout: float = 90.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(APP), *arguments], capture_output=True, text=True, timeout=timeout)


def report(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


@pytest.mark.slow
@pytest.mark.parametrize(("clock", "seconds"), [("lock_step", 15), ("real_time", 9)])
def test_the_recorded_tour_drives_the_arm(tmp_path: Path, clock: str, seconds: int) -> None:
    """All of it, and in real time its first half."""
    out = tmp_path / "out.json"
    options = ("--duration", str(seconds), "--report", str(out), "--set", f"simulation.clock={clock}")
    done = teleop("--sim", "--pad", str(TOUR), *options)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found = report(out)
    assert found["backend"] == "pybullet"
    assert found["clean_exit"] is True
    assert found["tcp_travel_m"] >= 0.3
    assert found["trips"] == []
    assert found["faults"] == []
    assert found["servo"]["rate_hz"] == 240
    assert found["servo"]["ticks"] > 133 * seconds
    peak = found["peak"]
    assert set(peak) == {"velocity", "acceleration", "jerk", "position"}
    assert 0.1 < peak["velocity"] <= 0.3 + 1e-6, "0.3 of the joint limits is the most that a session may have"
    assert max(peak.values()) <= 1.0 + 1e-6
    assert set(found["cameras"]) == {"scene", "wrist"}
    if clock == "real_time":
        assert found["latency_ms"]["p50"] > 0.0
        assert found["servo"]["period_ms"]["p50"] == pytest.approx(1000 / 240, rel=0.2)
        assert all(camera["frames"] > 7 * seconds for camera in found["cameras"].values())


def test_the_tour_turns_the_wrist_works_the_hand_and_lets_go_in_motion() -> None:
    """What the recording does to the arm, tick by tick."""
    import hal

    arm_moves, widths, speeds_at_release = [], [], []
    with hal.open("panda_table", sim=True, clock="lock_step", pad=str(TOUR), overrides=["cameras={}"]) as rig:
        arm, pad = rig.robots["panda"], rig.gamepads["pad"]
        start = arm.state()
        teleop_ = hal.Teleop(arm)
        deadman = pad.hold(teleop_.mapping.deadman)
        with arm.control(deadman=deadman, rate_hz=50) as control:
            held = False
            for tick in rig.clock.rate(50):
                motion, grip = teleop_.step(pad.state(), tick.dt)
                control.send(motion, grip=grip)
                state = arm.state()
                if held and not deadman.held:
                    speeds_at_release.append(abs(state.dq_set).max())
                held = deadman.held
                arm_moves.append((state.tcp.distance(start.tcp), abs(state.q - start.q)[6]))
                widths.append(arm.gripper.state().width)
                if pad.finished:
                    break
    assert max(turned for (_, turned), _ in arm_moves) > 0.3, "the hand turned"
    assert min(widths) < 0.2 * max(widths), "the hand closed"
    assert widths[-1] > 0.9 * max(widths), "and opened again"
    assert len(speeds_at_release) >= 2
    assert max(speeds_at_release) > 0.05, "the dead-man was let go of in mid-motion"


def test_dry_run_lists_and_opens_nothing() -> None:
    done = run_here(main, "--sim", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert re.search(r"robot +panda .*simulated \(pybullet\)", done.stdout)
    assert "256x256" in done.stdout


def test_dry_run_loads_the_simulated_world() -> None:
    done = run_here(main, "--sim", "--dry-run")
    assert "note     panda: inertia computed from" in done.stdout
    done = run_here(
        main, "--sim", "--dry-run", "--set", "robots.second={model: panda, base: {position: [-0.5, 0, 0.6]}}"
    )
    assert done.returncode == 2
    assert "robots.second: starts 0." in done.stderr
    assert "inside robot 'panda'" in done.stderr


def test_without_pybullet_one_line_says_what_to_do() -> None:
    """As on Python 3.12 or ARM, where PyBullet has no wheel."""
    code = (
        "import platform, sys; platform.machine = lambda: 'aarch64'\n"
        "import hal.config.context; hal.config.context.package_folder = lambda name: None\n"
        "from hal.apps.teleop import main; sys.exit(main(['--sim']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    head, *lines = done.stderr.strip().splitlines()
    assert head == "ConfigError: 1 problem in the configuration:"
    assert len(lines) == 1
    assert "use Python 3.11" in lines[0]


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--config", "panda_tabel"], ["ConfigError", "panda_tabel", "panda_table"]),
        (["--config", "nowhere/rig.yaml"], ["ConfigError", "nowhere/rig.yaml"]),
        (["--set", "cameras.wrist.output.widht=320"], ["--set", "widht", "did you mean 'width'"]),
        (["--set", "robots.panda.base.position=[1,2]"], ["robots.panda.base.position"]),
        (["--pad", "nothing.jsonl"], ["DeviceNotFound", "nothing.jsonl"]),
        (["--pad", "keyboard"], ["web", "terminal"]),
        (["--mapping", "defualt"], ["defualt", "default"]),
        (["--robot", "pandas", "--pad", str(TOUR)], ["no robot 'pandas'", "did you mean 'panda'"]),
        (["--speed", "2"], ["--speed must be above 0 and at most 1"]),
        (["--duration", "-1"], ["--duration must be positive"]),
        (["--report", "/nowhere/out.json"], ["/nowhere"]),
    ],
)
def test_a_persons_mistake_is_a_message_not_a_traceback(arguments: list[str], texts: list[str]) -> None:
    bare = "cameras={}" if "widht" not in str(arguments) else "sim=true"
    done = run_here(main, "--sim", "--set", bare, *arguments)
    assert done.returncode == 2
    for text in texts:
        assert text in done.stderr


def test_the_program_too_ends_with_a_message_and_a_status() -> None:
    done = teleop("--sim", "--config", "nowhere/rig.yaml")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "nowhere/rig.yaml" in done.stderr


def test_a_camera_that_is_not_there_says_so() -> None:
    done = teleop("--real", "--set", "robots.panda.sim=true")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "DeviceNotFound: camera scene" in done.stderr or "robot-hal[realsense]" in done.stderr


@pytest.mark.slow
def test_ctrl_c_stops_reports_and_ends(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    process = subprocess.Popen(
        [sys.executable, str(APP), "--sim", "--pad", str(TOUR), "--report", str(out), "--set", "cameras={}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip().startswith("home:"):  # the last line before it drives
            break
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert report(out)["clean_exit"] is True


def test_help_names_every_option() -> None:
    done = teleop("--help")
    assert done.returncode == 0
    for option in ["config", "sim", "real", "pad", "viewer", "duration", "speed", "set", "report", "dry-run"]:
        assert f"--{option}" in done.stdout
