"""Episode after episode: things go back to where they start, a person drives, and what happens is kept or forgotten."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from hal.apps._common import ACTION_NEEDED
from hal.apps.driving import Beginning, Driving
from hal.errors import HalError
from hal.learning.episode import stands_in_world
from hal.views import ACTIONS

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.gamepad import Gamepad
    from hal.observation import Observation
    from hal.recording import Recorder, RecorderStatus
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.types import PadState

__all__ = [
    "DemonstrationSession",
    "Kept",
    "Prompts",
    "Tape",
    "called",
    "lifts_cube",
    "seed_of",
    "summary",
]

# [taping.py] A recorder for a program whose loop must not wait.

T = TypeVar("T")


class Tape:
    """What takes long is done one after the other in a thread of its own; in lock-step at once, as time stands still.

    :meth:`start` and :meth:`discard` come back with a future, which has the error where there was one.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self._at_once = recorder.rig.lock_step
        self._thread = ThreadPoolExecutor(1, "hal-tape")

    def start(self, seed: int, info: Mapping[str, Any]) -> Future[None]:
        """Begin an episode, once the last one is saved."""
        return self._do(lambda: self.recorder.start(seed=seed, info=info))

    def save(self, success: bool | None) -> Future[RecorderStatus]:
        """End it now, and keep it; how many rows it has is known when that is done, later in any case.

        Raises CommandError where none is being recorded.
        """
        self.recorder.save(success)
        return self._thread.submit(self._saved)

    def _saved(self) -> RecorderStatus:
        self.recorder.wait_saved()
        return self.recorder.status()

    def discard(self) -> Future[None]:
        """Forget it."""
        return self._do(self.recorder.discard)

    def _do(self, what: Callable[[], T]) -> Future[T]:
        if not self._at_once:
            return self._thread.submit(what)
        done: Future[T] = Future()
        try:
            done.set_result(what())
        except Exception as error:
            done.set_exception(error)
        return done

    def keep(self) -> Future[RecorderStatus] | None:
        """End what is still being recorded and keep it, unmarked; None where nothing is."""
        self._do(lambda: None).result()  # a start that was under way is over
        return self.save(None) if self.recorder.status().state == "recording" else None

    def close(self) -> None:
        """Wait for all of that. May be called again where that was interrupted."""
        self._thread.shutdown()
        self.recorder.close()


# [prompts.py] What a person who collects demonstrations is told to do, in the words of what they drive with.

SONY = {"south": "Cross", "east": "Circle", "west": "Square", "north": "Triangle", "home": "PS"}


class Prompts:
    """One line for each moment."""

    def __init__(self, rig: Rig, robot: Robot, drives_home: bool) -> None:
        """``drives_home``: is the arm one that drives to where an episode starts, and nobody puts things back?"""
        self._by_page = rig.console is not None and rig.console.driven_by is None
        self._has_page = rig.console is not None
        self._drives_home = drives_home
        self._has_gripper = robot.gripper is not None

    def now(self, phase: str, actions: tuple[str, ...], mapping: TeleopMapping) -> str:
        """What a person should do in this phase, in which ``actions`` are possible; nothing where they only wait."""
        if phase == "resetting":
            then = "; then its gripper opens" if self._has_gripper else ""
            return f"let go of {mapping.deadman}, then hold it until the arm is home{then}" if self._drives_home else ""
        place = "put everything where it starts; " if self._drives_home and phase == "ready" else ""
        return f"{place}{self.buttons(actions, mapping, phase)}" if actions else ""

    def buttons(self, actions: Collection[str], mapping: TeleopMapping, phase: str = "recording") -> str:
        """What these actions are done with."""
        if self._by_page:
            shuffle = '; "Discard" shuffles the objects' if phase == "ready" and "discard" in actions else ""
            return f"press Record{shuffle}" if "record" in actions else ""  # the other buttons say what they do
        words = {
            "record": "starts the recording",
            "finish": "saves it as a success",
            "fail": "saves it as a failure",
            "discard": "puts things elsewhere"
            if phase == "ready"
            else f"forgets it, once {mapping.deadman} is let go of",
        }
        names = {action: called(button) for action, button in mapping.actions.items()}
        told = [f"{names[action]} {words[action]}" for action in actions if action in names]
        return ", ".join(told) or ("the page has the buttons" if self._has_page else "this pad has no buttons for it")


def called(button: str) -> str:
    """A button's name, with that on the tutorial's pad."""
    return f"{button} ({SONY[button]})" if button in SONY else button


# [collected.py] What a run of ``apps/collect.py`` has collected.


@dataclass(frozen=True, slots=True)
class Kept:
    """An episode that is being saved, or is."""

    number: int
    seed: int
    success: bool | None
    """None where nobody said: the run ended while it was recorded."""
    status: Future[RecorderStatus]
    """The recorder's, once it is saved."""

    @property
    def failure(self) -> str:
        """Why it could not be saved; nothing as long as that is not so."""
        return str(self.status.exception()) if self.status.done() and self.status.exception() is not None else ""

    def as_json(self) -> dict[str, Any]:
        """For a report, once it is saved or failed."""
        said = {"number": self.number, "seed": self.seed, "success": self.success, "failure": self.failure}
        return said if self.failure else said | self.status.result()._asdict()


def summary(kept: Sequence[Kept], root: Path, discarded: int, ended: str) -> Iterator[str]:
    """How it went, for people, when everything is saved or failed; ``ended`` is why it ended early."""
    saved = [one for one in kept if not one.failure]
    for one in kept:
        if one.failure:
            yield f"NOT SAVED: episode {one.number}: {one.failure}"
    if ended:
        yield f"ended: {ended}"
    found = [one.status.result() for one in saved]
    rows, seconds = sum(status.frames for status in found), sum(status.seconds for status in found)
    dropped, marks = sum(status.dropped for status in found), [one.success for one in saved]
    unmarked = f", {marks.count(None)} not marked" if None in marks else ""
    yield (
        f"{len(saved)} episode(s) saved in {root}: {rows} rows, {seconds:.1f} s, {dropped} dropped; "
        f"{marks.count(True)} succeeded, {marks.count(False)} failed{unmarked}, {discarded} forgotten"
    )
    if saved:
        yield f"look at them: hal-review {root}"


Judge = Callable[["Rig", "Observation"], bool]

TOO_FEW = 1
"""Exit status."""
SHOW = 0.2
"""s between two looks at the recorder."""
ALLOWED = {"ready": ("record", "discard"), "recording": ("finish", "fail", "discard")}
"""What may be pressed when."""
LIFTED = 0.04
"""m."""
JUDGE_TIMEOUT = 0.05
"""s; the arm is being driven while a picture is waited for."""
SAVED, DISCARDED, ANEW = "saved", "discarded", "anew"
"""Why a try ended, where another one follows."""


class DemonstrationSession:
    """One run of ``apps/collect.py``."""

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        pad: Gamepad,
        recorder: Recorder,
        args: argparse.Namespace,
        judge: Judge | None = None,
    ) -> None:
        """``judge(rig, observation)`` is called when a person saves an episode as a success, and may deny it."""
        self.rig, self.robot, self.pad, self.recorder, self.args = rig, robot, pad, recorder, args
        self._judge = judge
        self.driving = Driving(rig, robot, pad, mapping=args.mapping, speed=args.speed or 1.0, actions=ACTIONS)
        self.tape = Tape(recorder)
        self.phase = ""
        self.kept: list[Kept] = []
        self.discarded = 0
        self._first = recorder.episodes
        self._beginning = Beginning(self.driving)
        self._draws = 0
        """How often other places were wanted for the things of this episode."""
        self._seed = 0
        """Of the episode that is being recorded."""
        self._began = 0.0
        """When the recording was asked for, in s since the report's start."""
        self._starting: Future[None] | None = None
        self._discarding: Future[None] | None = None
        self._notes = len(recorder.notes)
        """So many of the recorder's were told."""
        self._trouble = ""
        """The recorder's, as far as a person was told."""
        self._asked: SimpleQueue[str] = SimpleQueue()
        """What pages ask for."""
        self._next_look = 0.0
        self._warned = False
        """Does a person who drives know that nothing is recorded yet?"""
        self._prompts = Prompts(rig, robot, self._beginning.drives_home)
        if rig.console is not None:
            rig.console.on_action(self._asked.put)

    def run(self) -> int:
        """All episodes, or until Ctrl-C or the end of a recorded pad; then everything is saved, and told."""
        from hal.apps._common import invitation

        ended, failed = "", False
        self._check_buttons()
        buttons = self._prompts.buttons(ACTIONS, self.driving.teleop.mapping)
        print(f"{self.driving.help()}\n  record: {buttons}\n{invitation(self.rig)}", flush=True)
        try:
            while not ended and len(self.kept) < self.args.episodes:
                ended = self._episode()
        except KeyboardInterrupt:
            ended = "interrupted"  # the session's end brought the arm to rest
        except (HalError, OSError) as error:  # such as the end of the arm's process
            ended, failed = f"{type(error).__name__}: {error}", True
        self._enter("saving")
        self._keep_all()
        self._enter("done")
        few = self._tell(ended) < self.args.episodes
        return ACTION_NEEDED if failed else TOO_FEW if few else 0

    def _keep_all(self) -> None:
        """Everything to disk. One Ctrl-C meanwhile is answered, the next one gives up."""
        for last in (False, True):
            try:
                if (rest := self.tape.keep()) is not None:
                    self.driving.event(f"episode {self.number} was being recorded: it is kept, unmarked")
                    self.kept.append(Kept(self.number, self._seed, None, rest))
                self.tape.close()
                return
            except KeyboardInterrupt:
                if last:
                    raise
                self.driving.event("saving; Ctrl-C once more gives up")

    # One episode.

    @property
    def number(self) -> int:
        """Of the present episode, in the dataset."""
        return self._first + len(self.kept)

    @property
    def seed(self) -> int:
        """Of where its things start."""
        return seed_of(self.args.seed, self.number, self._draws)

    def _episode(self) -> str:
        """One try. Why no other one should follow, or nothing."""
        self._enter("resetting")
        if not self._beginning.put_back(self.seed, self._goes_on):
            return self._over()
        self._enter("ready")
        reason = self.driving.drive(self._look)
        if reason == SAVED:
            self._draws = 0
        elif reason == ANEW:
            self._draws += 1
        elif reason == DISCARDED:
            self.discarded += 1
            self.driving.event(f"episode {self.number}: forgotten")
        else:
            return reason
        return ""

    def _goes_on(self) -> bool:
        """While nobody holds the dead-man: has it sense to wait?"""
        self._show()
        return not self._over()

    def _look(self, state: PadState) -> str:
        """What the pad, the pages and the recorder say; why this try ends, or nothing."""
        self._look_at_tape()
        for action in self._wishes(state):
            if action in self._allowed and (reason := self._act(action)):
                return reason
        if self.phase == "ready" and self.driving.deadman.held and not self._warned:
            self._warned = True
            self.driving.event(f"not recording yet: {self._prompts.buttons(('record',), self.driving.teleop.mapping)}")
        if self.rig.clock.now() >= self._next_look:
            self._show()
        return self._over()

    def _look_at_tape(self) -> None:
        """Has the recording begun that was asked for, and was the one forgotten that should be?"""
        if self._discarding is not None and self._discarding.done():
            failure, self._discarding = self._discarding.exception(), None
            if failure is not None:
                self.driving.event(f"NOT FORGOTTEN: {failure}")
        if self._starting is None or not self._starting.done():
            return
        failure, self._starting = self._starting.exception(), None
        for note in self.recorder.notes[self._notes :]:
            self.driving.event(f"note: {note}")
        self._notes = len(self.recorder.notes)
        if failure is not None:
            self.driving.event(f"NOT RECORDING: {failure}")
            self._enter("ready")
        else:
            self._first = self.recorder.status().episode - len(self.kept)
            self._enter("recording")

    @property
    def _allowed(self) -> tuple[str, ...]:
        """What may be pressed now."""
        return ALLOWED.get(self.phase, ()) if self._starting is None else ()

    def _wishes(self, state: PadState) -> list[str]:
        pressed = self.driving.teleop.pressed(state)
        if "discard" in pressed and self.phase == "recording" and self.driving.deadman.held:
            pressed -= {"discard"}  # a slip of the thumb while driving
            self.driving.event(f"to forget the episode, let go of {self.driving.teleop.mapping.deadman} first")
        found = [action for action in ACTIONS if action in pressed]
        try:
            while True:
                found.append(self._asked.get_nowait())
        except Empty:
            return found

    def _act(self, action: str) -> str:
        """Do what is wished for; why this try ends with that, or nothing."""
        if action == "record":
            what = {"program": "collect", "robot": self.robot.name, "mapping": self.driving.mapping}
            self._seed = self.seed
            self._began = self.rig.clock.now() - self.driving.report.start
            self._starting = self.tape.start(self._seed, what | {"speed": self.args.speed or 1.0})
            self._look_at_tape()
            return ""
        if action == "discard" and self.phase == "ready":
            return ANEW
        if action == "discard":
            self._discarding = self.tape.discard()
            return DISCARDED
        success, seconds = self._mark(action), self.recorder.status().seconds
        self.kept.append(Kept(self.number, self._seed, success, self.tape.save(success)))
        if self.rig.lock_step:
            wait([self.kept[-1].status])  # time stands still
        mark = {True: "a success", False: "a failure", None: "not marked"}[success]
        number, count = self.kept[-1].number, len(self.kept)
        self.driving.event(f"episode {number}: {seconds:.1f} s, {mark}; {count} of {self.args.episodes} in this run")
        return SAVED

    def _mark(self, action: str) -> bool | None:
        """Return how an episode is marked that a person saves; None where the judge fails."""
        if action != "finish" or self._judge is None:
            return action == "finish"
        try:
            agrees = bool(self._judge(self.rig, self.rig.observe(timeout=JUDGE_TIMEOUT)))
        except Exception as error:  # a function of the user's
            judge = "--success" if self.args.success else "the check of the recorded demonstration"
            self.driving.event(f"{judge} raised {type(error).__name__}: {error}; the episode is saved unmarked")
            return None
        if not agrees:
            self.driving.event("; ".join(self._denied()))
        return agrees

    def _denied(self) -> Iterator[str]:
        """Yield why an episode that was saved as a success is a failure."""
        if self.args.success:
            yield "--success says that it is no success"
        else:
            yield "the cube was not lifted (checked because a recorded demonstration drives)"
        report = self.driving.report
        if any(one["t_s"] >= self._began for one in (*report.trips, *report.faults)):
            yield "the arm was stopped in this episode"
            if not self.args.success and not self.rig.lock_step:
                yield "on a busy computer, add --set simulation.clock=lock_step, which does not depend on its speed"

    def _over(self) -> str:
        """Why the run should end, or nothing."""
        failed = next(
            (f"episode {one.number} could not be saved: {one.failure}" for one in self.kept if one.failure), ""
        )
        return failed or (f"{self.pad.describe()} was played to its end" if self.pad.finished else "")

    # What a person sees.

    def _enter(self, phase: str) -> None:
        if phase == "ready" and self.phase == "resetting":
            self._wishes(self.pad.state())  # what was pressed before counts no more
        self.phase = phase
        self._warned = self._warned and phase != "resetting"
        if (prompt := self._prompt) or phase == "recording":
            doing = "RECORDING" if phase == "recording" else phase
            self.driving.event(f"episode {self.number}: {doing}{prompt and f'; {prompt}'}")
        self._show()

    def _show(self) -> None:
        """The recording on the pages and in the live line; what is new about it is told."""
        self._next_look = self.rig.clock.now() + SHOW
        status = self.recorder.status()
        if status.trouble != self._trouble:
            self._trouble = status.trouble
            self.driving.event(f"RECORDING: {status.trouble or 'all is well again'}")
        lost = f", {status.dropped} DROPPED" if status.dropped else ""
        doing = f"REC {status.seconds:.1f} s{lost}" if self.phase == "recording" else self.phase
        self.driving.note = f"{len(self.kept)} of {self.args.episodes}  {doing}  "
        self._show_pages(status if self.phase == "recording" else status._replace(seconds=0.0, frames=0, dropped=0))

    @property
    def _prompt(self) -> str:
        """What a person should do now, or nothing."""
        if self._starting is not None:
            return "starting"
        return self._prompts.now(self.phase, self._allowed, self.driving.teleop.mapping)

    def _show_pages(self, status: RecorderStatus) -> None:
        if self.rig.console is None:
            return
        from hal.views import RecordingView

        succeeded = sum(one.success is True for one in self.kept)
        self.rig.console.show_recording(
            RecordingView(
                phase=self.phase,
                prompt=self._prompt,
                task=self.args.task,
                episode=self.number,
                saved=len(self.kept),
                wanted=self.args.episodes,
                succeeded=succeeded,
                failed=sum(one.success is False for one in self.kept),
                discarded=self.discarded,
                seconds=status.seconds,
                frames=status.frames,
                dropped=status.dropped,
                free_bytes=status.free_bytes,
                trouble=status.trouble,
                actions=self._allowed,
            )
        )

    def _check_buttons(self) -> None:
        """CommandError where nobody could start a recording, or end it."""
        from hal.errors import CommandError

        missing = [action for action in ("record", "finish") if action not in self.driving.teleop.mapping.actions]
        if missing and self.rig.console is None:
            raise CommandError(
                f"the mapping {self.driving.mapping} has no button for {' and '.join(missing)}: give it some, for "
                "example 'actions: {record: south, finish: home}', or add --console, whose page has buttons for that"
            )

    # The end.

    def _tell(self, ended: str) -> int:
        """How it went. Everything is saved by now; returns how many episodes are."""
        for text in summary(self.kept, self.recorder.root, self.discarded, ended):
            self.driving.line.event(text)
        if self.args.report:
            report = {
                "out": str(self.recorder.root),
                "robot": self.robot.name,
                "backend": self.robot.spec.driver,
                "clock": self.rig.plan.clock,
                "ended": ended,
                "discarded": self.discarded,
                "trips": self.driving.report.trips,
                "faults": self.driving.report.faults,
                "episodes": [one.as_json() for one in self.kept],
            }
            Path(self.args.report).write_text(json.dumps(report, indent=2) + "\n")
        return sum(not one.failure for one in self.kept)


def lifts_cube(rig: Rig, robot: Robot) -> Judge | None:
    """Return what judges the recorded demonstrations: whether the cube is 4 cm higher than where it starts.

    None where the arm is not simulated or the world has no cube.
    """
    cubes = [body for body in rig.plan.world.bodies if body.name == "cube"] if rig.plan.world is not None else []
    if not cubes or not stands_in_world(rig, robot):
        return None
    height = cubes[0].position[2] + LIFTED
    return lambda rig, observation: bool(rig.world.pose("cube").position[2] > height)


def seed_of(base: int, number: int, draws: int = 0) -> int:
    """An episode's seed: the same for the same number, whenever that is recorded; another one for every other draw."""
    import numpy as np

    return int(np.random.SeedSequence([base, number, draws]).generate_state(1)[0])
