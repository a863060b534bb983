"""The run of ``apps/collect.py``: episode after episode is reset, driven, recorded, and saved or discarded."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from hal.apps._common import ACTION_NEEDED, write_report
from hal.apps._display import TeleopDisplay, list_links
from hal.errors import CommandError, HalError
from hal.learning.episode import stands_in_world
from hal.views import ACTIONS, RecordingView

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.observation import Observation
    from hal.recording import Recorder, RecorderStatus
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.types import PadState

TOO_FEW = 1
"""Exit status if fewer episodes were saved than asked for."""
SHOW_PERIOD = 0.2
"""s between two updates of the recording's state on the pages and in the live line."""
ALLOWED = {"ready": ("record", "discard"), "recording": ("finish", "fail", "discard")}
"""Phase -> actions that are possible in it."""
LIFTED = 0.04
"""Height above its start at which the cube counts as lifted, m."""
JUDGE_TIMEOUT = 0.05
"""Longest wait for a camera frame before a success is confirmed, s; the arm is being driven meanwhile."""
SAVED, DISCARDED, SHUFFLED = "saved", "discarded", "shuffled"
"""Why an attempt ended, if another one follows."""

T = TypeVar("T")
Judge = Callable[["Rig", "Observation"], bool]


class CollectRun:
    """One run of the program on an open rig."""

    def __init__(
        self,
        rig: Rig,
        robots: Sequence[Robot],
        recorder: Recorder,
        args: argparse.Namespace,
        judge: Judge | None = None,
    ) -> None:
        """Prepare a run.

        Args:
            rig: Open rig.
            robots: Arms to drive.
            recorder: Open recorder.
            args: Options of ``collect``.
            judge: Called with the rig and an observation when an episode is saved as a success; False saves it as a
                failure.
        """
        self.rig, self.robots, self.recorder, self.args = rig, tuple(robots), recorder, args
        self._judge = judge
        self.display = TeleopDisplay(
            rig,
            robots,
            independent=args.independent,
            mapping=args.mapping,
            speed=args.speed or 1.0,
            actions=ACTIONS,
        )
        self.session = self.display.session
        self.pad = self.session.pad
        self._calls = ThreadPoolExecutor(1, "hal-recorder")
        recorder.source = lambda: "person"
        self.phase = ""
        self.kept: list[SavedEpisode] = []
        self.discarded = 0
        self._first = recorder.episodes
        self._draws = 0
        """How often the objects of this episode were shuffled."""
        self._seed = 0
        """Seed of the episode that is being recorded."""
        self._record_time = 0.0
        """When the recording was started, in s since the report's start."""
        self._starting: Future[None] | None = None
        self._discarding: Future[None] | None = None
        self._notes = len(recorder.notes)
        """Number of the recorder's notes that were printed."""
        self._trouble = ""
        """The recorder's trouble, as printed."""
        self._page_actions: SimpleQueue[str] = SimpleQueue()
        """Actions from pages of the console."""
        self._next_show = 0.0
        self._warned = False
        """Whether the user was warned that the present motion is not recorded."""
        if rig.console is not None:
            rig.console.on_action(self._page_actions.put)

    def run(self) -> int:
        """Collect all episodes, or until Ctrl-C or the end of a recorded pad; then save. Return the exit status."""
        ended, failed = "", False
        self._check_buttons()
        print(f"{self.session.help()}\n  record: {self._buttons(ACTIONS)}\n{list_links(self.rig)}", flush=True)
        try:
            while not ended and self._marked < self.args.episodes:
                ended = self._attempt()
        except KeyboardInterrupt:
            ended = "interrupted"  # the arm is at rest
        except (HalError, OSError) as error:  # such as the end of the arm's process
            ended, failed = f"{type(error).__name__}: {error}", True
        self._enter("saving")
        self._save_all()
        self._enter("done")
        few = self._report(ended) < self.args.episodes
        return ACTION_NEEDED if failed else TOO_FEW if few else 0

    def _check_buttons(self) -> None:
        """Raise CommandError if recordings cannot be started or ended."""
        mapping = self.session.teleop.mapping
        missing = [action for action in ("record", "finish") if action not in mapping.actions]
        if missing and self.rig.console is None:
            raise CommandError(
                f"the mapping {self.session.mapping} has no button for {' and '.join(missing)}: add for example "
                "'actions: {record: south, finish: home}', or use --console, whose page has buttons for them",
                code="no_record_button",
            )

    def _save_all(self) -> None:
        """Write everything to disk. The first Ctrl-C meanwhile prints a message, the second one aborts."""
        for last in (False, True):
            try:
                wait([call for call in (self._starting, self._discarding) if call is not None])
                if self.recorder.status().state in ("recording", "ended"):
                    self.session.announce(f"episode {self.number} was being recorded: saved, unmarked")
                    self.kept.append(SavedEpisode(self.number, self._seed, None, self._save(None)))
                self._calls.shutdown()
                self.recorder.close()
                return
            except KeyboardInterrupt:
                if last:
                    raise
                self.session.announce("saving; press Ctrl-C again to abort")

    def _call(self, function: Callable[[], T]) -> Future[T]:
        """Call a slow function of the recorder in a thread, one after the other; at once where simulated time stands.

        The future holds its error, if there is one.
        """
        if not self.rig.lock_step:
            return self._calls.submit(function)
        done: Future[T] = Future()
        try:
            done.set_result(function())
        except Exception as error:
            done.set_exception(error)
        return done

    def _save(self, success: bool | None) -> Future[RecorderStatus]:
        """End the episode now; return the recorder's status when it is saved, which is later, also in lock-step."""
        self.recorder.save(success)
        return self._calls.submit(self._saved_status)

    def _saved_status(self) -> RecorderStatus:
        self.recorder.wait_saved()
        return self.recorder.status()

    # One episode.

    @property
    def number(self) -> int:
        """Number of the present episode in the dataset."""
        return self._first + len(self.kept)

    @property
    def seed(self) -> int:
        """Seed of the present episode's object poses."""
        return episode_seed(self.args.seed, self.number, self._draws)

    def _attempt(self) -> str:
        """Reset, drive and record once. Return why the run has to end, or nothing."""
        self._enter("resetting")
        if not self.session.reset_scene(self.seed, self._keep_waiting):
            return self._end_reason()
        self._enter("ready")
        reason = self.session.run(self._update)
        if reason == SAVED:
            self._draws = 0
        elif reason == SHUFFLED:
            self._draws += 1
        elif reason == DISCARDED:
            self.discarded += 1
            self.session.announce(f"episode {self.number}: discarded")
        else:
            return reason
        return ""

    def _keep_waiting(self) -> bool:
        self._show()
        return not self._end_reason()

    def _update(self, state: PadState) -> str:
        """Handle the recorder's results and all actions; return why this attempt ends, or nothing."""
        self._check_tape()
        for action in self._new_actions(state):
            if action in self._allowed and (reason := self._perform(action)):
                return reason
        if self.phase == "ready" and self.session.held and not self._warned:
            self._warned = True
            self.session.announce(f"not recording yet: {self._buttons(('record',))}")
        if self.rig.clock.now() >= self._next_show:
            self._show()
        return self._end_reason()

    def _check_tape(self) -> None:
        """Handle a start or a discard that is complete."""
        if self._discarding is not None and self._discarding.done():
            failure, self._discarding = self._discarding.exception(), None
            if failure is not None:
                self.session.announce(f"NOT DISCARDED: {failure}")
        if self._starting is None or not self._starting.done():
            return
        failure, self._starting = self._starting.exception(), None
        for note in self.recorder.notes[self._notes :]:
            self.session.announce(f"note: {note}")
        self._notes = len(self.recorder.notes)
        if failure is not None:
            self.session.announce(f"NOT RECORDING: {failure}")
            self._enter("ready")
        else:
            self._first = self.recorder.status().episode - len(self.kept)
            self._enter("recording")

    @property
    def _allowed(self) -> tuple[str, ...]:
        """Actions that are possible now."""
        return ALLOWED.get(self.phase, ()) if self._starting is None else ()

    def _new_actions(self, state: PadState) -> list[str]:
        """Return the actions of the pad's buttons and of the pages since the last call."""
        pressed = self.session.teleop.pressed(state)
        if "discard" in pressed and self.phase == "recording" and self.session.held:
            pressed -= {"discard"}  # pressed by accident while driving
            self.session.announce(f"to discard the episode, release {self.session.deadman_name} first")
        found = [action for action in ACTIONS if action in pressed]
        try:
            while True:
                found.append(self._page_actions.get_nowait())
        except Empty:
            return found

    def _perform(self, action: str) -> str:
        """Perform an action; return why this attempt ends, or nothing."""
        if action == "record":
            info = {"program": "collect", "robot": self._names, "mapping": self.session.mapping}
            self._seed = self.seed
            self._record_time = self.rig.clock.now() - self.display.report.start
            start = partial(self.recorder.start, seed=self._seed, info=info | {"speed": self.args.speed or 1.0})
            self._starting = self._call(start)
            self._check_tape()
            return ""
        if action == "discard" and self.phase == "ready":
            return SHUFFLED
        if action == "discard":
            self._discarding = self._call(self.recorder.discard)
            return DISCARDED
        success, status = self._mark(action), self.recorder.status()
        self.kept.append(SavedEpisode(self.number, self._seed, success, self._save(success)))
        if self.rig.lock_step:
            wait([self.kept[-1].status])  # simulated time stands still meanwhile
        mark = {True: "success", False: "failure", None: "not marked"}[success]
        text = f"episode {self.kept[-1].number}: {status.seconds:.1f} s{_describe_loss(status)}, {mark}"
        self.session.announce(f"{text}; {self._marked} of {self.args.episodes} in this run")
        return SAVED

    def _mark(self, action: str) -> bool | None:
        """Return the mark of an episode that is saved with this action; None if its recording or the judge fails."""
        if action == "finish" and self._has_ended:
            hint = f"hal dataset mark {self.recorder.root} {self.number} success"
            self.session.announce(f"the recording ended before you saved it: not marked a success; else: {hint}")
            return None
        if action != "finish" or self._judge is None:
            return action == "finish"
        try:
            agrees = bool(self._judge(self.rig, self.rig.observe(timeout=JUDGE_TIMEOUT)))
        except Exception as error:  # a function of the user's
            judge = "--success" if self.args.success else "the check of the recorded demonstration"
            self.session.announce(f"{judge} raised {type(error).__name__}: {error}; the episode is saved unmarked")
            return None
        if not agrees:
            self.session.announce("; ".join(self._denial()))
        return agrees

    def _denial(self) -> Iterator[str]:
        """Yield why an episode that was saved as a success is a failure."""
        if self.args.success:
            yield "--success returned False: saved as a failure"
        else:
            yield "the cube was not lifted (checked because a recorded demonstration drives)"
        report = self.display.report
        if any(one["t_s"] >= self._record_time for one in (*report.trips, *report.faults)):
            yield "the arm was stopped in this episode"
            if not self.args.success and not self.rig.lock_step:
                yield "on a busy computer, add --set simulation.clock=lock_step, which does not depend on its speed"

    def _end_reason(self) -> str:
        """Return why the run has to end, or nothing."""
        for one in self.kept:
            if one.failure:
                return f"episode {one.number} could not be saved: {one.failure}"
        return "the recorded pad has ended" if self.session.finished else ""

    @property
    def _has_ended(self) -> bool:
        """Whether the recorder ended the open episode by itself: what is driven now is not recorded."""
        return self.recorder.status().state == "ended"

    @property
    def _marked(self) -> int:
        """Number of episodes of this run that count: saved as successes or failures."""
        return sum(one.success is not None and not one.failure for one in self.kept)

    @property
    def _names(self) -> str:
        return ",".join(robot.name for robot in self.robots)

    # Prompts, the live line and the console.

    def _enter(self, phase: str) -> None:
        """Enter a phase and print the prompt for it."""
        if phase == "ready" and self.phase == "resetting":
            self._new_actions(self.pad.state())  # presses before the reset do not count
        self.phase = phase
        self._warned = self._warned and phase != "resetting"
        prompt = self._prompt()
        if prompt or phase == "recording":
            doing = "RECORDING" if phase == "recording" else phase
            self.session.announce(f"episode {self.number}: {doing}{prompt and f'; {prompt}'}")
        self._show()

    def _prompt(self) -> str:
        """Return what the user can or must do now, in one line; empty if they only wait."""
        session = self.session
        if self._starting is not None:
            return "starting"
        if self.phase == "resetting":
            then = "; then its gripper opens" if self.robots[0].gripper is not None else ""
            each = "" if len(self.robots) == 1 else f", for each of {self._names}"
            home = f"release {session.deadman_name}, then hold it until the arm is home{then}{each}"
            return home if session.drives_home else ""
        if not self._allowed:
            return ""
        real = session.drives_home and not self.rig.has_world
        place = "place the objects; " if real and self.phase == "ready" else ""
        return f"{place}{self._buttons(self._allowed)}"

    def _buttons(self, actions: Collection[str]) -> str:
        """Return the buttons for these actions."""
        page = self.rig.console is not None
        ready = self.phase == "ready"
        if self.rig.console is not None and self.rig.console.driven_by is None:
            shuffle = '; "Discard" shuffles the objects' if ready and "discard" in actions else ""
            return f"press Record{shuffle}" if "record" in actions else ""  # the other buttons are labelled
        again = "reset again" if self.session.drives_home else "shuffle the objects"
        words = {
            "record": "start recording",
            "finish": "save, not marked" if self._has_ended else "save as success",
            "fail": "save as failure",
            "discard": again if ready else f"discard (release {self.session.deadman_name} first)",
        }
        mapping: TeleopMapping = self.session.teleop.mapping
        parts = [
            f"{self.pad.control_name(mapping.actions[action])}: {words[action]}"
            for action in actions
            if action in mapping.actions
        ]
        return ", ".join(parts) or ("use the buttons of the page" if page else "this pad has no button for it")

    def _show(self) -> None:
        """Update the live line and the console, and print new trouble of the recorder."""
        self._next_show = self.rig.clock.now() + SHOW_PERIOD
        status = self.recorder.status()
        if status.trouble != self._trouble:
            self._trouble = status.trouble
            self.session.announce(f"RECORDING: {status.trouble or 'no more trouble'}")
            if status.state == "ended":
                text = f"RECORDING ENDED after {status.seconds:.1f} s: nothing more is recorded"
                self.session.announce(f"episode {self.number}: {text}; {self._prompt() or 'save or discard it'}")
        doing = "ENDED" if status.state == "ended" else "REC"
        doing = f"{doing} {status.seconds:.1f} s{_describe_loss(status)}" if self.phase == "recording" else self.phase
        self.display.note = f"{self._marked} of {self.args.episodes}  {doing}  "
        if self.rig.console is not None:
            recording = self.phase == "recording"
            shown = status if recording else status._replace(seconds=0.0, frames=0, dropped=0)
            self.rig.console.show_recording(self._view(shown))

    def _view(self, status: RecorderStatus) -> RecordingView:
        return RecordingView(
            phase=self.phase,
            prompt=self._prompt(),
            task=self.args.task,
            episode=self.number,
            saved=self._marked,
            wanted=self.args.episodes,
            succeeded=sum(one.success is True for one in self.kept),
            failed=sum(one.success is False for one in self.kept),
            discarded=self.discarded,
            seconds=status.seconds,
            frames=status.frames,
            dropped=status.dropped,
            free_bytes=status.free_bytes,
            trouble=status.trouble,
            actions=self._allowed,
        )

    # The end.

    def _report(self, ended: str) -> int:
        """Print the results and write ``--report``, once everything is saved; return the number of marked episodes."""
        for text in _summary(self.kept, self.recorder.root, self.discarded, ended):
            self.display.line.event(text)
        report = {
            "out": str(self.recorder.root),
            "robot": self._names,
            "backend": self.robots[0].spec.driver,
            "clock": self.rig.plan.clock,
            "ended": ended,
            "discarded": self.discarded,
            "trips": self.display.report.trips,
            "faults": self.display.report.faults,
            "episodes": [one.as_json() for one in self.kept],
        }
        write_report(self.args.report, report)
        return self._marked


@dataclass(frozen=True, slots=True)
class SavedEpisode:
    """An episode that is saved, or is being saved."""

    number: int
    seed: int
    success: bool | None
    """Whether it is a success; None if it was not marked, because the run ended while it was recorded."""
    status: Future[RecorderStatus]
    """Status of the recorder, available when it is saved."""

    @property
    def failure(self) -> str:
        """Why it could not be saved; empty as long as it can."""
        return str(self.status.exception()) if self.status.done() and self.status.exception() is not None else ""

    def as_json(self) -> dict[str, Any]:
        """Return the entry for a report, once it is saved or could not be saved."""
        entry = {"number": self.number, "seed": self.seed, "success": self.success, "failure": self.failure}
        return entry if self.failure else entry | self.status.result()._asdict()


def _describe_loss(status: RecorderStatus) -> str:
    return f", {status.dropped} DROPPED" if status.dropped else ""


def _summary(kept: Sequence[SavedEpisode], root: Path, discarded: int, ended: str) -> Iterator[str]:
    """Yield the results, line by line; ``ended`` is why the run ended early."""
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
        f"{marks.count(True)} succeeded, {marks.count(False)} failed{unmarked}, {discarded} discarded"
    )
    if saved:
        yield f"view them: hal review {root}"


def lifts_cube(rig: Rig, robot: Robot) -> Judge | None:
    """Return the judge of the recorded demonstrations: whether the cube is 4 cm above its start.

    Returns:
        The judge; None if the arm is not simulated, or the world has no cube.
    """
    cubes = [body for body in rig.plan.world.bodies if body.name == "cube"] if rig.plan.world is not None else []
    if not cubes or not stands_in_world(rig, robot):
        return None
    height = cubes[0].position[2] + LIFTED
    return lambda rig, observation: bool(rig.world.pose("cube").position[2] > height)


def episode_seed(base: int, number: int, draws: int = 0) -> int:
    """Return the seed of an episode.

    Args:
        base: Value of ``--seed``.
        number: Number of the episode in the dataset.
        draws: How often its objects were shuffled.
    """
    import numpy as np

    return int(np.random.SeedSequence([base, number, draws]).generate_state(1)[0])
