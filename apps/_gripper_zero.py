"""``hal calibrate gripper``: home a gripper, or find where its motor is closed, while a dead-man is held."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import hal
from hal.apps._common import (
    add_rig_options,
    check_one_robot,
    find_deadman,
    resolve_plan,
    rig_options,
    robot_names,
    select_robots,
)
from hal.apps._display import banner, list_links
from hal.errors import MotionStopped, NotSupported

if TYPE_CHECKING:
    from hal.deadman import Deadman
    from hal.gripper import Gripper, GripperResult
    from hal.rig import Rig
    from hal.specs import Plan, RobotSpec

LONGEST = 120.0
"""Time after which the search ends, s, however long the dead-man was held."""
_PERIOD = 0.01
"""Time between two looks at the dead-man, s."""


def gripper_parser() -> argparse.ArgumentParser:
    """Return the parser of ``hal calibrate gripper``."""
    made = argparse.ArgumentParser(
        prog="hal calibrate gripper",
        description="Home a gripper that needs it after its power was off (Robotiq, Franka Hand), or find where one is "
        "closed whose motor has its zero elsewhere (Damiao): that closes slowly, with little force, until something "
        "stops it, and the result is an entry for the rig file. Both only while the dead-man is held. The arm is not "
        "switched on.",
        epilog="An object between the fingers, or fingers that jam, cannot be told from closed fingers: take "
        "everything out, and look at them.",
    )
    add_rig_options(made)
    made.add_argument("--robot", metavar="NAME", help="its arm (default: the first)")
    return made


def find_zero(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    check_one_robot(args)
    args.overrides = [*args.overrides, "cameras={}"]
    plan = resolve_plan(args)
    spec, motor = _find_motor(plan, args)
    with hal.open(**rig_options(args)) as rig:
        print(f"{banner(rig)}\n{list_links(rig)}", flush=True)
        (robot,) = select_robots(rig, args)
        gripper = robot.gripper
        assert gripper is not None
        deadman = _find_deadman(rig, spec)
        result = close_while_held(rig, gripper, deadman)
        if result.fault is not None:
            raise hal.RobotFault(result.fault.cause, result.fault.remedy, code=result.fault.code)
        if motor is None:
            print(f"  ready, {1e3 * result.state.width:.0f} mm open")
            return 0
        groups = rig.statistics().values()
        offset = next(group["grippers"][gripper.name] for group in groups if gripper.name in group["grippers"])[
            "offset"
        ]
    before = motor.get("offset", 0.0)
    entry = ", ".join(f"{key}: {value}" for key, value in {**motor, "offset": round(offset, 4) + 0.0}.items())
    print(
        f"  the fingers are stopped {before - offset:+.3f} rad from the rig's closed position. If they are closed, and"
    )
    print("  nothing is between them, write this into the rig file:\n")
    print(f"robots:\n  {spec.name}:\n    gripper: {{real: {{motor: {{{entry}}}}}}}")
    return 0


def _find_motor(plan: Plan, args: argparse.Namespace) -> tuple[RobotSpec, dict[str, Any] | None]:
    """Return the arm, and the settings of its gripper's motor, None if it has its own zero. Raises NotSupported."""
    name = next(iter(robot_names(args)), plan.robots[0].name)
    spec = next(robot for robot in plan.robots if robot.name == name)
    if spec.gripper is None or not spec.attended:
        raise NotSupported(f"{name} has no gripper, or a simulated one, which needs no homing", code="no_real_gripper")
    return spec, spec.gripper.options.get("motor")


def _find_deadman(rig: Rig, spec: RobotSpec) -> Deadman:
    """Return the dead-man of the rig's pad, and say how it is used.

    Raises:
        CommandError: The rig has no pad.
        NotSupported: It must not be the dead-man of a real gripper.
    """
    deadman, _, name = find_deadman(rig, steps=True)
    if spec.attended and not spec.emulated:
        deadman.check_trust()
    holds = next(iter(rig.gamepads.values())).can_hold
    how = f"hold {name}: the fingers move only while it is held" if holds else f"press {name}: one step each"
    text = f"take everything out from between the fingers; then {how}"
    print(f"  {text}", flush=True)
    rig.say(text)
    return deadman


def close_while_held(rig: Rig, gripper: Gripper, deadman: Deadman) -> GripperResult:
    """Close the gripper whenever the dead-man is held, until it is closed; a release stops the fingers at once.

    Raises:
        MotionStopped: The rig was stopped, or the search took longer than :data:`LONGEST`.
    """
    from hal.types import GripperOutcome

    clock, motion = rig.clock, None
    end = clock.now() + LONGEST
    while clock.now() < end:
        held = deadman.holds(clock.now())
        if motion is not None and motion.done:
            result = motion.wait()
            if result.outcome is GripperOutcome.STOPPED:
                raise MotionStopped("the gripper was stopped", code="gripper_stopped")
            return result
        if motion is None and held:
            motion = gripper.start_home()
        elif motion is not None and not held:
            gripper.stop()
            motion = None
        clock.sleep(_PERIOD)
    gripper.stop()
    raise MotionStopped(f"nothing stopped the fingers within {LONGEST:g} s", code="not_closed")
