"""What each of the 41 error flags means to a person at the arm, and what to do about it.

The meanings are those of the comments in libfranka's ``errors.h`` and of the chapter "Errors" of Franka's FCI
documentation; the remedies are ours. The order is that of importance: where several flags are set, the first one here
is told, for it tends to be the reason for the others. Lost packets, say, look like jumps of the set-points.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["FLAG_TEXTS", "LOSSY"]

_LATE = "run hal-check: set-points that were late or lost on the way look the same"
_OTHER = "this driver sends nothing but joint set-points: end the other program, or the Desk task, that moves this arm"
_DESK = "change that motion where it was made, in Desk; this driver starts none"
_FREE = "move the arm free by hand with the guiding buttons"

FLAG_TEXTS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "communication_constraints_violation": (
            "20 set-points in a row did not reach the robot in time",
            "connect this computer straight to Control's LAN port, end busy programs, and run hal-check",
        ),
        # It touched something, or something holds it.
        "joint_reflex": (
            "a joint felt more torque than its collision threshold",
            f"{_FREE}; if nothing touched it, tell the robot its load (real: load) or raise real: collision_behavior",
        ),
        "cartesian_reflex": (
            "the hand felt more force than its collision threshold",
            f"{_FREE}; if nothing touched it, tell the robot its load (real: load) or raise real: collision_behavior",
        ),
        "self_collision_avoidance_violation": (
            "two parts of the arm came too close to each other",
            f"{_FREE}, away from itself; then choose a way that keeps hand and elbow farther from the other links",
        ),
        "tau_j_range_violation": (
            "a joint's torque sensor is at the end of its range",
            f"take away what presses on the arm or hangs from it; {_FREE}",
        ),
        "force_control_safety_violation": (
            "while the robot controlled a force, that went beyond what is safe",
            f"{_FREE}; {_OTHER}",
        ),
        "force_controller_desired_force_tolerance_violation": (
            "a force was asked for that is beyond what is safe",
            _OTHER,
        ),
        # Where it is, and how fast it really moved.
        "joint_position_limits_violation": (
            "a joint is beyond its limit",
            "guide that joint by hand back towards the middle of its range; Desk may have to allow it first",
        ),
        "joint_move_in_wrong_direction": (
            "a joint that is beyond its limit was guided farther out",
            "guide it the other way, towards the middle of its range",
        ),
        "cartesian_position_limits_violation": (
            "the arm went through a virtual wall",
            f"{_FREE}, back behind the wall; draw the rig's workspace tighter than the walls",
        ),
        "joint_velocity_violation": (
            "a joint really moved faster than it may",
            "see whether something pushed the arm; tell the robot its load (real: load); lower the rig's speed",
        ),
        "cartesian_velocity_violation": (
            "the hand or the elbow really moved faster than it may",
            "see whether something pushed the arm; lower the rig's speed and tcp_speed",
        ),
        "power_limit_violation": (
            "the motion would have taken more power than the robot has",
            "carry less, or lower the rig's speed and limits.acceleration",
        ),
        "instability_detected": (
            "the arm shook: the robot found its own control unstable",
            "see that the base is bolted down; tell the robot its load (real: load); lower real: joint_impedance",
        ),
        "base_acceleration_initialization_timeout": (
            "the robot could not find out which way is down when it started",
            "keep its base still, and restart the robot in Desk",
        ),
        "base_acceleration_invalid_reading": (
            "the robot cannot measure how its base moves",
            "see that the base stands still and is bolted down; if it stays so, restart the robot in Desk",
        ),
        # What it was told to do, joint by joint: this driver's own set-points.
        "joint_motion_generator_position_limits_violation": (
            "a set-point was beyond a joint's limit",
            "compare limits.lower and limits.upper with the data sheet of this arm and its system version",
        ),
        "joint_motion_generator_velocity_limits_violation": (
            "a set-point was faster than a joint may move there (an FR3's limit shrinks near the end of a range)",
            f"{_LATE}; lower the rig's speed or limits.velocity",
        ),
        "joint_motion_generator_velocity_discontinuity": (
            "the speed of the set-points jumped: more acceleration than a joint may have",
            f"{_LATE}; lower limits.acceleration",
        ),
        "joint_motion_generator_acceleration_discontinuity": (
            "the acceleration of the set-points jumped: more jerk than a joint may have",
            f"{_LATE}; lower limits.jerk",
        ),
        "joint_position_motion_generator_start_pose_invalid": (
            "the first set-point was too far from where the arm is",
            "let the arm come to rest, with nobody's hand on it, and start again",
        ),
        "controller_torque_discontinuity": (
            "the torques that were sent jumped: more than 1000 Nm/s",
            f"{_LATE}; in torque mode, change torques gradually",
        ),
        # What it was told to do in space: another program.
        "cartesian_position_motion_generator_start_pose_invalid": (
            "the first pose that was sent was too far from where the hand is",
            _OTHER,
        ),
        "cartesian_position_motion_generator_invalid_frame": (
            "a pose that was sent is no valid transformation",
            _OTHER,
        ),
        "cartesian_motion_generator_velocity_limits_violation": (
            "a pose that was sent was faster than the hand may move",
            _OTHER,
        ),
        "cartesian_motion_generator_velocity_discontinuity": (
            "the speed of the poses that were sent jumped",
            _OTHER,
        ),
        "cartesian_motion_generator_acceleration_discontinuity": (
            "the acceleration of the poses that were sent jumped",
            _OTHER,
        ),
        "cartesian_motion_generator_joint_position_limits_violation": (
            "a pose that was sent needs a joint beyond its limit",
            _OTHER,
        ),
        "cartesian_motion_generator_joint_velocity_limits_violation": (
            "a pose that was sent needs a joint faster than it may move",
            _OTHER,
        ),
        "cartesian_motion_generator_joint_velocity_discontinuity": (
            "poses that were sent make the speed of a joint jump",
            _OTHER,
        ),
        "cartesian_motion_generator_joint_acceleration_discontinuity": (
            "poses that were sent make the acceleration of a joint jump",
            _OTHER,
        ),
        "cartesian_motion_generator_elbow_limit_violation": (
            "the elbow was told to go beyond its limit",
            _OTHER,
        ),
        "cartesian_motion_generator_elbow_sign_inconsistent": (
            "the elbow was told to be on both sides",
            _OTHER,
        ),
        "cartesian_motion_generator_start_elbow_invalid": (
            "the first elbow angle that was sent was too far from where the elbow is",
            _OTHER,
        ),
        # Motions that the robot plans itself, started in Desk.
        "max_goal_pose_deviation_violation": (
            "a motion of the robot's own did not end where it should",
            f"see what held the arm back; {_DESK}",
        ),
        "max_path_pose_deviation_violation": (
            "the arm left the path of a motion of the robot's own",
            f"see what held the arm back; {_DESK}",
        ),
        "cartesian_velocity_profile_safety_violation": (
            "a motion of the robot's own became faster than it was planned",
            f"lower its speed; {_DESK}",
        ),
        "start_elbow_sign_inconsistent": (
            "a motion from Desk began with the elbow on the wrong side",
            f"move the elbow to the other side by hand; {_DESK}",
        ),
        "joint_p2p_insufficient_torque_for_planning": (
            "the arm carries too much for a motion from Desk",
            f"carry less, or tell the robot its load; {_DESK}",
        ),
        "cartesian_spline_motion_generator_violation": (
            "a curve that the robot planned leads through a joint's limit",
            _DESK,
        ),
        "joint_via_motion_generator_planning_joint_limit_violation": (
            "a way through several points that the robot planned leads through a joint's limit",
            _DESK,
        ),
    }
)
"""Name of a flag -> its cause and its remedy, one line each; the most telling first."""

LOSSY = frozenset(
    {
        "communication_constraints_violation",
        "joint_motion_generator_velocity_limits_violation",
        "joint_motion_generator_velocity_discontinuity",
        "joint_motion_generator_acceleration_discontinuity",
        "controller_torque_discontinuity",
    }
)
"""Flags that set-points which come late or get lost can raise."""
