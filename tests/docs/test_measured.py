"""Every benchmark runs, and docs/measured.md names the command and the commit of each of its tables."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from benchmark_kit import load_benchmark

ROOT = Path(__file__).resolve().parents[2]
benchmarks = load_benchmark("__main__")
PAGE = benchmarks.PAGE.read_text(encoding="utf-8")

TIMED = {"console", "franka", "real_time", "remote", "stops"}
"""Benchmarks that drive in real time."""


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.pair if name in TIMED else ()) for name in benchmarks.NAMES]
)
def test_a_benchmark_runs_for_a_second(name: str, tmp_path: Path) -> None:
    if name in ("lock_step", "render"):
        pytest.importorskip("pybullet", reason="pybullet is the reference")
    file = tmp_path / "found.json"
    command = [sys.executable, "-m", "benchmarks", name, "--quick", "--json", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=390)
    assert done.returncode == 0, done.stderr
    (found,) = json.loads(file.read_text())
    assert found["commit"]
    assert any(table["rows"] for table in found["tables"])
    for table in found["tables"]:
        assert all(len(row) <= len(table["columns"]) for row in table["rows"]), table["title"]
        assert table["title"] in done.stdout


def test_without_a_name_the_benchmarks_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmarks.main([]) == 0
    listed = capsys.readouterr().out
    assert [name for name in benchmarks.NAMES if f"{name} " not in listed] == []


def test_every_figure_has_its_command_and_commit() -> None:
    """Each section with numbers names a benchmark with a commit, or the tests that print or assert them."""
    named = set(re.findall(r"python -m benchmarks (\w+)", PAGE))
    assert named <= set(benchmarks.NAMES)
    assert set(benchmarks.NAMES) <= {name for name, _ in benchmarks.measured_commits()}, "each has its table"
    for section in re.split(r"^##+ ", PAGE, flags=re.MULTILINE)[1:]:
        heading, _, text = section.partition("\n")
        if re.search(r"^\|.*\d", text, re.MULTILINE):
            assert re.search(r"commit [0-9a-f]{7}|`(?:HAL_SOAK=1 )?pytest |`tests/|The same command", text), heading


def test_paths_of_benchmarks_exist() -> None:
    for name in benchmarks.NAMES:
        for path in benchmarks.module_constant(name, "PATHS"):
            assert (ROOT / path).exists(), f"{name}: {path}"


def test_figures_that_are_older_than_their_code_are_named() -> None:
    """A warning, no failure: whoever changes the code need not measure at once."""
    found = [(name, commit, benchmarks.commits_since(name, commit)) for name, commit in benchmarks.measured_commits()]
    old = [f"{name} ({count} commits since {commit})" for name, commit, count in found if count]
    if old:
        warnings.warn(f"docs/measured.md is older than the code that it measures: {', '.join(old)}", stacklevel=1)
