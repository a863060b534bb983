"""pytest's plugin that tells the machine's host of every result, as a line of JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """One line for each check, and for a set-up or a clean-up that failed."""
    if report.when != "call" and not report.failed:
        return
    name, _, what = report.nodeid.rpartition("::")[2].removeprefix("check_").removeprefix("test_").partition("[")
    where = "" if report.when == "call" else f" ({report.when})"
    measured = (str(value) for key, value in report.user_properties if key == "measured")
    _tell(
        check=f"{name.replace('_', ' ')}{': ' if what else ''}{what.removesuffix(']')}{where}",
        passed=report.passed,
        seconds=report.duration,
        measured="; ".join(measured),
        why="" if report.passed else report.longreprtext,
    )


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """A file of checks that cannot be read."""
    if report.failed:
        _tell(check=report.nodeid, passed=False, seconds=0.0, measured="", why=report.longreprtext)


def pytest_sessionfinish(exitstatus: int) -> None:
    """That it came to its end."""
    _tell(finished=int(exitstatus))


def _tell(**what: Any) -> None:
    with Path(os.environ["HAL_KERNEL_RESULTS"]).open("w") as out:
        out.write(json.dumps(what) + "\n")
