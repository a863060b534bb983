"""The 41 error flags of a Franka's controller: their order in a state packet, what they mean, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

FLAGS: tuple[str, ...] = (
    "joint_position_limits_violation",
    "cartesian_position_limits_violation",
    "self_collision_avoidance_violation",
    "joint_velocity_violation",
    "cartesian_velocity_violation",
    "force_control_safety_violation",
    "joint_reflex",
    "cartesian_reflex",
    "max_goal_pose_deviation_violation",
    "max_path_pose_deviation_violation",
    "cartesian_velocity_profile_safety_violation",
    "joint_position_motion_generator_start_pose_invalid",
    "joint_motion_generator_position_limits_violation",
    "joint_motion_generator_velocity_limits_violation",
    "joint_motion_generator_velocity_discontinuity",
    "joint_motion_generator_acceleration_discontinuity",
    "cartesian_position_motion_generator_start_pose_invalid",
    "cartesian_motion_generator_elbow_limit_violation",
    "cartesian_motion_generator_velocity_limits_violation",
    "cartesian_motion_generator_velocity_discontinuity",
    "cartesian_motion_generator_acceleration_discontinuity",
    "cartesian_motion_generator_elbow_sign_inconsistent",
    "cartesian_motion_generator_start_elbow_invalid",
    "force_controller_desired_force_tolerance_violation",
    "start_elbow_sign_inconsistent",
    "communication_constraints_violation",
    "power_limit_violation",
    "cartesian_motion_generator_joint_position_limits_violation",
    "cartesian_motion_generator_joint_velocity_limits_violation",
    "cartesian_motion_generator_joint_velocity_discontinuity",
    "cartesian_motion_generator_joint_acceleration_discontinuity",
    "cartesian_position_motion_generator_invalid_frame",
    "controller_torque_discontinuity",
    "joint_p2p_insufficient_torque_for_planning",
    "tau_j_range_violation",
    "instability_detected",
    "joint_move_in_wrong_direction",
    "cartesian_spline_motion_generator_violation",
    "joint_via_motion_generator_planning_joint_limit_violation",
    "base_acceleration_initialization_timeout",
    "base_acceleration_invalid_reading",
)
"""The 41 error flags in the order of a state packet, by the names of both client libraries.

The Panda (protocol 5) sends all 41; its library names only the first 37.
"""

_LATE = "run hal check: late or lost set-points have the same symptom"
_OTHER = "this driver sends joint set-points only: end the other program, or the Desk task, that moves this arm"
_DESK = "change that motion where it was created, in Desk; this driver starts none"
_FREE = "move the arm free by hand with the guiding buttons"
_CONTACT = f"{_FREE}; if there was no contact, set the load (real: load) or raise real: collision_behavior"

_CARTESIAN = [
    name for name in FLAGS if name.startswith(("cartesian_motion_generator", "cartesian_position_motion_generator"))
]
"""Flags that only set-points of another program raise."""

FLAG_TEXTS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "communication_constraints_violation": (
            "20 set-points in a row did not reach the robot in time",
            "connect this computer directly to Control's LAN port, end busy programs, and run hal check",
        ),
        # Contact and external forces.
        "joint_reflex": ("the external torque on a joint exceeded its collision threshold", _CONTACT),
        "cartesian_reflex": ("the external force on the end effector exceeded its collision threshold", _CONTACT),
        "self_collision_avoidance_violation": (
            "two parts of the arm came too close to each other",
            f"{_FREE}, away from itself; then choose a path with more distance between the hand, elbow and links",
        ),
        "tau_j_range_violation": (
            "a joint's torque sensor is at the end of its range",
            f"remove what presses on the arm or hangs from it; {_FREE}",
        ),
        "force_control_safety_violation": (
            "the force exceeded the safe range while the robot was controlling a force",
            f"{_FREE}; {_OTHER}",
        ),
        "force_controller_desired_force_tolerance_violation": ("the commanded force exceeds the safe range", _OTHER),
        # Measured position and speed.
        "joint_position_limits_violation": (
            "a joint is beyond its limit",
            "guide that joint by hand towards the middle of its range; Desk may have to allow it first",
        ),
        "joint_move_in_wrong_direction": (
            "a joint beyond its limit was guided farther out",
            "guide it the other way, towards the middle of its range",
        ),
        "cartesian_position_limits_violation": (
            "the arm crossed a virtual wall",
            f"{_FREE}, back behind the wall; make the rig's workspace smaller than the walls",
        ),
        "joint_velocity_violation": (
            "the measured speed of a joint exceeded its limit",
            "check whether something pushed the arm; set the load (real: load); lower the rig's speed",
        ),
        "cartesian_velocity_violation": (
            "the measured speed of the hand or the elbow exceeded its limit",
            "check whether something pushed the arm; lower the rig's speed and tcp_speed",
        ),
        "power_limit_violation": (
            "the motion needed more power than the robot has",
            "carry less, or lower the rig's speed and limits.acceleration",
        ),
        "instability_detected": (
            "the arm vibrated: the robot detected that its control is unstable",
            "check that the base is bolted down; set the load (real: load); lower real: joint_impedance",
        ),
        "base_acceleration_initialization_timeout": (
            "the robot could not measure the direction of gravity when it started",
            "keep its base still, and restart the robot in Desk",
        ),
        "base_acceleration_invalid_reading": (
            "the robot cannot measure the acceleration of its base",
            "check that the base stands still and is bolted down; if the fault persists, restart the robot in Desk",
        ),
        # Joint set-points: those of this driver.
        "joint_motion_generator_position_limits_violation": (
            "a set-point was beyond a joint's limit",
            "compare limits.lower and limits.upper with the data sheet of this arm and its system version",
        ),
        "joint_motion_generator_velocity_limits_violation": (
            "a set-point was faster than the joint's limit there (an FR3's limit shrinks near the end of a range)",
            f"{_LATE}; lower the rig's speed or limits.velocity",
        ),
        "joint_motion_generator_velocity_discontinuity": (
            "the velocity of the set-points jumped: the acceleration exceeded a joint's limit",
            f"{_LATE}; lower limits.acceleration",
        ),
        "joint_motion_generator_acceleration_discontinuity": (
            "the acceleration of the set-points jumped: the jerk exceeded a joint's limit",
            f"{_LATE}; lower limits.jerk",
        ),
        "joint_position_motion_generator_start_pose_invalid": (
            "the first set-point was too far from the arm's position",
            "let the arm come to rest, untouched, and start again",
        ),
        "controller_torque_discontinuity": (
            "the commanded torques jumped: more than 1000 Nm/s",
            f"{_LATE}; in torque mode, change torques gradually",
        ),
        # Cartesian set-points: those of another program.
        **{name: (f"a Cartesian set-point was refused: {name.replace('_', ' ')}", _OTHER) for name in _CARTESIAN},
        # Motions that the robot plans, started in Desk.
        "max_goal_pose_deviation_violation": (
            "a motion from Desk did not end at its goal",
            f"find what held the arm back; {_DESK}",
        ),
        "max_path_pose_deviation_violation": (
            "the arm left the path of a motion from Desk",
            f"find what held the arm back; {_DESK}",
        ),
        "cartesian_velocity_profile_safety_violation": (
            "a motion from Desk became faster than planned",
            f"lower its speed; {_DESK}",
        ),
        "start_elbow_sign_inconsistent": (
            "a motion from Desk began with the elbow on the wrong side",
            f"move the elbow to the other side by hand; {_DESK}",
        ),
        "joint_p2p_insufficient_torque_for_planning": (
            "the load is too heavy for a motion from Desk",
            f"carry less, or set the load; {_DESK}",
        ),
        "cartesian_spline_motion_generator_violation": (
            "a curve planned by the robot leads through a joint's limit",
            _DESK,
        ),
        "joint_via_motion_generator_planning_joint_limit_violation": (
            "a path through several points planned by the robot leads through a joint's limit",
            _DESK,
        ),
    }
)
"""Cause and remedy of each flag, one line each, in order of importance.

Where several flags are set, the first of these is reported, because it tends to cause the others: lost packets, for
example, look like jumps of the set-points. The meanings are those of the comments in libfranka's ``errors.h`` and of
the chapter "Errors" in Franka's FCI documentation; the remedies are ours.
"""

LOSSY_FLAGS = frozenset(
    {
        "communication_constraints_violation",
        "joint_motion_generator_velocity_limits_violation",
        "joint_motion_generator_velocity_discontinuity",
        "joint_motion_generator_acceleration_discontinuity",
        "controller_torque_discontinuity",
    }
)
"""Flags that late or lost set-points can raise."""


def flag_index(name: str) -> int:
    """Return the position of a flag, by its name or its number in digits. Raises ValueError, which lists all flags."""
    if name.isdigit() and int(name) < len(FLAGS):
        return int(name)
    if name in FLAGS:
        return FLAGS.index(name)
    raise ValueError(f"no error flag {name!r}: 0..{len(FLAGS) - 1}, or one of {', '.join(FLAGS)}")
