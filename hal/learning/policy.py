"""Policies: what one is, where it comes from, and one episode of it under the limits that a person has, too."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, cast

import numpy as np

from ..commands import Command, JointChunk, JointTarget
from ..control import CommandChecks
from ..errors import CommandError, ConnectionLost, MotionStopped, RobotFault, StaleStateError
from ..histogram import Histogram
from ..observation import Observation
from ..types import RobotStatus

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..control import Control
    from ..deadman import Deadman
    from ..rig import Rig
    from ..robot import Robot

__all__ = [
    "Answer",
    "Outcome",
    "Policy",
    "PolicyRunner",
    "follows",
    "found",
    "load_policy",
    "wait_here",
]

# [handover.py] From a person's hand to a program's: when may a program's motion begin, or go on after a pause?


def follows(control: Control) -> bool:
    """Does the arm follow commands now? Until it does, it is told to stay where it is; call it once a turn.

    A command that was sent before the servo has seen a new press of the dead-man does not count. Nothing of a motion
    that has a beginning is lost so, for it is sent only when this is True. Raises what ``control.send`` raises.
    """
    held = control.deadman is None or control.deadman.held
    if held and control.status is RobotStatus.FOLLOWING:
        return True
    control.send(JointTarget(control.robot.state().q_set))
    return False


def wait_here(control: Control, seconds: float) -> None:
    """Stay, for up to so many s (3 at most): until a motion that is not known yet begins. Later than that is a trip."""
    now, q_set = control.robot.clock.now(), control.robot.state().q_set
    control.send(JointChunk([now, now + seconds], [q_set, q_set]))


Answer: TypeAlias = "Command | tuple[Command | None, float | None] | None"
"""A command; or a command and a grip from 0 (open) to 1 (closed), either of which may be None. None goes on with the
chunk that was sent before."""


FIRST_ANSWER = 2.5
"""s that a policy may take for its first command, of an episode or after a pause: the arm stands still until then."""


class Policy(Protocol):
    """Anything that can be called with an observation.

    It may have a method ``reset(seed)``, which is called before each episode. The times of a chunk are on
    ``rig.clock``, as ``observation.t`` is.
    """

    def __call__(self, observation: Observation, /) -> Answer:
        """What to do now."""


def found(place: str, what: str) -> Any:
    """The object at ``module:name``. CommandError, which names ``what`` was looked for, where there is none."""
    module, _, name = place.partition(":")
    if not (module and name):
        raise CommandError(f"{what} {place!r}: write module:name, for example my_policy:act")
    try:
        thing: Any = importlib.import_module(module)
        for part in name.split("."):
            thing = getattr(thing, part)
    except (ImportError, AttributeError) as error:
        raise CommandError(f"{what} {place!r}: {error}") from error
    if not callable(thing):
        raise CommandError(f"{what} {place!r} cannot be called: it is a {type(thing).__name__}")
    return thing


def load_policy(place: str, rig: Rig) -> Policy:
    """The policy at ``module:name``. A class is made once: with the open rig where it takes an argument, else without.

    Raises CommandError where there is none.
    """
    thing: Any = found(place, "policy")
    if isinstance(thing, type):
        parameters = inspect.signature(thing).parameters.values()
        takes = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        thing = cast(Any, thing)(*([rig] if takes else []))
        if not callable(thing):
            raise CommandError(f"policy {place!r}: an object of this class cannot be called; give it a __call__")
    return cast(Policy, thing)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an episode went."""

    success: bool | None
    """None where nobody said; False where time ran out before ``success`` was true."""
    ended: str
    """``success``, ``failure`` (somebody marked it), ``time``, ``stopped`` or ``error``."""
    reason: str
    """Why it was stopped, or what the policy raised."""
    seconds: float
    """That the policy drove; pauses do not count."""
    turns: int
    """In which it was asked."""
    missed: int
    """Turns that were skipped, since the policy, or the observation, took too long."""
    repeated: int
    """Turns in which there was nothing newer to observe than in the turn before."""
    pauses: int
    inference: dict[str, float | None]
    """p50, p99 and max of the policy's time per call, s."""
    error: BaseException | None = None
    """What the policy raised."""


class PolicyRunner:
    """Asks a policy once a turn, and sends its answer.

    Its commands have the deadline of anybody's (2.5 turns; a chunk: its end), so a policy that is late trips the arm;
    the first one may take longer.
    While the dead-man is not held it is not asked, and its time stands still.
    """

    def __init__(
        self,
        rig: Rig,
        policy: Policy,
        *,
        robot: Robot | None = None,
        rate_hz: float = 20.0,
        seconds: float = 30.0,
        deadman: Deadman | None = None,
        unattended: bool = False,
        cameras: Collection[str] | None = None,
        history: int = 1,
        success: Callable[[Rig, Observation], bool] | None = None,
        mark: Callable[[], bool | None] | None = None,
    ) -> None:
        """``success(rig, observation)`` is asked in each turn before the policy is: True ends the episode. ``mark()``,
        a person's, says True or False to end it so. ``cameras`` are those that are observed, else all."""
        if not seconds > 0.0:
            raise CommandError(f"an episode's seconds must be positive, not {seconds:g}")
        self.rig, self.policy = rig, policy
        self.robot = next(iter(rig.robots.values())) if robot is None else robot
        self._rate, self._seconds = rate_hz, seconds
        self._deadman, self._unattended = deadman, unattended
        self._cameras, self._history = cameras, history
        self._success, self._mark = success, mark

    def rehearse(self) -> None:
        """Ask once, before anything moves, and throw the answer away: the first call is mostly the slowest.

        What is wrong with the policy then shows before the first episode: whatever it raises is raised.
        """
        self._reset(None)
        command, _ = _parts(self.policy(self._observe()))
        if command is not None and not isinstance(command, Command):
            raise CommandError(f"the policy answers with a {type(command).__name__}, which is no command")

    def run(self, seed: int | None = None, on_turn: Callable[[float], None] = lambda seconds: None) -> Outcome:
        """One episode, from where the arm is. ``on_turn(seconds)`` is called in each turn, also in pauses.

        What the policy raises, and what stops the arm, ends the episode and is told in the outcome. The arm is at rest
        then. Ctrl-C, and what is wrong with the session itself, is raised.
        """
        self._reset(seed)
        self.rig.forget_observations()
        tally = _Tally(judged=self._success is not None)
        control = self.robot.control(deadman=self._deadman, rate_hz=self._rate, unattended=self._unattended)
        try:
            with control:
                self._drive(control, tally, on_turn)
        except (MotionStopped, RobotFault, ConnectionLost, StaleStateError) as stop:
            tally.end("stopped", getattr(stop, "reason", str(stop)))
        except _PolicyError as wrong:
            error = wrong.__cause__
            tally.end("error", f"{type(error).__name__}: {error}", error)
        return tally.outcome()

    def _reset(self, seed: int | None) -> None:
        reset = getattr(self.policy, "reset", None)
        if callable(reset):
            reset(seed)

    def _observe(self) -> Observation:
        return self.rig.observe(history=self._history, cameras=self._cameras)

    def _drive(self, control: Control, tally: _Tally, on_turn: Callable[[float], None]) -> None:
        seen, begun = -np.inf, False
        for tick in self.rig.clock.rate(self._rate):
            on_turn(tally.seconds)
            mark = self._mark() if self._mark is not None else None
            if mark is not None:
                return tally.end("success" if mark else "failure")
            if not follows(control):
                tally.pause()
                begun = False
                continue
            tally.turn(tick.dt, tick.missed)
            if tally.seconds > self._seconds - 1e-9:
                return tally.end("time")
            observation = self._observe()
            tally.repeated += observation.t <= seen
            seen = observation.t
            if self._success is not None and self._success(self.rig, observation):
                return tally.end("success")
            if not begun:
                wait_here(control, FIRST_ANSWER)
            command, grip = self._answer(observation, tally)
            with _blamed(CommandError):
                self._send(control, command, grip, first=not begun)
            begun = begun or command is not None
        return None

    def _send(self, control: Control, command: Command | None, grip: float | None, first: bool) -> None:
        if command is None and grip is None:
            return
        if command is not None and first:  # a first target that is far away is refused, as anybody's is
            checks, now = CommandChecks(self.robot), self.rig.clock.now()
            checks.check_first(checks.checked(command, now, []), now, self.robot.state().q_set.tolist())
        control.send(command, grip=grip)

    def _answer(self, observation: Observation, tally: _Tally) -> tuple[Command | None, float | None]:
        start = time.perf_counter()
        with _blamed(Exception):
            answer = _parts(self.policy(observation))
        tally.inference.add(time.perf_counter() - start)
        return answer


class _PolicyError(Exception):
    """The policy raised what is the cause of this."""


@contextlib.contextmanager
def _blamed(kind: type[Exception]) -> Iterator[None]:
    try:
        yield
    except kind as error:
        raise _PolicyError from error


class _Tally:
    """Counts while an episode lasts."""

    def __init__(self, judged: bool) -> None:
        self._judged = judged
        self.seconds = 0.0
        self.repeated = 0
        self.inference = Histogram(1e-4, 20_000)
        self._missed = self._pauses = 0
        self._driving = False
        self._ended, self._reason = "time", ""
        self._error: BaseException | None = None

    def turn(self, dt: float, missed: int) -> None:
        if self._driving:
            self._missed += missed
            self.seconds += dt
        self._driving = True

    def pause(self) -> None:
        self._pauses += self._driving
        self._driving = False

    def end(self, ended: str, reason: str = "", error: BaseException | None = None) -> None:
        self._ended, self._reason, self._error = ended, reason, error

    def outcome(self) -> Outcome:
        marks = {"success": True, "failure": False, "error": False, "time": False if self._judged else None}
        return Outcome(
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


def _parts(answer: Any) -> tuple[Command | None, float | None]:
    """A policy's answer, taken apart. CommandError for what cannot be one."""
    if not isinstance(answer, tuple):
        return answer, None
    if len(answer) != 2:
        raise CommandError(f"a policy answers with a command, or with (command, grip), not with {len(answer)} things")
    command, grip = answer
    return command, None if grip is None else float(np.clip(grip, 0.0, 1.0))
