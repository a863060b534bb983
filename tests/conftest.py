"""For all tests: what a skip means, and plain specs to make drivers from."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator
from typing import Any

import pytest

from hal import testing
from hal.specs import CameraSpec, GripperSpec, PadSpec, RobotSpec

STRICT = os.environ.get("HAL_TEST_STRICT", "") not in ("", "0")


def pytest_configure(config: pytest.Config) -> None:
    """A program inherits which signals are ignored: after ``nohup``, or ``&`` in a script, no Ctrl-C would end one."""
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)  # as before for pytest itself; an app begins with the default


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """With HAL_TEST_STRICT=1 a skipped test fails: CI has every package that a test may ask for."""
    return _strict((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    """The same for a module that skips itself."""
    return _strict((yield))


def _strict(report: Any) -> Any:
    if STRICT and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"HAL_TEST_STRICT=1 does not allow to skip: {reason}"
    return report


@pytest.fixture
def robot_spec() -> RobotSpec:
    """An arm of three joints for drivers that need no URDF."""
    return testing.robot_spec()


@pytest.fixture
def gripper_spec() -> GripperSpec:
    """A hand that opens to 80 mm at 0.1 m/s."""
    return testing.gripper_spec()


@pytest.fixture
def camera_spec() -> CameraSpec:
    """A small fixed camera at 30 Hz with every stream."""
    return testing.camera_spec()


@pytest.fixture
def pad_spec() -> PadSpec:
    """A pad of no particular make."""
    return testing.pad_spec()
