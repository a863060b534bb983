"""For all tests: what a skip means, and plain specs to make drivers from."""

from __future__ import annotations

import os
from collections.abc import Generator
from typing import Any

import pytest

from hal.specs import CameraSpec, GripperSpec, KinematicsSpec, LimitsSpec, PadSpec, RobotSpec, ViewSpec

STRICT = os.environ.get("HAL_TEST_STRICT", "") not in ("", "0")


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
    lower, upper = (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)
    return RobotSpec(
        name="arm",
        model="three_joints",
        driver="mock",
        rate_hz=100.0,
        urdf="",
        joints=("j1", "j2", "j3"),
        home=(0.0, 0.0, 0.0),
        initial=(0.1, -0.2, 0.3),
        limits=LimitsSpec(lower, upper, (2.0,) * 3, (10.0,) * 3, (100.0,) * 3),
        kinematics=KinematicsSpec(
            "", ("j1", "j2", "j3"), lower, upper, (0.0,) * 3, None, "tip", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
        ),
        base_position=(0.0, 0.0, 0.0),
        base_orientation=(0.0, 0.0, 0.0, 1.0),
    )


@pytest.fixture
def gripper_spec() -> GripperSpec:
    """A hand that opens to 80 mm at 0.1 m/s."""
    return GripperSpec(name="arm.gripper", driver="mock", width_max=0.08, speed=0.1, force=20.0)


@pytest.fixture
def camera_spec() -> CameraSpec:
    """A small fixed camera at 30 Hz with every stream."""
    return CameraSpec(
        name="scene",
        model="test",
        driver="mock",
        capture_width=64,
        capture_height=48,
        width=64,
        height=48,
        rate_hz=30.0,
        K=((60.0, 0.0, 31.5), (0.0, 60.0, 23.5), (0.0, 0.0, 1.0)),
        distortion=(0.0,) * 5,
        depth_min=0.1,
        depth_max=3.0,
        streams=("color", "depth", "infrared", "segmentation"),
        view=ViewSpec((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)),
    )


@pytest.fixture
def pad_spec() -> PadSpec:
    """A pad of no particular make."""
    return PadSpec(name="pad", driver="mock", model=None)
