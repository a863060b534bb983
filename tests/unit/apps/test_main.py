"""The one command: programs, lists, the version."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import pytest
from app_kit import run_here
from engines_kit import AUTO

from hal.apps import dataset
from hal.apps.main import BESIDE, PROGRAMS, main

ROOT = Path(__file__).resolve().parents[3]


def test_it_has_every_program() -> None:
    files = {path.stem.replace("_", "-") for path in (ROOT / "apps").glob("[a-z]*.py")}
    assert files == {*PROGRAMS, "main"}
    done = run_here(main)
    assert done.returncode == 0
    assert [name for name in PROGRAMS if name not in done.stdout] == []


@pytest.mark.parametrize("words", ["collect", "calibrate board", "dataset split", "list", ""])
def test_usage_has_the_one_name_of_a_program(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in ("/usr/bin/hal", "apps/main.py"):
        monkeypatch.setattr(sys, "argv", [command])
        assert run_here(main, *words.split(), "--help").stdout.startswith(f"usage: hal {words}".rstrip() + " [-h]")
    monkeypatch.setattr(sys, "argv", ["apps/dataset.py"])
    assert run_here(dataset.main, "split", "--help").stdout.startswith("usage: hal dataset split [-h]")


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


@pytest.mark.parametrize(
    ("words", "text"), [(["teleopp"], "did you mean 'teleop'?"), (["list", "robot"], "kinds: robots, ")]
)
def test_a_mistake_is_a_message(words: list[str], text: str) -> None:
    done = run_here(main, *words)
    assert done.returncode == 2
    assert text in done.stderr


def test_a_second_ctrl_c_after_the_end_of_a_program_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's own end follows, in which the default of Python would raise KeyboardInterrupt."""
    monkeypatch.setattr(sys, "argv", ["hal", "--version"])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["--version"]) == 0
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler, "the caller's process goes on"
        assert main() == 0
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGINT, before)


PACKAGE = """
import argparse
import sys
from hal.apps._common import program
from hal.errors import CommandError

@program(lambda: argparse.ArgumentParser(prog="far-away"))
def end(args):
    sys.exit("the scanner is off")

def main(arguments):
    if arguments == ["--wrong"]:
        raise CommandError("--wrong is wrong")
    if arguments == ["--end"]:
        end([])
    print("there:", *arguments)
    return 7
"""


def test_an_installed_package_adds_a_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "far_away.py").write_text(PACKAGE)
    metadata = tmp_path / "far_away-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: far-away\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[hal.apps]\nfar-away = far_away:main\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run_here(main, "far-away", "--here", "x") == (7, "there: --here x\n", "")
    done = run_here(main, "far-away", "--wrong")
    assert (done.returncode, done.stderr) == (2, "CommandError: --wrong is wrong\n")
    with pytest.raises(SystemExit, match="the scanner is off"):  # Python prints it, and ends with 1
        main(["far-away", "--end"])


@pytest.mark.parametrize("name", BESIDE)
def test_without_its_package_a_program_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: ())
    done = run_here(main, name, "--help")
    folder = BESIDE[name][1]
    assert (ROOT / folder / "pyproject.toml").is_file()
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"pip install -e {folder}" in line
