"""The check as a person starts it, and before the teleoperation opens a rig."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
from app_kit import run_here
from engines_kit import Engine

from hal.apps import _physics
from hal.apps.check import main as check
from hal.apps.teleop import main as teleop

from ..wire.franka_kit import Emulator, free_host

ROOT = Path(__file__).resolve().parents[2]
EMPTY = free_host()
needs_libraries = pytest.mark.skipif(
    importlib.util.find_spec("pylibfranka") is None or importlib.util.find_spec("panda_py") is None,
    reason="needs the Python packages pylibfranka and panda-python",
)


def run(app: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "apps" / app), *arguments], capture_output=True, text=True, timeout=60
    )


def at(host: str) -> tuple[str, ...]:
    return ("--config", "franka_emulator", "--set", f"robots.arm.real.host={host}")


def test_a_simulated_rig_has_nothing_to_check_but_the_computer() -> None:
    done = run_here(check, "--sim")
    assert done.returncode == 0, done.stderr
    assert "checked this computer only" in done.stdout
    assert [word for word in ("kernel", "processor", "scheduling", "memory") if word not in done.stdout] == []


def test_what_fails_is_shown_with_its_remedy_and_is_the_exit_status() -> None:
    done = run("check.py", *at(EMPTY), "--duration", "0.1")
    assert done.returncode == 2
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    (at_line,) = [k for k, line in enumerate(lines) if line.startswith("FAIL")]
    assert "arm: robot" in lines[at_line]
    assert lines[at_line + 1].strip().startswith("-> start it in another terminal: hal emulate franka")


@needs_libraries
def test_json_has_every_finding() -> None:
    with Emulator(robot="panda", hand=True) as robot:
        done = run("check.py", *at(robot.host), "--set", "robots.arm.model=panda", "--duration", "0.1", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert report["fit"] is True
    assert report["rig"].endswith("franka_emulator.yaml")
    found = {v["name"]: v for v in report["verdicts"]}
    assert found["arm: robot"]["level"] == "ok"
    assert "protocol 5" in found["arm: robot"]["found"]
    assert {"kernel", "processor", "scheduling", "memory", "arm: network"} <= set(found)
    assert all(set(v) == {"name", "level", "found", "remedy"} for v in report["verdicts"])


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--duration", "0"], "--duration must be above 0"),
        (["--config", "panda_tabel"], "did you mean 'panda_table'"),
        (["--physics", "--config", "franka"], "--physics has rigs of its own"),
        (["--pads", "--duration", "0"], "--duration must be positive"),
        (["--pads", "--json"], "--json cannot be used with --pads"),
    ],
)
def test_a_persons_mistake_is_a_message_not_a_traceback(arguments: list[str], text: str) -> None:
    done = run_here(check, *arguments)
    assert done.returncode == 2
    assert text in done.stderr


def test_the_physics_of_each_engine_agrees_with_theory_within_3_percent(engine: Engine) -> None:
    done = run_here(check, "--physics", "--engine", engine.name, "--json")
    report = json.loads(done.stdout)
    assert report["engine"] == engine.name
    assert [row for row in report["rows"] if not row["fit"] or abs(row["difference"]) > 0.03] == []
    assert len(report["rows"]) == 27
    assert (report["fit"], done.returncode) == (True, 0)


def test_an_experiment_that_disagrees_with_theory_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        _physics.Row("near", "m", -1.0, -1.02),
        _physics.Row("far", "m", 2.0, 1.9),
        _physics.Row("at", "m", 0, 1, 40),
    ]
    monkeypatch.setattr(_physics, "EXPERIMENTS", {"made_up": lambda engine: iter(rows)})
    done = run_here(check, "--physics")
    assert done.returncode == 2
    shown = {line.split()[1]: line for line in done.stdout.splitlines() if line.startswith(("ok", "FAIL"))}
    assert {name: line.split()[0] for name, line in shown.items()} == {"near": "ok", "far": "FAIL", "at": "ok"}
    assert [line.split()[-2] for line in shown.values()] == ["+2.00", "-5.00", "+2.50"]


def test_teleoperation_of_an_arm_that_is_not_there_ends_before_anything_is_opened() -> None:
    done = run_here(teleop, *at(EMPTY), "--duration", "1")
    assert done.returncode == 2
    assert "FAIL" in done.stdout
    assert f"{EMPTY}:1337 refuses" in done.stdout
    assert "Open this in a browser" not in done.stdout
    assert "kernel" not in done.stdout, "a rehearsal does not depend on how fit this computer is"


def test_the_command_that_grants_real_time_rights_is_shown_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr("os.sched_setscheduler", refuse)
    monkeypatch.setattr("hal.preflight.may_lock_memory", lambda _: False)
    done = run_here(check, "--sim")
    assert done.stdout.count("WARN      scheduling") == 1
    assert "only" in done.stdout
    assert done.stdout.count("limits.d/99-realtime.conf") == 1


def test_teleoperation_of_a_simulation_is_not_checked() -> None:
    done = run("teleop.py", "--sim", "--pad", "demo", "--duration", "0.2", "--set", "cameras={}")
    assert done.returncode == 0, done.stderr
    assert "kernel" not in done.stdout
