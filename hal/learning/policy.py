"""Policies: load one, and run one episode of it, with the limits and the dead-man that teleoperation has."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from ..commands import FIRST_STEP_ANGLE, Command, CommandChecks, JointChunk, JointVelocity
from ..errors import CommandError, ConnectionLost, HalError, MotionStopped, PolicyError, RobotFault, StaleStateError
from ..histogram import Histogram
from ..observation import Observation
from ..types import Trip
from .episode import stands_in_world

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..clock import Tick
    from ..control import Control
    from ..deadman import Deadman
    from ..rig import Rig
    from ..robot import Robot
    from ..servo.controllers import Controller
    from .takeover import Takeover

ArmAnswer: TypeAlias = "Command | tuple[Command | None, float | None] | None"
"""A command; or a command and a grip from 0 (open) to 1 (closed), either of which may be None. None continues the
chunk that was sent before."""
PolicyAnswer: TypeAlias = "ArmAnswer | Mapping[str, ArmAnswer]"
"""What one arm does; or, for several, the name of each arm -> what it does."""


PAST_LIMIT = 0.05
"""Greatest distance of a target past a joint's limit, rad; so little is noise, and cut off."""
POLICY_STOPS = frozenset(trip.code for trip in (Trip.COMMAND_LATE, Trip.LIMIT, Trip.APP_SILENT, Trip.HOST_LATE))
"""Codes of the stops that a policy causes, or a computer that is too slow for it; such an episode is a failure."""
FIRST_ANSWER = 2.5
"""Time for a policy's first command of an episode or after a pause, s; the arm stands still until then."""


class Policy(Protocol):
    """Anything that can be called with an observation.

    The times of a chunk are on ``rig.clock``, as ``observation.t`` is. It may have more methods: ``reset(seed)`` is
    called before each episode, ``restart()`` before the first call after a pause, ``rehearse(observation)`` instead of
    the call that :meth:`PolicyRunner.rehearse` makes, and ``statistics()`` after each episode.
    """

    def __call__(self, observation: Observation, /) -> PolicyAnswer:
        """Return the next command."""


def load_object(place: str, what: str) -> Any:
    """Return the callable at ``module:name``, whose name may have dots; ``what`` it is, for the message of an error.

    Raises:
        CommandError: It cannot be imported (code ``not_importable``) or called (``not_callable``).
    """
    module, _, name = place.partition(":")
    if not (module and name):
        raise CommandError(f"{what} {place!r}: write module:name, for example my_policy:act", code="not_importable")
    try:
        target: Any = importlib.import_module(module)
        for part in name.split("."):
            target = getattr(target, part)
    except (ImportError, AttributeError) as error:
        raise CommandError(f"{what} {place!r}: {error}", code="not_importable") from error
    if not callable(target):
        raise CommandError(f"{what} {place!r} cannot be called: it is a {type(target).__name__}", code="not_callable")
    return target


def is_made_with_rig(target: Any) -> bool:
    """Return whether a policy is a class whose constructor takes an argument, the rig."""
    if not isinstance(target, type):
        return False
    parameters = inspect.signature(target).parameters.values()
    return any(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) for p in parameters)


def load_policy(place: str, rig: Rig) -> Policy:
    """Return the policy at ``module:name``.

    A class is instantiated, with the rig if its constructor takes an argument. Raises as :func:`load_object`.
    """
    target: Any = load_object(place, "policy")
    if isinstance(target, type):
        target = cast(Any, target)(*([rig] if is_made_with_rig(target) else []))
        if not callable(target):
            raise CommandError(
                f"policy {place!r}: an object of this class cannot be called; give it a __call__", code="not_callable"
            )
    return cast(Policy, target)


def check_targets(robot: Robot, t: NDArray[np.float64], q: NDArray[np.float64]) -> None:
    """Check all targets of a chunk, so that a wrong one is refused before the first is followed.

    Args:
        robot: The arm.
        t: Their times (k,), s.
        q: Joint positions (k, n), rad, finite.

    Raises:
        PolicyError: One is past a joint's limit (code ``policy_bad_actions``), or farther from an earlier one than the
            arm travels in the time between them, and 0.1 rad (``policy_jump``).
    """
    past = np.maximum(np.array(robot.limits.lower) - q, q - np.array(robot.limits.upper))
    k, joint = np.unravel_index(np.argmax(past), past.shape)
    if past[k, joint] > PAST_LIMIT:
        raise PolicyError(
            f"target {k + 1} of {len(q)} in the policy's chunk is {q[k, joint]:.4g} rad at {robot.joints[joint]} of "
            f"{robot.name}, {past[k, joint]:.3g} rad past its limit",
            code="policy_bad_actions",
        )
    reach = np.asarray(robot.limits.velocity) * (t - t[0])[:, None]
    jump = np.maximum(*(way - reach - np.minimum.accumulate(way - reach) for way in (q, -q)))
    k, joint = np.unravel_index(np.argmax(jump), jump.shape)
    if jump[k, joint] > FIRST_STEP_ANGLE:
        raise PolicyError(
            f"target {k + 1} of {len(q)} in the policy's chunk is {jump[k, joint]:.3g} rad farther from an earlier one "
            f"at {robot.joints[joint]} of {robot.name} than the arm travels in the time between them; it may be "
            f"{FIRST_STEP_ANGLE} rad",
            code="policy_jump",
        )


@dataclass(frozen=True, slots=True)
class PolicyOutcome:
    """Result of one episode."""

    success: bool | None
    """Whether it succeeded; None if that is not known. False after an error or a stop of the policy's, after a fault of
    a simulated arm, or if time ran out before ``success`` was true."""
    ended: str
    """``success``, ``failure`` (marked by the operator), ``time``, ``stopped`` or ``error``."""
    reason: str
    """Why it was stopped, after the names of the stopped arms if there are several; or what the policy raised."""
    seconds: float
    """Time that the policy drove, without pauses, s."""
    turns: int
    """Turns in which the policy was called."""
    missed: int
    """Turns that were skipped because the policy, or the observation, took too long."""
    repeated: int
    """Turns without a newer observation than in the turn before."""
    pauses: int
    inference: dict[str, float | None]
    """p50, p99 and max of the policy's time per call, s."""
    error: BaseException | None = None
    """Error of the policy, or the stop."""
    statistics: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the policy's own, if it has any (see :meth:`.RemotePolicy.statistics`)."""
    interventions: tuple[tuple[float, float], ...] = ()
    """Begin and end of each time in which a person drove, s on ``rig.clock``."""

    @property
    def code(self) -> str:
        """Name of the error or the stop: its ``code``, such as ``policy_lost``, or its type; else empty."""
        error = self.error
        return "" if error is None else error.code if isinstance(error, HalError) else type(error).__name__


class PolicyRunner:
    """Calls a policy once per turn and sends its answer.

    Commands have the usual deadline (2.5 turns; a chunk: its end), so a policy that is late trips the arm; only the
    first one may take :data:`FIRST_ANSWER`. While the dead-man is not held, the policy is not called and its time
    stands still.
    """

    def __init__(
        self,
        rig: Rig,
        policy: Policy,
        *,
        robots: Collection[Robot] | None = None,
        rate_hz: float = 20.0,
        seconds: float = 30.0,
        deadman: Deadman | None = None,
        unattended: bool = False,
        controller: Controller | None = None,
        cameras: Collection[str] | None = None,
        history: int = 1,
        success: Callable[[Rig, Observation], bool] | None = None,
        mark: Callable[[], bool | None] | None = None,
        takeover: Takeover | None = None,
    ) -> None:
        """Prepare to run a policy.

        Args:
            rig: An open rig.
            policy: The policy.
            robots: Arms that the policy moves; None for the rig's first. For several it answers with a map of their
                names, and a stop of one ends the episode for all.
            rate_hz: Turns per second.
            seconds: Longest time of an episode, without pauses, s.
            deadman: Dead-man; something that really moves needs it, or ``unattended``.
            unattended: Let a real arm move without a dead-man.
            controller: What makes the arms follow, as in :meth:`.Robot.control`; in a takeover as well.
            cameras: Names of the observed cameras; None for all.
            history: Number of states per observation.
            success: Called as ``success(rig, observation)`` in each turn, before the policy; True ends the episode.
            mark: Called in each turn; True or False, the operator's mark, ends the episode.
            takeover: Lets a person drive an arm in between, while the others rest; the policy is asked again when the
                arm is given back.

        Raises:
            CommandError: ``seconds`` is not positive, there is no arm, or ``takeover`` drives another one.
        """
        if not seconds > 0.0:
            raise CommandError(f"an episode's seconds must be positive, not {seconds:g}")
        self.rig, self.policy = rig, policy
        self.robots = {arm.name: arm for arm in ([*rig.robots.values()][:1] if robots is None else robots)}
        if not self.robots:
            raise CommandError("a policy moves at least one arm", code="no_robot")
        if takeover is not None and takeover.teleop.robot.name not in self.robots:
            raise CommandError(f"the policy does not move {takeover.teleop.robot.name}, which the takeover drives")
        self._rate, self._seconds = rate_hz, seconds
        self._terms: dict[str, Any] = {
            "rate_hz": rate_hz,
            "deadman": deadman,
            "unattended": unattended,
            "controller": controller,
        }
        self._cameras, self._history = cameras, history
        self._success, self._mark, self._takeover = success, mark, takeover

    def rehearse(self) -> None:
        """Call the policy once before anything moves, and discard the answer: the first call is usually the slowest.

        Raises whatever the policy raises, so that its errors show before the first episode; CommandError for an answer
        that is not a command (code ``bad_answer``).
        """
        self._reset(None)
        self._split_answers(getattr(self.policy, "rehearse", self.policy)(self._observe()))

    def run(self, seed: int | None = None, on_turn: Callable[[float], None] = lambda seconds: None) -> PolicyOutcome:
        """Run one episode from the arms' present positions; they are at rest afterwards.

        Errors of the policy, and stops of the arm, end the episode and are part of the outcome. Ctrl-C and errors of
        the session itself are raised.

        Args:
            seed: Passed to the policy's ``reset``.
            on_turn: Called with the policy's driving time, s, in each turn, also in pauses.
        """
        self.rig.forget_observations()
        placed = all(stands_in_world(self.rig, robot) for robot in self.robots.values())
        tally = _Tally(judged=self._success is not None, faults_fail=placed)
        controls = {name: robot.control(**self._terms) for name, robot in self.robots.items()}
        stopped: list[str] = []
        try:
            with _mark_errors(PolicyError):
                self._reset(seed)
            if self._takeover is not None:
                self._takeover.reset()
            with _open_all(controls.values()):
                try:
                    self._drive(controls, tally, on_turn)
                except (MotionStopped, RobotFault):
                    stopped = [name for name, control in controls.items() if control.trip is not Trip.NONE]
                    raise
        except (MotionStopped, RobotFault, ConnectionLost, StaleStateError) as stop:
            arms = f"{', '.join(stopped)}: " if stopped and len(controls) > 1 else ""
            tally.end_as("stopped", arms + getattr(stop, "reason", str(stop)), stop)
        except _PolicyError as wrong:
            error = wrong.__cause__
            tally.end_as("error", f"{type(error).__name__}: {error}", error)
        statistics = getattr(self.policy, "statistics", dict)
        taken = tuple(self._takeover.intervals) if self._takeover is not None else ()
        return replace(tally.outcome(), statistics=statistics(), interventions=taken)

    def _reset(self, seed: int | None) -> None:
        reset = getattr(self.policy, "reset", None)
        if callable(reset):
            reset(seed)

    def _observe(self) -> Observation:
        return self.rig.observe(history=self._history, cameras=self._cameras)

    def _drive(self, controls: Mapping[str, Control], tally: _Tally, on_turn: Callable[[float], None]) -> None:
        seen, begun, asked, paused = -np.inf, set[str](), False, False
        restart = getattr(self.policy, "restart", lambda: None)
        for tick in self.rig.clock.rate(self._rate):
            on_turn(tally.seconds)
            mark = self._mark() if self._mark is not None else None
            if mark is not None:
                return tally.end_as("success" if mark else "failure")
            if not _follow_together(controls.values()):
                tally.count_pause()
                begun, paused = set(), asked
                continue
            tally.count_turn(tick.dt, tick.missed)
            if tally.seconds > self._seconds - 1e-9:
                return tally.end_as("time")
            observation = self._observe()
            tally.repeated += observation.t <= seen
            seen = observation.t
            if self._success is not None and self._success(self.rig, observation):
                return tally.end_as("success")
            if self._takeover is not None and self._drive_by_hand(self._takeover, controls, tick):
                begun, paused = set(), asked
                continue
            if paused:
                restart()
            asked, paused = True, False
            for name in controls.keys() - begun:
                controls[name].hold_for(FIRST_ANSWER)
            answers = self._answer(observation, tally)
            with _mark_errors((CommandError, PolicyError)):
                for name, (command, grip) in answers.items():
                    self._send(controls[name], command, grip, first=name not in begun)
            begun |= {name for name, (command, _) in answers.items() if command is not None}
        return None

    def _drive_by_hand(self, takeover: Takeover, controls: Mapping[str, Control], tick: Tick) -> bool:
        """Send a person's command to one arm, and let the others rest; return whether a person drives."""
        by_hand = takeover.command(tick.t, tick.dt)
        if by_hand is None:
            return False
        for name, control in controls.items():
            if name == takeover.teleop.robot.name:
                control.send(by_hand[0], grip=by_hand[1])
            else:
                _rest(control)
        return True

    def _send(self, control: Control, command: Command | None, grip: float | None, first: bool) -> None:
        if command is None and grip is None:
            return
        if command is not None and first:  # a first target that is far away is refused, as in any session
            checks, now = CommandChecks(control.robot), self.rig.clock.now()
            checks.check_first(checks.check_command(command, now, []), now, control.robot.state().q_set.tolist())
        if isinstance(command, JointChunk) and command.q.shape[1] == control.robot.n:
            check_targets(control.robot, command.t, command.q)
        control.send(command, grip=grip)

    def _answer(self, observation: Observation, tally: _Tally) -> dict[str, tuple[Command | None, float | None]]:
        start = time.perf_counter()
        with _mark_errors(Exception):
            answers = self._split_answers(self.policy(observation))
        tally.inference.add(time.perf_counter() - start)
        return answers

    def _split_answers(self, answer: Any) -> dict[str, tuple[Command | None, float | None]]:
        """Return command and grip for each arm. Raises CommandError for anything else (code ``bad_answer``)."""
        if not isinstance(answer, Mapping):
            if len(self.robots) > 1 and answer is not None:
                raise CommandError(
                    f"a policy for {', '.join(self.robots)} answers with a map of these names, not with a "
                    f"{type(answer).__name__}",
                    code="bad_answer",
                )
            answer = dict.fromkeys(self.robots, answer)
        if unknown := answer.keys() - self.robots.keys():
            raise CommandError(
                f"the policy answers for {', '.join(sorted(map(str, unknown)))}; it moves {', '.join(self.robots)}",
                code="bad_answer",
            )
        return {name: _split_answer(part) for name, part in answer.items()}


@contextlib.contextmanager
def _open_all(controls: Collection[Control]) -> Iterator[None]:
    """Open every arm's session; at the end all brake at once, and each is closed whatever happens to the others."""
    with contextlib.ExitStack() as closing:
        for control in controls:
            closing.enter_context(control)
        try:
            yield
        finally:
            for control in controls:
                control.brake()


def _follow_together(controls: Collection[Control]) -> bool:
    """Return whether every arm follows its commands; if not, let those that do come to rest."""
    following = [control for control in controls if control.hold_until_following()]
    if len(following) == len(controls):
        return True
    for control in following:
        _rest(control)
    return False


def _rest(control: Control) -> None:
    """Let an arm come to rest, or stay there, until the next command."""
    control.send(JointVelocity(np.zeros(control.robot.n)))


class _PolicyError(Exception):
    """The policy raised the error that is the cause of this one."""


@contextlib.contextmanager
def _mark_errors(kind: type[Exception] | tuple[type[Exception], ...]) -> Iterator[None]:
    """Raise errors of this kind, or of these, as a :class:`_PolicyError`."""
    try:
        yield
    except kind as error:
        raise _PolicyError from error


class _Tally:
    """Counts of one episode."""

    def __init__(self, judged: bool, faults_fail: bool) -> None:
        self._judged, self._faults_fail = judged, faults_fail
        self.seconds = 0.0
        self.repeated = 0
        self.inference = Histogram(1e-4, 20_000)
        self._missed = self._pauses = 0
        self._driving = False
        self._ended, self._reason = "time", ""
        self._error: BaseException | None = None

    def count_turn(self, dt: float, missed: int) -> None:
        if self._driving:
            self._missed += missed
            self.seconds += dt
        self._driving = True

    def count_pause(self) -> None:
        self._pauses += self._driving
        self._driving = False

    def end_as(self, ended: str, reason: str = "", error: BaseException | None = None) -> None:
        self._ended, self._reason, self._error = ended, reason, error

    def outcome(self) -> PolicyOutcome:
        marks = {"success": True, "failure": False, "error": False, "time": False if self._judged else None}
        fault = self._faults_fail and isinstance(self._error, RobotFault)
        if fault or getattr(self._error, "code", "") in POLICY_STOPS:
            marks["stopped"] = False
        return PolicyOutcome(
            success=marks.get(self._ended),
            ended=self._ended,
            reason=self._reason,
            seconds=self.seconds,
            turns=self.inference.count,
            missed=self._missed,
            repeated=self.repeated,
            pauses=self._pauses,
            inference=self.inference.summary(),
            error=self._error,
        )


def _split_answer(answer: Any) -> tuple[Command | None, float | None]:
    """Return command and grip of a policy's answer for one arm. Raises CommandError for anything else."""
    command, grip = answer, None
    if isinstance(answer, tuple):
        if len(answer) != 2:
            raise CommandError(
                f"a policy answers with a command, or with (command, grip), not with {len(answer)} values",
                code="bad_answer",
            )
        command, grip = answer
    if command is not None and not isinstance(command, Command):
        raise CommandError(
            f"the policy answers with a {type(command).__name__}, which is not a command", code="bad_answer"
        )
    return command, None if grip is None else float(np.clip(grip, 0.0, 1.0))
