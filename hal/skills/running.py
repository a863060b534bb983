"""What all skills share: phases, moves of the arm and the fingers behind one dead-man, and the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from types import TracebackType
from typing import TYPE_CHECKING, Literal, NoReturn, TypedDict

import numpy as np
from numpy.typing import NDArray

from ..arguments import number
from ..control import check_deadman
from ..errors import CollisionError, CommandError, MotionStopped, NotSupported, RobotFault, Unreachable
from ..geometry import Pose
from ..types import GripperOutcome

if TYPE_CHECKING:
    from ..deadman import Deadman
    from ..gripper import Gripper, GripperMotion, GripperResult
    from ..robot import Robot

Array = NDArray[np.float64]

Reason = Literal[
    "",
    "unreachable",
    "outside_limits",
    "collision",
    "too_wide",
    "holding",
    "blocked",
    "fingers_blocked",
    "missed",
    "wrong_width",
    "not_centred",
    "dropped",
    "not_seen",
    "off_goal",
    "timed_out",
]
"""Why a skill failed: a stable identifier, empty for a success.

====================  ================================================================================================
``unreachable``       The arm does not reach a pose of the plan. Nothing has moved.
``outside_limits``    A pose of the plan is outside the workspace or the joint limits of the rig.
``collision``         The way to a pose of the plan would bring the arm into itself, another arm, or a box of the rig.
``too_wide``          The object is wider than the gripper opens. Nothing has moved.
``holding``           The fingers hold something already. Nothing has moved.
``blocked``           The arm did not get to a pose of the plan: something was in its way.
``fingers_blocked``   The fingers did not open as far as they should, or never came to rest.
``missed``            The fingers closed on nothing.
``wrong_width``       The fingers closed on something that is wider or narrower than the object should be.
``not_centred``       The object was not found between the fingers where the first touch was.
``dropped``           The object was held, and is not any more.
``not_seen``          No object was found.
``off_goal``          The object is not at its goal after the last push.
``timed_out``         The skill took longer than its ``timeout``. The arm stops, and the fingers keep what they hold.
====================  ================================================================================================
"""

_POLL = 0.02
"""Time between two looks at the dead-man or the fingers, s."""
_JUMP = 1.2
"""Change of a joint between two poses near by from which on it counts as a jump, rad."""
_SINK = 0.03
"""By how much the tcp may sink on its way through free space, m."""
_RAISE = 0.15
"""Height of the point over which the arm goes if it would sink more, m."""
_STEPS = 10
"""Number of points of a way at which that is checked."""
_OFF_TARGET = 0.01
"""Distance from the goal above which an arm at rest counts as blocked, m."""
_NEAR_SPEED = 0.1
"""Greatest speed of the tcp near an object, m/s."""
_LONGEST_MOVE = 120.0
"""Time after which an arm that has not arrived counts as blocked, s; without a dead-man, which may pause it."""
_TIMEOUT = 300.0
"""Longest time for a skill by default, s."""
_LONGEST_GRIP = 15.0
"""Time after which moving fingers count as blocked, s."""


class SkillOptions(TypedDict, total=False):
    """Arguments that all skills take, each of which may be left out."""

    speed: float | None
    """Share of the joint speed limits for motions in free space; the rig's ``move_speed`` by default."""
    deadman: Deadman | None
    """Switch that must be held for the arm and the fingers to move, for example ``pad.hold("l2")``."""
    unattended: bool
    """Move an arm that really moves without a dead-man."""
    patience: float
    """Longest time for which the dead-man may be released, s; 60 by default."""
    timeout: float
    """Longest time for the whole skill, s, with the pauses in which the dead-man is released; 300 by default."""
    progress: Callable[[SkillProgress], None] | None
    """Called when a phase begins; what it raises ends the skill."""


@dataclass(frozen=True, slots=True)
class SkillProgress:
    """Passed to a skill's ``progress`` function when a phase begins."""

    skill: str
    """Name of the skill: ``grasp``, ``gentle_grasp`` or ``push``."""
    phase: str
    """Name of the phase that begins."""
    number: int
    """Number of the phase, counted from 1."""
    count: int
    """Number of all phases of the skill."""


@dataclass(frozen=True, slots=True)
class SkillPhase:
    """A phase that was begun."""

    name: str
    start: float
    """Time on ``rig.clock``, s."""


@dataclass(frozen=True, slots=True)
class SkillResult:
    """How a skill ended. It is true for a success."""

    skill: str
    reason: Reason
    """Why it failed; empty for a success."""
    phase: str
    """The phase in which it ended."""
    message: str
    """The same in words, with numbers."""
    phases: tuple[SkillPhase, ...]
    """All phases that were begun, in order."""
    duration: float
    """Time that it took, s."""
    tcp: Pose
    """Pose of the tcp at the end, in the arm's base frame."""
    width: float | None
    """Distance between the fingers at the end, m; None without a gripper."""

    def __bool__(self) -> bool:
        return not self.reason


class _Failed(Exception):
    """Ends the ``with`` block of a :class:`SkillRun`."""


class SkillRun:
    """One run of a skill, used in a ``with`` statement, whose block ends at the first :meth:`fail`.

    Stops and faults leave the block as the exceptions that they are.

    Args:
        skill: Name of the skill.
        arm: The arm.
        phases: Names of the phases, in order.

    The other arguments are the keys of :class:`SkillOptions`.
    """

    def __init__(
        self,
        skill: str,
        arm: Robot,
        phases: Sequence[str],
        *,
        speed: float | None = None,
        deadman: Deadman | None = None,
        unattended: bool = False,
        patience: float = 60.0,
        timeout: float = _TIMEOUT,
        progress: Callable[[SkillProgress], None] | None = None,
    ) -> None:
        check_deadman(deadman)
        if patience != math.inf:
            number("patience", patience, "s", least=0.0)
        self.arm = arm
        self._skill, self._names, self._progress = skill, tuple(phases), progress
        self._deadman, self._unattended, self._patience, self._speed = deadman, unattended, patience, speed
        self._timeout = number("timeout", timeout, "s", least=0.0, above=True)
        self._start = arm.clock.now()
        self._phases: list[SkillPhase] = []
        self._reason: Reason = ""
        self._message = ""

    @property
    def gripper(self) -> Gripper:
        """The arm's gripper. Raises NotSupported if it has none."""
        if self.arm.gripper is None:
            raise NotSupported(f"{self.arm.name} has no gripper, which {self._skill} needs", code="no_gripper")
        return self.arm.gripper

    def __enter__(self) -> SkillRun:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        return isinstance(error, _Failed)

    def begin(self, phase: str) -> None:
        """Begin a phase, and report it."""
        self._phases.append(SkillPhase(phase, self.arm.clock.now()))
        if self._progress is not None:
            number = self._names.index(phase) + 1
            self._progress(SkillProgress(self._skill, phase, number, len(self._names)))

    def fail(self, reason: Reason, message: str) -> NoReturn:
        """End the block as a failure; the first failure of a run is the one that is reported."""
        if not self._reason:
            self._reason, self._message = reason, message
        raise _Failed

    @property
    def reason(self) -> Reason:
        """Why the skill has failed; empty if it has not."""
        return self._reason

    def time_left(self) -> float:
        """Return how much time is left, s; fail as ``timed_out`` if there is none."""
        left = self._timeout - (self.arm.clock.now() - self._start)
        if left <= 0.0:
            self.fail("timed_out", f"{self._skill} took longer than {self._timeout:g} s")
        return left

    def result(self) -> SkillResult:
        """Return how the skill ended."""
        arm = self.arm
        return SkillResult(
            skill=self._skill,
            reason=self._reason,
            phase=self._phases[-1].name if self._phases else "plan",
            message=self._message or f"{self._skill} succeeded",
            phases=tuple(self._phases),
            duration=arm.clock.now() - self._start,
            tcp=arm.state().tcp,
            width=arm.gripper.state().width if arm.gripper is not None else None,
        )

    # The arm.

    def choose_way(self, *groups: Sequence[Sequence[Pose]]) -> tuple[Sequence[Pose], Array]:
        """Return a way that the arm reaches all along, and the joint positions (n,) in rad at its start.

        It is the nearest one, in joint positions, of the first group with any; one with straight lines all along comes
        first. Fails as ``unreachable`` or ``outside_limits`` if there is none.

        Args:
            groups: Ways: the poses of the tcp, in the arm's base frame, in the order in which they are visited.
        """
        now, home = self.arm.state().q, np.asarray(self.arm.home, float)
        first: tuple[Sequence[Pose], Array] | None = None
        problems: list[tuple[Reason, str]] = []
        for near, ways in product((now, home), groups):  # from an odd posture, lines may end at a joint's limit
            found = []
            for way in ways:
                try:
                    start = self._solve(way, near)
                except Unreachable as error:
                    problems.append(("unreachable", str(error)))
                except CommandError as error:
                    problems.append(("outside_limits", str(error)))
                else:
                    found.append((float(np.abs(start - now).max()), way, start))
            for _, way, start in sorted(found, key=lambda each: each[0]):
                if self._is_straight(way, start):
                    return way, start
                first = first or (way, start)
        return first or self.fail(*problems[0])

    def _is_straight(self, way: Sequence[Pose], q: Array) -> bool:
        """Return whether the tcp can follow the lines of a way, which begins at joint positions (n,), rad."""
        from ..motion.planning import PathPlanner

        planner = PathPlanner(self.arm.kinematics, self.arm.limits.lower, self.arm.limits.upper)
        try:
            planner.plan_poses(q.tolist(), [(*pose.position.tolist(), *pose.orientation.tolist()) for pose in way])
        except (Unreachable, CommandError):
            return False
        return True

    def _solve(self, way: Sequence[Pose], near: Array) -> Array:
        """Return joint positions (n,) in rad at the start of a way; raise if the arm does not reach all of it.

        Args:
            way: The poses of the tcp.
            near: Joint positions (n,) near which to search, rad.
        """
        arm, box = self.arm, self.arm.spec.workspace
        last, first = near, None
        for pose in way:
            if box is not None and not np.all((pose.position >= box.lower) & (pose.position <= box.upper)):
                raise CommandError(f"{_text(pose)} is outside the workspace of {arm.name}", code="outside_workspace")
            q = arm.ik(pose, last)
            if first is None:
                first = q
            elif np.abs(q - last).max() > _JUMP:
                text = f"the joints would jump on the way to {_text(pose)}"
                raise Unreachable(text, position_error=0.0, rotation_error=0.0)
            last = q
        assert first is not None
        return first

    def approach(self, before: Pose, q: Array, pose: Pose) -> None:
        """Go to where an approach begins, and from there straight to its end: ``approach`` and ``descend``.

        Args:
            before: Pose of the tcp at which the approach begins.
            q: Joint positions (n,) in rad there, which :meth:`choose_way` has found.
            pose: Pose of the tcp at its end.
        """
        self.begin("approach")
        self.go(before, q)
        self.begin("descend")
        self.move(pose)

    def go(self, pose: Pose, q: Array) -> None:
        """Move in free space to a pose, with the joint positions (n,) in rad that :meth:`choose_way` found for it.

        The way is straight in joint space. If the tcp would sink on it, the arm goes over a raised point between.
        """
        arm = self.arm
        start = arm.state()
        low = min(start.tcp_set.position[2], pose.position[2]) - _SINK
        steps = np.linspace(0.0, 1.0, _STEPS)[:, None]
        way = q
        if any(arm.fk(each).position[2] <= low for each in start.q_set + steps * (q - start.q_set)):
            middle = 0.5 * (start.tcp_set.position + pose.position)
            with suppress(Unreachable):
                way = np.array([arm.ik(lift_pose(Pose(middle, pose.orientation), _RAISE), q), q])
        try:
            self._move(pose, way)
        except Unreachable as error:  # the way leaves the workspace; nothing has moved
            self.fail("unreachable", str(error))

    def move(self, pose: Pose, *, tcp_speed: float = _NEAR_SPEED) -> None:
        """Move the tcp a short way to a pose near by: on a straight line, or in joint space where that cannot be.

        Args:
            pose: Pose of the tcp in the arm's base frame.
            tcp_speed: Greatest speed of the tcp, m/s.
        """
        try:
            self._move(pose, pose, tcp_speed=tcp_speed, straight=True)
        except Unreachable as error:  # nothing has moved
            state = self.arm.state()
            try:
                q = self.arm.ik(pose, state.q_set)
            except Unreachable:
                q = None
            if q is None or np.abs(q - state.q_set).max() > _JUMP:
                self.fail("unreachable", str(error))
            self._move(pose, q, tcp_speed=tcp_speed)

    def _move(
        self, pose: Pose, target: Pose | Array, *, tcp_speed: float | None = None, straight: bool = False
    ) -> None:
        """Move to ``target``, and fail unless the tcp is then at ``pose``. Raises Unreachable before it moves."""
        left = self.time_left()
        most = self.arm.spec.tcp_speed
        try:
            state = self.arm.move_to(
                target,
                deadman=self._deadman,
                unattended=self._unattended,
                patience=self._patience,
                timeout=left if self._deadman is not None else min(left, _LONGEST_MOVE),
                tcp_speed=None if tcp_speed is None else min(tcp_speed, most),
                speed=self._speed if tcp_speed is None else self.arm.spec.speed,
                straight=straight,
            )
        except CollisionError as error:
            self.fail("collision", str(error))
        except CommandError as error:
            if error.code not in ("outside_limits", "outside_workspace"):
                raise
            self.fail("outside_limits", str(error))
        except TimeoutError as error:
            self.time_left()
            self.fail("blocked", str(error))
        self.check_arrived(pose, state.tcp)

    def check_arrived(self, pose: Pose, tcp: Pose) -> None:
        """Fail as ``blocked`` if the tcp is not at a pose."""
        distance, _ = pose.distance(tcp)
        if distance > _OFF_TARGET:
            self.fail("blocked", f"the tcp of {self.arm.name} rests {1e3 * distance:.0f} mm from {_text(pose)}")

    # The fingers.

    def wait_held(self) -> None:
        """Wait until the dead-man is held. Raises MotionStopped (``deadman_released``) after the patience."""
        deadman, clock = self._deadman, self.arm.clock
        since = clock.now()
        while deadman is not None and not deadman.held:
            if clock.now() - since > self._patience:
                raise MotionStopped(f"the dead-man was not held for {self._patience:g} s", code="deadman_released")
            self.time_left()
            clock.sleep(_POLL)

    def close_fingers(
        self, start: Callable[[], GripperMotion], until: Callable[[], bool] = lambda: False
    ) -> GripperResult | None:
        """Start a motion of the fingers, and wait until they rest.

        They stop while the dead-man is released, and the motion is started again when it is held again.

        Args:
            start: Starts the motion.
            until: Checked underway; True stops the fingers.

        Returns:
            The result; None if ``until`` stopped the fingers.

        Raises:
            RobotFault: The gripper failed.
            MotionStopped: A stop, or another command, ended the motion, or the dead-man was released too long.
        """
        clock, gripper = self.arm.clock, self.gripper
        while True:
            self.wait_held()
            motion = start()
            begun = clock.now()
            try:
                while not motion.done:
                    if self._deadman is not None and not self._deadman.held:
                        gripper.stop()
                        break
                    if until():
                        gripper.stop()
                        motion.wait()
                        return None
                    if clock.now() - begun > _LONGEST_GRIP:
                        rests = gripper.state().width
                        self.fail("fingers_blocked", f"{gripper.name} does not come to rest: {rests:.4f} m")
                    self.time_left()
                    clock.sleep(max(_POLL, gripper.period))
                else:
                    return self._check_result(motion.wait())
            except BaseException:
                if not motion.done:
                    gripper.stop()
                raise

    def set_fingers(self, width: float = math.inf) -> None:
        """Move the fingers to a width in m, by default open; fail as ``fingers_blocked`` if they do not get there."""
        gripper = self.gripper
        goal = min(width, gripper.width_max)
        result = self.close_fingers(lambda: gripper.start(goal))
        if result is not None and abs(result.state.width - goal) > 0.005:
            self.fail("fingers_blocked", f"{gripper.name} rests at {result.state.width:.4f} m instead of {goal:.4f} m")

    def _check_result(self, result: GripperResult) -> GripperResult:
        """Return the result of a motion of the fingers; raise if it failed, or was ended by another command."""
        if result.outcome is GripperOutcome.FAILED:
            fault = result.fault
            raise RobotFault(*((fault.cause, fault.remedy) if fault else (f"{self.gripper.name} failed", "")))
        if result.outcome is GripperOutcome.STOPPED:
            raise MotionStopped(f"{self.gripper.name} was stopped, or got a newer command", code="gripper_stopped")
        return result


def lift_pose(pose: Pose, height: float) -> Pose:
    """Return the pose ``height`` m farther up, along the z axis of the base frame."""
    return Pose(pose.position + [0.0, 0.0, height], pose.orientation)


def flip_pose(pose: Pose) -> Pose:
    """Return the pose turned by half a turn about the tcp's own z axis: the same grasp for two equal fingers."""
    return pose @ Pose.from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, math.pi))


def _text(pose: Pose) -> str:
    return "({:.3f}, {:.3f}, {:.3f}) m".format(*pose.position)
