"""What ``apps/collect.py`` does inside: with a page's buttons, with an arm that drives home, with a full disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")
pytest.importorskip("pybullet", reason="pip install 'robot-hal[sim]'")

from app_kit import CROSS, PS, seed_of, write_pad

import hal
from hal.apps._collecting import CollectRun
from hal.apps.collect import parser
from hal.camera import Camera
from hal.drivers.mock.gamepad import MockPad
from hal.recording import Dataset, Recorder
from hal.views import Console, DrivingView, Listen, RecordingView


class Page(Console):
    """The console's page, with somebody before it: ``press`` says what they press when they see a view."""

    def __init__(self, rig: hal.Rig, press: Callable[[RecordingView], str], driven_by: str | None = "pad") -> None:
        super().__init__(rig, Listen.parse(None), driven_by=driven_by)
        self.views: list[RecordingView] = []
        self._press = press
        self._taken: Callable[[str], None] | None = None

    def show_recording(self, view: RecordingView) -> None:
        self.views.append(view)
        if self._taken is not None and (action := self._press(view)):
            self._taken(action)

    def on_action(self, taken: Callable[[str], None]) -> None:
        self._taken = taken

    def show_driving(self, view: DrivingView) -> None: ...

    def on_setting(self, changed: Callable[[str, str | float], None]) -> None: ...

    def wait_ready(self) -> None: ...

    @property
    def link(self) -> str:
        return "http://127.0.0.1/"

    @property
    def tunnel(self) -> str:
        return ""

    def show(self, camera: Camera) -> None: ...

    def say(self, text: str) -> None: ...

    def explain(self, labels: Mapping[str, Any]) -> None: ...

    def close(self) -> None: ...


def collect(
    folder: Path,
    pad: str,
    *options: str,
    press: Callable[[RecordingView], str] | None = None,
    by_page: bool = False,
    **disk: int,
) -> tuple[int, list[RecordingView]]:
    """A run in simulation, in lock-step: its exit status, and what a page showed. It writes ``folder / "data"``."""
    with (
        hal.open("panda_table", sim=True, clock="lock_step", pad=pad, overrides=["cameras={}"]) as rig,
        Recorder(rig, folder / "data", **disk) as recorder,
    ):
        page = Page(rig, press, None if by_page else "pad") if press is not None else None
        rig.console = page
        robot, gamepad = rig.robots["panda"], rig.gamepads["pad"]
        status = CollectRun(rig, robot, gamepad, recorder, parser().parse_args([*options])).run()
        return status, page.views if page is not None else []


def test_a_page_has_the_buttons_and_sees_how_it_goes(tmp_path: Path) -> None:
    presses = iter(["record", "discard", "discard", "record", "fail", "record", "finish"])

    def press(view: RecordingView) -> str:
        return next(presses) if view.phase == "ready" or view.seconds > 0.3 else ""

    options = ("--mapping", "spacemouse", "--episodes", "2", "--task", "wave")  # a mapping without these buttons
    status, views = collect(tmp_path, write_pad(tmp_path, until=30.0), *options, press=press)
    assert status == 0
    failed, saved = Dataset(tmp_path / "data").episodes
    assert (failed.success, saved.success) == (False, True)
    assert [failed.info["seed"], saved.info["seed"]] == [seed_of(0, draws=1), seed_of(1)]
    last = views[-1]
    assert (last.phase, last.saved, last.wanted, last.succeeded, last.failed) == ("done", 2, 2, 1, 1)
    assert (last.discarded, last.task, last.trouble) == (1, "wave", "")
    possible = {"ready": ("record", "discard"), "recording": ("finish", "fail", "discard")}
    assert {view.phase for view in views} == {"resetting", *possible, "saving", "done"}
    for view in views:
        assert view.actions == possible.get(view.phase, ())
        assert view.seconds == 0.0 or view.phase == "recording"
        assert view.free_bytes > 0


def test_who_drives_by_the_page_is_told_no_more_than_its_buttons_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    presses = iter(["record", "finish"])

    def press(view: RecordingView) -> str:
        return next(presses) if view.phase == "ready" or view.seconds > 0.3 else ""

    status, views = collect(tmp_path, write_pad(tmp_path, until=30.0), "--episodes", "1", press=press, by_page=True)
    assert status == 0
    assert {view.prompt for view in views if view.phase == "ready"} == {'press Record; "Discard" shuffles the objects'}
    assert {view.prompt for view in views if view.phase == "recording"} == {""}
    assert "episode 0: RECORDING\n" in capsys.readouterr().out


def test_a_disk_that_fills_up_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    status, _ = collect(tmp_path, pad, "--episodes", "1", warn_free=10**18)
    assert (status, len(Dataset(tmp_path / "data").episodes)) == (0, 1)
    assert "RECORDING: only" in capsys.readouterr().out


def test_with_a_full_disk_nothing_is_recorded_and_the_arm_can_still_be_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    status, _ = collect(tmp_path, pad, stop_free=10**18)
    told = capsys.readouterr().out
    assert status == 1
    assert "NOT RECORDING" in told
    assert "has ended" in told, "the session went on"
    assert not list((tmp_path / "data").rglob("*.parquet"))


def test_an_arm_that_is_not_simulated_drives_home_first_while_l2_is_held(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig,
        Recorder(rig, tmp_path / "data") as recorder,
    ):
        arm, hand = rig.robots["panda"], rig.driver("pad")
        assert isinstance(hand, MockPad)
        arm.move_to(arm.home + 0.05)
        run = CollectRun(rig, arm, rig.gamepads["pad"], recorder, parser().parse_args(["--episodes", "1"]))

        def until(true: Callable[[], object]) -> Iterator[None]:
            end = time.monotonic() + 60.0
            while not true():
                assert time.monotonic() < end, f"it did not happen, in the phase {run.phase!r}"
                yield

        def person() -> Iterator[None]:
            yield from until(lambda: run.phase == "resetting" and run.session.deadman.connected)
            at_rest = rig.clock.now() + 0.5
            yield from until(lambda: rig.clock.now() > at_rest)
            assert np.abs(arm.state().q_set - arm.home).max() > 0.04, "nothing moves before L2 is held"
            hand.press("l2")
            yield from until(lambda: run.phase == "ready")
            assert np.abs(arm.state().q_set - arm.home).max() < 1e-3
            hand.press("south")
            yield from until(lambda: run.phase == "recording")
            hand.release("south", "l2")
            yield from until(lambda: recorder.status().seconds > 0.2)
            hand.press("home")

        acts = person()
        rig.clock.every(0.02, lambda: next(acts, None))
        assert run.run() == 0
    (episode,) = Dataset(tmp_path / "data").episodes
    assert (episode.success, episode.info["seed"]) == (True, seed_of(0))
    told = capsys.readouterr().out
    assert "release L2, then hold it until the arm is home; then its gripper opens" in told
    assert "place the objects; south: start recording" in told


@pytest.mark.parametrize(("clock", "stops"), [("real_time", True), ("lock_step", True), ("lock_step", False)])
def test_a_stop_is_named_where_a_demonstration_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], clock: Literal["real_time", "lock_step"], stops: bool
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (4.0, PS), until=5.0, held=(1.5, 3.5))
    with (
        hal.open("panda_table", sim=True, clock=clock, pad=pad, overrides=["cameras={}"]) as rig,
        Recorder(rig, tmp_path / "data") as recorder,
    ):

        def stop(view: RecordingView) -> str:
            if stops and view.seconds > 1.0:
                rig.stop()
            return ""

        rig.console = Page(rig, stop)
        args = parser().parse_args(["--episodes", "1"])
        assert CollectRun(rig, rig.robots["panda"], rig.gamepads["pad"], recorder, args, lambda *_: False).run() == 0
    told = capsys.readouterr().out
    assert "the cube was not lifted" in told
    assert ("the arm was stopped in this episode" in told) is stops
    assert ("--set simulation.clock=lock_step" in told) is (stops and clock == "real_time")
