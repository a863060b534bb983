"""The arms and cameras of a rig behind the interface of a robot of LeRobot: flat dicts of numbers and pictures."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hal
from hal.apps.check import may_open
from hal.commands import FIRST_STEP_ANGLE, JointTarget
from hal.config import load
from hal.config.mapping import load_mapping
from hal.deadman import Deadman
from hal.errors import CommandError, DeviceNotFound, MotionStopped, StaleStateError, Unreachable
from hal.gamepad import Gamepad
from hal.geometry import Pose, apply_rotation
from hal.observation import Observation
from hal.robot import Robot
from hal.specs import RobotSpec
from hal.teleop import Teleop
from hal.types import Trip

Array = NDArray[np.float64]

GRIPPER = "gripper"
"""Name of a gripper's number, as in recordings."""
PATIENCE = 60.0
"""Longest wait for the dead-man, s."""
OBSERVED = 1.0
"""Longest wait for an observation, s."""
LEAD = (0.03, 0.12)
"""Distance by which the goal of a pad may be ahead of the set-point, m and rad."""
LONGEST_STEP = 0.1
"""Longest time for which a pad's velocity moves the goal at once, s."""
_POLL = 0.005
"""Time between two looks at the dead-man, the servo, or a state that is late, s."""
_log = logging.getLogger("lerobot_robot_hal")


@dataclass(kw_only=True)
class RigOptions:
    """What of which rig is the robot, and who permits it to move."""

    rig: str = "panda_table"
    """Rig file, or name of a built-in rig."""
    sim: bool | None = None
    """True simulates every device, False makes every device real; None: as the rig file says."""
    engine: str | None = None
    """Engine of the simulation; None for the rig's."""
    overrides: list[str] = field(default_factory=list)
    """Changes of the rig, as ``KEY=VALUE``."""
    arms: list[str] | None = None
    """Names of the arms; None for all."""
    camera_names: list[str] | None = None
    """Names of the observed cameras; None for all that have colour."""
    rate_hz: float = 10.0
    """Lowest rate of actions, Hz: the arms come to rest if none comes for 2.5 periods, at least 0.1 s."""
    pad: str = "auto"
    """Gamepad of the dead-man and of ``--teleop.type=hal``, as ``hal --pad``: auto, web, evdev, demo or a recording."""
    console: bool = False
    """Serve the console."""
    deadman: bool = False
    """Require the dead-man for simulated arms too."""
    unattended: bool = False
    """Move real arms without a dead-man."""


@dataclass(kw_only=True)
class TeleopOptions:
    """How a pad drives."""

    arm: str | None = None
    """Name of the arm that it drives; None for the first."""
    mapping: str | None = None
    """Name or file of the teleoperation mapping; None for the pad's own."""


class RigRobot:
    """A rig as LeRobot sees a robot. Positions of joints are in rad, widths of grippers in m.

    Between actions the arms are under control sessions of :meth:`hal.robot.Robot.control`, all with one dead-man. If
    the actions pause, for example while LeRobot saves an episode, the arms come to rest, and the next action begins new
    sessions; a first target that is too far away for them is approached as by ``move_to``. Every other stop is raised.

    Args:
        options: The rig, and how it is used.

    Raises:
        ConfigError: The rig file is wrong.
        DeviceNotFound: There is no such arm or camera.
    """

    def __init__(self, options: RigOptions) -> None:
        self.options = options
        self._source: dict[str, Any] = {
            "config": options.rig,
            "sim": options.sim,
            "engine": options.engine,
            "overrides": options.overrides,
            "clock": "real_time",
        }
        self.plan = load(**self._source).resolve()
        known = {robot.name: robot for robot in self.plan.robots}
        self._specs = [_find(known, name, "robot") for name in options.arms or known]
        colored = {camera.name: camera for camera in self.plan.cameras if "color" in camera.streams}
        chosen = colored if options.camera_names is None else options.camera_names
        self.cameras = {name: _find(colored, name, "camera with colour") for name in chosen}
        """The observed cameras, by name."""
        self.rig: hal.Rig | None = None
        self.teleop: PadTargets | None = None
        """The arm that a pad drives; None if none does."""
        self._arms: list[_Arm] = []
        self._deadman: Deadman | None = None
        self._sessions = ExitStack()
        self._following = False

    # Features.

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the numbers of an action: those of recordings, with ``.pos``."""
        return {name: float for spec in self._specs for name in self._names(spec)}

    @property
    def observation_features(self) -> dict[str, Any]:
        """The same names, measured, and the shapes (H, W, 3) of the cameras' pictures."""
        return {**self.action_features, **{name: (c.height, c.width, 3) for name, c in self.cameras.items()}}

    def _names(self, spec: RobotSpec) -> list[str]:
        lead = f"{spec.name}." if len(self._specs) > 1 else ""
        parts = [*spec.joints, *([GRIPPER] if spec.gripper is not None else [])]
        return [f"{lead}{part}.pos" for part in parts]

    # Opening and closing.

    def connect(self, teleop: TeleopOptions | None = None) -> None:
        """Open the rig; nothing moves. Real arms are checked before.

        Args:
            teleop: How a pad of the rig drives; None if none does.

        Raises:
            CommandError: A check of a real arm failed, or a dead-man is needed and there is none.
        """
        options = self.options
        if not may_open(self.plan):
            raise CommandError("a check of a real arm failed; hal check --real has every result", code="not_fit")
        holds = teleop is not None or options.deadman or (self.plan.attended and not options.unattended)
        rig = hal.open(**self._source, pad=options.pad if holds else "none", console=options.console)
        try:
            self.use(rig, holds, teleop)
        except BaseException:
            rig.close()
            raise
        for note in rig.notes:
            _log.warning(note)

    def use(self, rig: hal.Rig, holds: bool = False, teleop: TeleopOptions | None = None) -> None:
        """Use an open rig, as :meth:`connect` does; ``holds``: move only while the dead-man of its pad is held."""
        arms = [_Arm(rig.robots[spec.name], self._names(spec)) for spec in self._specs]
        if holds:
            pad = next(iter(rig.gamepads.values()), None)
            if pad is None or not pad.can_hold:
                text = "has no gamepad whose dead-man can be held; see --robot.pad and --robot.unattended"
                raise CommandError(f"{rig.plan.source} {text}", code="no_gamepad")
            mapping = (teleop and teleop.mapping) or pad.mapping or "default"
            control = load_mapping(mapping).deadman
            self._deadman = pad.hold(control)
            _log.warning("release %s of %s, then hold it to move", pad.control_name(control), pad.describe())
            if teleop is not None:
                robot = _find({arm.robot.name: arm.robot for arm in arms}, teleop.arm or arms[0].robot.name, "arm")
                self.teleop = PadTargets(robot, pad, mapping)
        self.rig, self._arms = rig, arms

    def close(self) -> None:
        """Bring the arms to rest and close the rig. Idempotent."""
        rig, self.rig = self.rig, None
        if rig is not None:
            try:
                self._close_sessions()
            finally:
                self.teleop = self._deadman = None
                rig.close()

    def _require_open(self) -> hal.Rig:
        if self.rig is None:
            raise CommandError("the robot is not connected: call connect()", code="not_connected")
        return self.rig

    # Observations and actions.

    def observe(self) -> dict[str, Any]:
        """Return the newest pictures, with the positions of all joints and grippers at the time of the newest.

        Raises:
            StaleStateError: A picture or a state did not come for :data:`OBSERVED`.
            ConnectionLost: A device does not answer.
        """
        seen = self._observe_rig()
        found: dict[str, Any] = {}
        for arm in self._arms:
            values = seen.robots[arm.robot.name].q.tolist()
            if arm.robot.gripper is not None:
                values.append(seen.grippers[arm.robot.name].width)
            found.update(zip(arm.names, values, strict=True))
        return found | {name: np.array(moment.frame.color) for name, moment in seen.cameras.items()}

    def _observe_rig(self) -> Observation:
        """Observe the rig; on a busy computer a state may come late, and ends no recording."""
        rig = self._require_open()
        end = rig.clock.now() + OBSERVED
        while True:
            try:
                return rig.observe(cameras=list(self.cameras))
            except StaleStateError:
                if rig.clock.now() > end:
                    raise
                rig.clock.sleep(_POLL)

    def read_pad(self) -> dict[str, float]:
        """Return the action that the pad wants; the other arms stay where they are."""
        self._require_open()
        action = self._set_points()
        if self.teleop is not None:
            arm = next(arm for arm in self._arms if arm.robot is self.teleop.robot)
            action.update(arm.join(*self.teleop.read(self._following)))
        return action

    def send(self, action: Mapping[str, Any]) -> dict[str, float]:
        """Send an action to the servos.

        While the dead-man is not held this waits, and so the time of a policy or a replay stands still; with a pad as
        the teleoperator it returns at once, so that LeRobot's loop continues.

        Returns:
            The action that was sent, cut to the limits; while the dead-man is not held, where the arms are.

        Raises:
            CommandError: The action lacks a number, or one is not finite.
            MotionStopped: A stop, or the dead-man was not held for :data:`PATIENCE`. The arms are at rest.
            RobotFault: A robot reports a fault.
            ConnectionLost: An arm does not answer.
        """
        self._require_open()
        targets = [(arm, *arm.split(action)) for arm in self._arms]
        self._following = self._follow(targets)
        if not self._following:
            return self._set_points()
        sent: dict[str, float] = {}
        for arm, q, width in targets:
            assert arm.control is not None
            command = arm.control.send(JointTarget(q), width=arm.find_change(width)).command
            assert isinstance(command, JointTarget)
            sent.update(arm.join(command.q, width))
        return sent

    def _set_points(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for arm in self._arms:
            found.update(arm.join(arm.robot.state().q_set, _read_target(arm.robot)))
        return found

    # Control sessions.

    def _follow(self, targets: list[tuple[_Arm, Array, float | None]]) -> bool:
        """Return whether every arm follows; wait for that, unless a pad drives."""
        rig = self._require_open()
        end = rig.clock.now() + PATIENCE
        while True:
            try:
                if not all(arm.control for arm in self._arms):
                    self._open_sessions(targets)
                follows = [arm.control.hold_until_following() for arm in self._arms if arm.control]
                if all(follows):
                    return True
            except MotionStopped as stop:
                alone = self._deadman is None and rig.attended and not rig.emulated
                if stop.code != Trip.COMMAND_LATE.code or alone:
                    raise  # as in hal rollout, only a person continues the motion of a real arm
                again = "" if self._deadman is None else "; release the dead-man, then hold it again"
                _log.warning("no action came in time: the arms came to rest%s", again)
                self._close_sessions()
            if self.teleop is not None:
                return False
            if rig.clock.now() > end:
                text = f"the dead-man was not held for {PATIENCE:g} s"
                raise MotionStopped(text, "release it, then hold it", code="deadman_not_pressed")
            rig.clock.sleep(_POLL)

    def _open_sessions(self, targets: list[tuple[_Arm, Array, float | None]]) -> None:
        terms: dict[str, Any] = {"deadman": self._deadman, "unattended": self.options.unattended}
        closed = [(arm, q) for arm, q, _ in targets if arm.control is None]
        for arm, q in closed:
            if np.abs(q - arm.robot.state().q_set).max() > FIRST_STEP_ANGLE:
                _log.warning("%s moves to its first target", arm.robot.name)
                arm.robot.move_to(arm.clip(q), patience=PATIENCE, **terms)
        for arm, _ in closed:
            arm.control = self._sessions.enter_context(arm.robot.control(rate_hz=self.options.rate_hz, **terms))

    def _close_sessions(self) -> None:
        for arm in self._arms:
            control, arm.control = arm.control, None
            if control is not None:
                control.brake()  # all at once, before the first is waited for
        self._sessions.close()


class _Arm:
    """One arm: its numbers in an action, and its control session."""

    def __init__(self, robot: Robot, names: list[str]) -> None:
        self.robot, self.names = robot, names
        self.control: hal.Control | None = None
        self._moves_fingers = False

    def find_change(self, width: float | None) -> float | None:
        """Return the width to command, m; None until one differs from the last command, so that fingers keep hold."""
        gripper = self.robot.gripper
        if gripper is None or width is None:
            return None
        change = abs(width - gripper.state(np.inf).width_target)
        self._moves_fingers = self._moves_fingers or change > 0.005 * gripper.width_max
        return width if self._moves_fingers else None

    def split(self, action: Mapping[str, Any]) -> tuple[Array, float | None]:
        """Return joint positions (n,), rad, and the width of the gripper, m, or None. Raises CommandError."""
        if missing := [name for name in self.names if name not in action]:
            raise CommandError(f"the action lacks {', '.join(missing)}", code="bad_action")
        numbers = np.array([float(action[name]) for name in self.names])
        if not np.isfinite(numbers).all():
            raise CommandError(f"the action has a number that is not finite: {dict(action)}", code="bad_action")
        gripper = self.robot.gripper
        if gripper is None:
            return numbers, None
        return numbers[:-1], min(max(float(numbers[-1]), 0.0), gripper.width_max)

    def join(self, q: Array, width: float | None) -> dict[str, float]:
        """Return the numbers of an action: joint positions (n,), rad, and the width of a gripper, m."""
        return dict(zip(self.names, [*q.tolist(), *([] if width is None else [width])], strict=True))

    def clip(self, q: Array) -> Array:
        """Return joint positions within the limits, rad."""
        limits = self.robot.limits
        return np.clip(q, limits.lower, limits.upper)


class PadTargets:
    """Turns the states of a pad into joint targets of an arm: the mapping's twist, integrated.

    Args:
        robot: The arm.
        pad: The pad.
        mapping: Name or file of the mapping.
    """

    def __init__(self, robot: Robot, pad: Gamepad, mapping: str) -> None:
        self.robot, self.pad = robot, pad
        self._t = -np.inf
        """Time of the last call, s."""
        self._teleop = Teleop(robot, mapping)
        self._goal = Pose()
        self._q: Array | None = None
        """Joint positions (n,) of the goal, rad; None while the arm does not follow."""
        self._width: float | None = None
        robot.ik(robot.state().tcp_set)  # the first call is slow, and would make an action late

    def read(self, follows: bool) -> tuple[Array, float | None]:
        """Return joint positions (n,), rad, and a width, m, or None without a gripper.

        Args:
            follows: Whether the arm follows; else its set-point is returned.
        """
        state, gripper, now = self.robot.state(), self.robot.gripper, self.robot.clock.now()
        if self._width is None:
            self._width = _read_target(self.robot)
        self._t, dt = now, min(now - self._t, LONGEST_STEP)
        motion, grip = self._teleop.step(self.pad.state(), dt)
        if gripper is not None and grip is not None:
            self._width = gripper.width_of(grip)
        if not follows or self._q is None:
            self._goal, self._q = state.tcp_set, np.array(state.q_set)
        if follows and (motion.linear.any() or motion.angular.any()):
            self._move(motion, dt, state.tcp_set)
        return self._q, self._width

    def _move(self, motion: hal.Twist, dt: float, reached: Pose) -> None:
        """Move the goal on, unless the arm is too far behind or does not reach it."""
        assert self._q is not None
        linear, angular = motion.linear, motion.angular
        if motion.frame == "tcp":
            axes = Pose(orientation=self._goal.orientation)
            linear, angular = axes.transform(linear), axes.transform(angular)
        turned = apply_rotation(self._goal.orientation.tolist(), (dt * angular).tolist())
        goal = Pose(self._goal.position + dt * linear, turned)
        before, after = reached.distance(self._goal), reached.distance(goal)
        if any(ahead > most and ahead > was for ahead, most, was in zip(after, LEAD, before, strict=True)):
            return
        try:
            q = self.robot.ik(goal, self._q)
        except Unreachable:
            return
        if np.abs(q - self._q).max() <= FIRST_STEP_ANGLE:  # else it is another posture
            self._goal, self._q = goal, q


def _read_target(robot: Robot) -> float | None:
    """Return the last commanded width of an arm's gripper, m; None without one."""
    return None if robot.gripper is None else robot.gripper.state(np.inf).width_target


def _find(known: Mapping[str, Any], name: str, what: str) -> Any:
    if name not in known:
        raise DeviceNotFound(f"this rig has no {what} {name!r}; it has: {', '.join(known) or 'none'}")
    return known[name]
