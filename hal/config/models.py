"""Robot models: what is the same for every one of its kind. YAML files in ``robots/``; cameras' are in
:mod:`.camera_models`. A model of your own is a file of the same shape; a rig names it by its path.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from .data_files import data_folder, is_path, list_data, user_path
from .files import Problems, nearest, read_yaml
from .schema import (
    Accelerations,
    Force,
    Jerks,
    JointLimits,
    JointPositions,
    Name,
    Offset,
    PoseConfig,
    QuaternionConfig,
    RateHz,
    Size,
    Speed,
    Strict,
    Torques,
    Velocities,
)

__all__ = [
    "Drivers",
    "GripperModel",
    "LimitsModel",
    "PoseConfig",
    "RobotModel",
    "UrdfSource",
    "find_model",
    "load_pad_models",
]


class Drivers(Strict):
    """Which driver does the work, in simulation and for real; None where there is none."""

    sim: str | None = None
    real: str | None = None


class UrdfSource(Strict):
    """A URDF: a path relative to the file that names it, or a path inside an installed Python package."""

    path: str
    package: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _plain_path(cls, data: Any) -> Any:
        return {"path": data} if isinstance(data, str) else data


class LimitsModel(Strict):
    """Per joint, or one number for all: rad, rad/s, rad/s2, rad/s3, Nm (m and N for joints that slide).

    Position, speed and torque come from the URDF where they are left out; acceleration and jerk must be given.
    """

    lower: JointLimits | None = None
    upper: JointLimits | None = None
    velocity: Velocities | None = None
    acceleration: Accelerations | None = None
    jerk: Jerks | None = None
    torque: Torques | None = None


class TcpModel(Strict):
    """The tool centre point in the frame of a link."""

    link: str
    position: Offset = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)


class GripperModel(Strict):
    """A parallel gripper: fingers that move together, each half the width."""

    joints: tuple[str, ...] = ()
    drivers: Drivers = Drivers()
    width_max: Size
    """m"""
    speed: Speed
    """Of the width, m/s."""
    force: Force
    """N"""
    real: dict[str, Any] = Field(default_factory=dict)
    simulated: dict[str, Any] = Field(default_factory=dict)


class RobotModel(Strict):
    """An arm, and its gripper if it has one."""

    description: str = ""
    urdf: UrdfSource
    drivers: Drivers = Drivers()
    rate_hz: RateHz = 1000.0
    """Of the real arm's control cycle. A simulated one runs at the rig's ``physics_hz``."""
    joints: tuple[Name, ...] = Field(min_length=1)
    """Of the arm, from base to tip; the fingers are the gripper's."""
    base_link: str | None = None
    """The URDF's root when left out."""
    tcp: TcpModel
    home: JointPositions
    """rad"""
    links: dict[Name, str] = Field(default_factory=dict)
    """Other names for links, which a rig can use in ``attached`` whatever the model: ``{hand: panda_hand}``."""
    limits: LimitsModel = LimitsModel()
    """What the arm can do."""
    real_limits: LimitsModel = LimitsModel()
    """Tighter ones, kept where the arm is real; those that are left out are as above."""
    gripper: GripperModel | None = None
    real: dict[str, Any] = Field(default_factory=dict)
    """What only the real driver needs; a rig adds to it."""
    simulated: dict[str, Any] = Field(default_factory=dict)


def find_model(name: str, folder: str, parts: tuple[str, ...], base: Path) -> Path | str:
    """Path of a model: the user's when ``name`` is a path (relative to ``base``), else one that comes with the hal.

    Returns a sentence where there is none.
    """
    if is_path(name):
        return user_path(name, base)
    there = list_data(folder, *parts)
    if name not in there:
        return f"there is no {'/'.join((folder, *parts))} model {name!r}{nearest(name, there)}, or a path to your own"
    return data_folder(folder).joinpath(*parts, f"{name}.yaml")


def load_pad_models(problems: Problems) -> dict[str, dict[str, Any]]:
    """All pad models that come with the hal, by name, as plain data. The pads' driver knows what is in them."""
    models = {}
    for name in list_data("sensors", "gamepads"):
        data = read_yaml(data_folder("sensors") / "gamepads" / f"{name}.yaml", problems)
        if data is not None:
            models[name] = data
    return models
