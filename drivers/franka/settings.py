"""Settings of a Franka arm and of its hand: the ``real:`` part of a rig file, checked before a device is opened.

The ranges are those of the comments in libfranka's ``robot.h``; where it gives none, a number only has to be
physically possible. Nothing here imports the vendor's libraries.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from hal.config.files import DeviceSettings
from hal.config.models import UNITS
from hal.config.schema import Host, Offset, PoseConfig, Quantity, Several, Size, Strict, ValueProblem, is_number
from hal.geometry import Pose, matrix_to_quaternion
from hal.specs import Floats, GripperSpec, RobotSpec

from .limits import LIMITS, ArmLimits

_NO_ADDRESS = (
    "is missing: the robot's address, as Desk shows it; pass it with --set KEY=ADDRESS (overrides= of hal.open), "
    "KEY as above, or write it into a rig file of your own"
)


def _check_stiffness(values: Floats) -> Floats:
    if min(values[:3]) < 10.0 or max(values[3:]) > 300.0:
        raise ValueProblem("must be 10 to 3000 N/m for x, y, z, and 1 to 300 Nm/rad for the angles", "out_of_range")
    return values


_ANY = 1e4
"""Largest threshold, Nm or N. One beyond every force of the arm switches the detection off."""
_SIX = "x, y, z, then roll, pitch, yaw"
Torques = Annotated[Floats, Several(Quantity("Nm", 0.0, _ANY), 7, "one for each joint")]
Forces = Annotated[Floats, Several(Quantity("N, or Nm", 0.0, _ANY), 6, _SIX)]
JointStiffness = Annotated[Floats, Several(Quantity("Nm/rad", 0.0, 14250.0), 7, "one for each joint")]
CartesianStiffness = Annotated[
    Floats, Several(Quantity("N/m, or Nm/rad", 1.0, 3000.0), 6, _SIX), AfterValidator(_check_stiffness)
]


class FrameSetting(PoseConfig):
    """Pose of a frame in another one: ``{position, orientation}``, seven numbers, or a 4x4 matrix as four rows."""

    @model_validator(mode="before")
    @classmethod
    def _rows(cls, data: Any) -> Any:
        if not isinstance(data, (list, tuple)) or not any(isinstance(row, (list, tuple)) for row in data):
            return data
        if len(data) != 4 or not all(
            isinstance(row, (list, tuple)) and len(row) == 4 and all(map(is_number, row)) for row in data
        ):
            raise ValueProblem(
                "must be four rows of four numbers, {position, orientation}, or seven numbers", "wrong_count"
            )
        matrix = np.array(data, float)
        rotation = matrix[:3, :3]
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            message = "the last row of the matrix must be 0, 0, 0, 1; the translation is the last column"
            raise ValueProblem(message, "bad_matrix")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise ValueProblem("the matrix is not a rotation of a right-handed frame", "bad_matrix")
        return {"position": matrix[:3, 3].tolist(), "orientation": matrix_to_quaternion(rotation).tolist()}

    def matrix(self) -> list[float]:
        """Return the 4x4 matrix column by column (16,), as the library expects it."""
        columns: list[float] = Pose(self.position, self.orientation).matrix().T.ravel().tolist()
        return columns


class CollisionBehavior(Strict):
    """Thresholds of external torque and force: the arm reports a contact above the lower, and stops above the upper.

    The defaults are those of libfranka's examples.
    """

    lower_torque: Torques = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
    upper_torque: Torques = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
    lower_force: Forces = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)
    upper_force: Forces = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)

    @model_validator(mode="after")
    def _check_order(self) -> CollisionBehavior:
        for kind in ("torque", "force"):
            lower, upper = getattr(self, f"lower_{kind}"), getattr(self, f"upper_{kind}")
            for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
                if low > high:
                    message = f"lower_{kind} must not be above upper_{kind}; item {k + 1}: {low:g} and {high:g}"
                    raise ValueProblem(message, "empty_range")
        return self

    def arguments(self) -> tuple[list[float], list[float], list[float], list[float]]:
        """Return the arguments in the order of the library's call."""
        return list(self.lower_torque), list(self.upper_torque), list(self.lower_force), list(self.upper_force)


class LoadSetting(Strict):
    """Permanent load in the hand. (The hand itself is set up in Desk, the robot's own interface.)"""

    mass: float = Field(ge=0.0, le=3.0, strict=True)
    """Mass, kg; the data sheets of both arms give a payload of 3 kg."""
    com: Offset = (0.0, 0.0, 0.0)
    """Centre of mass in the frame of the flange, m."""
    inertia: Annotated[Floats, Several(Quantity("kg m2", -10.0, 10.0), 6, "xx, yy, zz, xy, xz, yz")] = (0.0,) * 6
    """Moments and products about the centre of mass, kg m2."""

    @model_validator(mode="after")
    def _possible(self) -> LoadSetting:
        moments = np.linalg.eigvalsh(self._tensor())
        if moments[0] < -1e-9 or moments[2] > moments[0] + moments[1] + 1e-9:
            values = ", ".join(f"{value:.3g}" for value in moments)
            raise ValueProblem(f"inertia: impossible principal moments {values} kg m2", "bad_inertia")
        return self

    def _tensor(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def arguments(self) -> tuple[float, list[float], list[float]]:
        """Return the arguments in the order of the library's call; the inertia as (9,)."""
        return self.mass, list(self.com), self._tensor().ravel().tolist()


class ArmSettings(DeviceSettings):
    """Settings under ``real:`` of an arm."""

    host: Host
    arm: Literal["fr3", "fer"]
    """FR3, or FER (the Panda); set by the model."""
    stream: Literal["position", "velocity"] = "position"
    """Quantity that is sent 1000 times a second."""
    collision_behavior: CollisionBehavior = CollisionBehavior()
    joint_impedance: JointStiffness = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)
    """Stiffness of the arm's own joint controller, Nm/rad. The default is that of libfranka's examples."""
    cartesian_impedance: CartesianStiffness | None = None
    """Stiffness of the arm's Cartesian controller, N/m and Nm/rad, unused here; None: not sent."""
    load: LoadSetting | None = None
    """None: not sent; the same for the two frames."""
    end_effector: FrameSetting | None = None
    """NE_T_EE: the end effector in the frame that is set in Desk, m."""
    stiffness_frame: FrameSetting | None = None
    """EE_T_K: the stiffness frame in the end effector's frame, m."""


class HandSettings(DeviceSettings):
    """Settings under ``real:`` of a gripper; the host defaults to the arm's."""

    host: Host
    tolerance: Size = 0.002
    """Largest distance from the target width at which the fingers count as arrived, m."""


def libraries(spec: RobotSpec | GripperSpec) -> tuple[str, ...]:
    """Return the library that a device needs: the Franka Hand that of the Panda, on an FR3 too."""
    return ("pylibfranka",) if spec.options.get("arm") == "fr3" else ("panda_py",)


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig file, message and code."""
    yield from _check_options(ArmSettings, spec)
    limits = LIMITS.get(str(spec.options.get("arm")))
    if len(spec.joints) != 7:
        yield "model", f"must have 7 joints for a Franka arm, not {len(spec.joints)}", "wrong_count"
    elif limits is not None:
        yield from _check_limits(spec, limits)
    if spec.rate_hz != 1000.0:
        yield "rate_hz", f"must be 1000 Hz, the arm's own rate, not {spec.rate_hz:g}", "wrong_rate"


def check_hand(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a hand's record: key in the gripper's entry of the rig file, message and code."""
    yield from _check_options(HandSettings, spec)


def _check_options(model: type[DeviceSettings], spec: RobotSpec | GripperSpec) -> Iterator[tuple[str, str, str]]:
    for key, message, code in model.check(spec)[1]:
        missing = key == "real.host" and "host" not in spec.options
        yield key, _NO_ADDRESS if missing else message, code


def _check_limits(spec: RobotSpec, official: ArmLimits) -> Iterator[tuple[str, str, str]]:
    """Yield every limit of the servo that exceeds Franka's; ``allow_looser_limits`` does not change that."""
    name = official.model.upper()
    for kind, unit in UNITS.items():
        ours: Floats | None = getattr(spec.limits, kind)
        wrong = [
            f"{joint} has {value:g}, beyond {limit:g}"
            for joint, value, limit in zip(spec.joints, ours or (), getattr(official, kind), strict=bool(ours))
            if (value < limit if kind == "lower" else value > limit)
        ]
        if wrong:
            yield (
                f"limits.{kind}",
                f"{'; '.join(wrong)} {unit}, the limit of the {name}: the arm would stop with a reflex",
                "out_of_range",
            )
    fast = list(_too_fast(spec, official))
    if fast:
        advice = "lower the speed, or keep a larger distance from the stops"
        yield (
            "limits",
            f"{'; '.join(fast)} (the limit of the {name} shrinks towards its stops); {advice}",
            "out_of_range",
        )


def _too_fast(spec: RobotSpec, official: ArmLimits) -> Iterator[str]:
    """Yield the joints whose speed exceeds the limit at an end of their range."""
    ranges = zip(spec.limits.lower, spec.limits.upper, official.lower, official.upper, strict=True)
    lower, upper = zip(*((max(a, low), min(b, high)) for a, b, low, high in ranges), strict=True)
    down, up = official.velocity_range(lower)[0], official.velocity_range(upper)[1]
    for k, joint in enumerate(spec.joints):
        speed = spec.limits.velocity[k]
        most, end = min((abs(down[k]), lower[k]), (up[k], upper[k]))
        if most < speed <= official.velocity[k]:
            yield f"{joint} has {speed:g} rad/s, but only {most:.4g} is allowed at {end:g} rad, an end of its range"
