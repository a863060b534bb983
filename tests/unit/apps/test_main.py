"""The one command: programs, lists, the version."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from app_kit import run_here
from engines_kit import AUTO

from hal.apps import dataset, teleop
from hal.apps.main import PROGRAMS, main

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # comes with pytest where the standard library has none

ROOT = Path(__file__).resolve().parents[3]


def test_it_has_every_program_that_is_installed() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert {name.removeprefix("hal-") for name in scripts} == {*PROGRAMS, "hal"}
    done = run_here(main)
    assert done.returncode == 0
    assert [name for name in PROGRAMS if name not in done.stdout] == []


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_gets_its_own_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([name, "--help"])
    assert done.value.code == 0
    assert "usage:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "words", "usage"),
    [
        ("/usr/bin/hal", ["collect"], "hal collect"),
        ("/usr/bin/hal", ["import-ark"], "hal import-ark"),
        ("/usr/bin/hal", ["calibrate", "board"], "hal calibrate board"),
        ("/usr/bin/hal", ["dataset", "split"], "hal dataset split"),
        ("/usr/bin/hal", [], "hal"),
        ("apps/main.py", ["review"], "main.py review"),
        ("apps/main.py", ["list"], "main.py list"),
    ],
)
def test_usage_names_the_command_that_was_typed(
    command: str, words: list[str], usage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [command])
    assert run_here(main, *words, "--help").stdout.startswith(f"usage: {usage} [-h]")


@pytest.mark.parametrize("command", ["hal teleop", "teleop.py"])
def test_usage_of_a_single_program(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [f"/somewhere/{command}"])
    assert run_here(teleop.main, "--help").stdout.startswith(f"usage: {command} [-h]")


@pytest.mark.parametrize("command", ["hal dataset", "dataset.py"])
def test_usage_of_a_subcommand(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [f"/somewhere/{command}"])
    assert run_here(dataset.main, "split", "--help").stdout.startswith(f"usage: {command} split [-h]")


def test_it_runs_a_program() -> None:
    done = run_here(main, "teleop", "--sim", "--dry-run")
    assert done.returncode == 0
    assert f"simulated ({AUTO})" in done.stdout


@pytest.mark.parametrize(
    ("kind", "name"),
    [("robots", "panda"), ("cameras", "realsense_d435"), ("rigs", "panda_table"), ("pads", "dualshock4")],
)
def test_lists_give_names_with_a_description(kind: str, name: str) -> None:
    lines = run_here(main, "list", kind).stdout.splitlines()
    (line,) = (line for line in lines if line.split()[0] == name)
    assert len(line.split()) > 3
    assert all(len(line.split()) > 1 for line in lines)


def test_schema_and_version() -> None:
    assert "robots" in json.loads(run_here(main, "schema").stdout)["properties"]
    assert run_here(main, "--version").stdout.startswith("robot-hal ")


def test_a_mistake_is_a_message() -> None:
    for words in (["teleopp"], ["list", "robot"]):
        with pytest.raises(SystemExit) as done:
            main(words)
        assert done.value.code == 2
