"""Records to make a driver from, where no rig's file stands behind them: small devices of no particular make."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..specs import CameraSpec, GripperSpec, KinematicsSpec, LimitsSpec, PadSpec, RobotSpec, ViewSpec

__all__ = ["camera_spec", "gripper_spec", "pad_spec", "robot_spec"]


def robot_spec(joints: int = 3, **changes: Any) -> RobotSpec:
    """An arm of so many joints, at 100 Hz, that needs no URDF. ``changes`` are fields of the record."""
    names = tuple(f"j{k + 1}" for k in range(joints))
    lower, upper, zeros = (-2.0,) * joints, (2.0,) * joints, (0.0,) * joints
    spec = RobotSpec(
        name="arm",
        model=f"{joints}_joints",
        driver="mock",
        rate_hz=100.0,
        urdf="",
        joints=names,
        home=zeros,
        initial=tuple((-1) ** k * (k + 1) / 10 for k in range(joints)),
        limits=LimitsSpec(lower, upper, (2.0,) * joints, (10.0,) * joints, (100.0,) * joints),
        kinematics=KinematicsSpec("", names, lower, upper, zeros, None, "tip", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        base_position=(0.0, 0.0, 0.0),
        base_orientation=(0.0, 0.0, 0.0, 1.0),
    )
    return replace(spec, **changes)


def gripper_spec(**changes: Any) -> GripperSpec:
    """A hand that opens to 80 mm at 0.1 m/s. ``changes`` are fields of the record."""
    spec = GripperSpec(name="arm.gripper", driver="mock", width_max=0.08, speed=0.1, force=20.0)
    return replace(spec, **changes)


def camera_spec(**changes: Any) -> CameraSpec:
    """A small fixed camera at 30 Hz with colour, depth, infrared and segmentation: most have fewer ``streams``.

    ``changes`` are fields of the record. With another size, K and the captured size follow, unless they are given too.
    """
    width, height = changes.get("width", 64), changes.get("height", 48)
    focal = 60.0 * width / 64
    spec = CameraSpec(
        name="scene",
        model="test",
        driver="mock",
        capture_width=width,
        capture_height=height,
        width=width,
        height=height,
        rate_hz=30.0,
        K=((focal, 0.0, (width - 1) / 2), (0.0, focal, (height - 1) / 2), (0.0, 0.0, 1.0)),
        distortion=(0.0,) * 5,
        depth_min=0.1,
        depth_max=3.0,
        streams=("color", "depth", "infrared", "segmentation"),
        view=ViewSpec((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)),
    )
    return replace(spec, **changes)


def pad_spec(**changes: Any) -> PadSpec:
    """A pad of no particular make. ``changes`` are fields of the record, most often ``options``."""
    return replace(PadSpec(name="pad", driver="mock", model=None), **changes)
