"""``apps/generate.py``: its options. Whole runs are in tests/system/test_generate.py."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from app_kit import run_here

from hal import registry
from hal.apps.generate import describe, main
from hal.learning.generate import GenerateProgress

pytest.importorskip("pyarrow", reason="pip install 'robot-hal[record]'")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, with a skill in it."""
    (tmp_path / "skills.py").write_text("def wait(rig, random):\n    rig.clock.sleep(0.1)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("skills", None)


SKILL = ("--skill", "skills:wait", "--out", "out")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--out", "out"], "--policy --skill"),
        (["--skill", "skills:jump", "--out", "out"], "jump"),
        ([*SKILL, "--sim", "--workers", "0"], "--workers"),
        ([*SKILL, "--sim", "--upload", "folder"], "--upload folder"),
        ([*SKILL, "--sim", "--gpus", "1"], "--ray"),
        ([*SKILL, "--sim", "--ray", "auto", "--gpus", "nan"], "--gpus"),
        ([*SKILL, "--sim", "--ray", "auto", "--runtime-env", "none.yaml"], "none.yaml"),
        ([*SKILL, "--sim", "--cameras", "wirst"], "did you mean 'wrist'"),
        ([*SKILL, "--config", "franka_emulator"], "--sim"),
        ([*SKILL, "--real", "--set", "cameras={}", "--set", "robots.panda.real.host=172.16.0.2"], "leave out --real"),
    ],
)
def test_a_mistake_is_a_message(folder: Path, arguments: list[str], text: str) -> None:
    done = run_here(main, *arguments)
    assert done.returncode == 2, done.stdout + done.stderr
    assert text in done.stderr
    assert not (folder / "out").exists()


def test_a_dry_run_opens_nothing(folder: Path) -> None:
    done = run_here(main, *SKILL, "--sim", "--set", "cameras={}", "--episodes", 7, "--dry-run")
    assert done.returncode == 0, done.stderr
    for text in ("skills:wait", "7 episode(s)", "lock step"):
        assert text in done.stdout
    assert "gamepad" not in done.stdout, "none is read"
    assert not (folder / "out").exists()


def test_an_engine_that_is_not_installed_leaves_no_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "find_missing", lambda name: {name: "pip install it"})
    done = run_here(main, *SKILL, "--sim", "--set", "cameras={}", "--engine", "pybullet")
    assert (done.returncode, done.stdout) == (2, ""), done.stdout + done.stderr
    assert "'pybullet' is not installed" in done.stderr
    assert not list(folder.glob("out*"))


def test_the_progress_has_the_rate_and_the_time_left() -> None:
    assert describe(GenerateProgress(3, 200, 0, 0, 0.0, None, 0)) == "3 of 200 episodes"
    text = describe(GenerateProgress(50, 200, 30, 40, 1.25, 3725.0, 2, 14))
    for part in (
        "50 of 200",
        "1.25/s",
        "1:02:05 left",
        "30 succeeded (75 % of 40)",
        "2 worker(s) replaced",
        "14 worker(s) waiting",
    ):
        assert part in text
