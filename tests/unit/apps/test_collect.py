"""``apps/collect.py`` in lock-step: what each button does, pages, a full disk, an arm that drives home, mistakes."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")
pytest.importorskip("gymnasium", reason="pip install 'robot-hal[gym]'")

from app_kit import CIRCLE, CROSS, PS, SQUARE, seed_of, write_pad
from engines_kit import need_engine

import hal
from hal.apps import collect, dataset, export, replay
from hal.apps._collecting import CollectRun
from hal.camera import Camera
from hal.drivers.mock.gamepad import MockPad
from hal.gym import EnvSettings, RigEnv
from hal.learning.episode import reset_scene
from hal.recording import Dataset, Episode, Recorder
from hal.views import Console, DrivingView, Listen, RecordingView

ROOT = Path(__file__).resolve().parents[3]
PAD = ROOT / "config" / "teleop" / "demonstrations.jsonl"
MADE_BY = ROOT / "tests" / "data" / "pads" / "make_demonstrations.py"
FAST = ("--sim", "--set", "cameras={}", "--set", "simulation.clock=lock_step")

Collect = Callable[..., int]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Collect:
    """Return a function that runs the program in this process, in ``tmp_path``, and returns its exit status."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> int:
        return collect.main([*FAST, "--out", "data", "--report", "report.json", *map(str, arguments)])

    return call


def report() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path("report.json").read_text())
    return found


def episodes() -> list[Episode]:
    return list(Dataset("data").episodes)


def start_of_cube(episode: Episode) -> np.ndarray:
    """Return where the cube was when the recording began, x and y in the world, m."""
    return np.asarray(episode.columns["rig.object.cube"][0, :2])


@pytest.fixture(scope="module")
def world() -> Iterator[hal.Rig]:
    """A world in which objects are placed for comparison."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=["cameras={}"]) as rig:
        yield rig


def put(world: hal.Rig, seed: int) -> np.ndarray:
    """Return where the cube is placed with this seed."""
    poses = reset_scene(world, world.robots["panda"], random=np.random.default_rng(seed))
    return np.asarray(poses["cube"].position[:2])


# The pad.


@pytest.mark.parametrize("again", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_demonstration_that_misses_the_cube_is_a_failure(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str], again: bool
) -> None:
    """With another seed, or after other episodes, the cube is elsewhere than the recorded pad reaches."""
    if again:
        assert call("--pad", write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0), "--episodes", 1) == 0
    assert call("--pad", "demo", "--episodes", 1, "--seed", 0 if again else 1) == 0
    last = episodes()[-1]
    assert np.ptp(last.columns["rig.object.cube"][:, 2]) < 0.02, "it stayed on the table"
    assert last.success is False
    out = capsys.readouterr().out
    assert "closes on air" in out
    assert "the cube was not lifted" in out


@pytest.mark.slow
def test_the_recorded_pad_is_the_output_of_its_program() -> None:
    """Presses only, and to 0.1 s: other builds of the physics differ in the last bits."""
    need_engine("pybullet")
    made: list[str] = runpy.run_path(str(MADE_BY))["lines"]()
    shipped = PAD.read_text(encoding="utf-8").splitlines()
    assert made[0] == shipped[0]

    def presses(lines: list[str]) -> list[dict[str, Any]]:
        events = [json.loads(line) for line in lines[1:]]
        return [event for event in events if event["type"] == "key" or event["code"].startswith("ABS_HAT")]

    ours, theirs = presses(made), presses(shipped)
    assert [(event["code"], event["value"]) for event in ours] == [(event["code"], event["value"]) for event in theirs]
    assert np.allclose([event["t"] for event in ours], [event["t"] for event in theirs], atol=0.1)


@pytest.mark.parametrize(
    ("body", "mark"),
    [
        ("return True", True),
        ("return rig.world.pose('cube').position[2] > 1 and observation", False),
        ("1 / 0", None),
    ],
)
def test_a_function_confirms_successes(call: Collect, tmp_path: Path, body: str, mark: bool | None) -> None:
    name = f"judge_{mark}".lower()
    (tmp_path / f"{name}.py").write_text(f"def check(rig, observation):\n    {body}\n")
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), (4.0, CROSS), (5.0, SQUARE), until=6.0)
    assert call("--pad", pad, "--episodes", 2, "--success", f"{name}:check") == (mark is None)
    assert [episode.success for episode in episodes()] == [mark, False], "a failure stays one"
    assert call("--pad", pad, "--success", f"{name}:nothing") == 2


def test_circle_discards_a_recording_or_shuffles_the_objects(call: Collect, tmp_path: Path, world: hal.Rig) -> None:
    discarded = [(1.0, CROSS), (2.0, CIRCLE), (3.0, CROSS), (4.0, PS)]
    shuffled = [(5.0, CIRCLE), (6.0, CIRCLE), (7.0, CROSS), (8.0, SQUARE)]
    assert call("--pad", write_pad(tmp_path, *discarded, *shuffled, until=9.0), "--episodes", 2) == 0
    saved, failed = episodes()
    assert (saved.success, failed.success) == (True, False)
    assert (saved.info["seed"], failed.info["seed"]) == (seed_of(0), seed_of(1, draws=2))
    assert np.allclose(start_of_cube(saved), put(world, seed_of(0)), atol=1e-3), "discarded: the same place again"
    assert np.allclose(start_of_cube(failed), put(world, seed_of(1, draws=2)), atol=1e-3)
    assert np.abs(put(world, seed_of(1)) - start_of_cube(failed)).max() > 0.01, "shuffled: elsewhere"
    assert report()["discarded"] == 1
    assert [one["success"] for one in report()["episodes"]] == [True, False]


def test_the_seed_of_an_episode_gives_an_environment_the_same_start(call: Collect, tmp_path: Path) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    assert call("--pad", pad, "--episodes", 1, "--seed", 5) == 0
    (episode,) = episodes()
    assert episode.info["seed"] == seed_of(0, seed=5)
    env = RigEnv("panda_table", EnvSettings(rate_hz=30), sim=True, overrides=("cameras={}",))
    try:
        _, info = env.reset(seed=episode.info["seed"])
    finally:
        env.close()
    began, cube = episode.columns["rig.object.cube"][0], info["poses"]["cube"]
    assert np.allclose(cube[:2], began[:2], atol=1e-3)
    assert abs(cube[3:] @ began[3:]) == pytest.approx(1.0, abs=1e-4), "turned alike; it dropped onto the table"


def test_the_next_run_continues_the_dataset(call: Collect, tmp_path: Path) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    for number in (0, 1):
        assert call("--pad", pad, "--episodes", 1) == 0
        assert [one["number"] for one in report()["episodes"]] == [number]
    first, second = episodes()
    assert [first.info["seed"], second.info["seed"]] == [seed_of(0), seed_of(1)], "as in one run"
    assert np.abs(start_of_cube(first) - start_of_cube(second)).max() > 0.01
    assert call("--pad", pad, "--fps", 15) == 2, "another frame rate"
    assert len(episodes()) == 2


def test_buttons_of_another_phase_have_no_effect(call: Collect, tmp_path: Path) -> None:
    """Circle, pressed while L2 is held, does not discard."""
    presses = [(0.6, PS), (1.0, CROSS), (1.5, CROSS), (2.0, CIRCLE), (3.0, PS)]
    assert call("--pad", write_pad(tmp_path, *presses, until=4.0, held=(1.8, 2.5)), "--episodes", 1) == 0
    (episode,) = episodes()
    assert episode.length == pytest.approx(2.0 * 30, abs=3), "from the first Cross to PS"
    assert report()["discarded"] == 0


def test_a_pad_that_ends_early_leaves_an_unmarked_episode(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("--pad", write_pad(tmp_path, (1.0, CROSS), until=2.0), "--episodes", 2) == 1
    (episode,) = episodes()
    assert episode.success is None
    assert episode.length == pytest.approx(30, abs=3)
    (entry,) = report()["episodes"]
    assert (entry["success"], entry["frames"]) == (None, episode.length)
    assert "1 not marked, 0 discarded" in capsys.readouterr().out


# Mistakes.


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--episodes", "0"], "--episodes"),
        (["--seed", "-1"], "--seed"),
        (["--fps", "0"], "--fps"),
        (["--fps", "500"], "fps must be"),
        (["--out", __file__], "--out"),
        (["--cameras", "wirst", "--dry-run"], "--cameras: this rig has no camera 'wirst'"),
        (["--robot", "pandas"], "--robot: this rig has no robot 'pandas'"),
        (["--pad", "none"], "--pad none"),
        (["--pad", "nothing.jsonl"], "nothing.jsonl"),
        (["--mapping", "spacemouse"], "no button for record and finish"),
        (["--report", "/nowhere/report.json"], "/nowhere"),
    ],
)
def test_a_mistake_is_a_message(
    call: Collect, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert call("--pad", PAD, *arguments) == 2
    assert words in capsys.readouterr().err
    assert not Path("data").exists(), "nothing was written"


def test_a_folder_with_other_contents_is_refused(call: Collect, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "thesis.tex").write_text("years of work")
    assert call("--pad", PAD) == 2
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["thesis.tex"]


def test_a_dry_run_writes_nothing(call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--pad", PAD, "--episodes", 3, "--dry-run") == 0
    assert "dataset  data: 3 episode(s) at 30 rows/s" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


# A page, a full disk, a real arm.


class Page(Console):
    """The console with a user in front of it: ``press`` returns the action for a view."""

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

    def show_camera(self, camera: Camera) -> None: ...

    def say(self, text: str) -> None: ...

    def explain(self, labels: Mapping[str, Any]) -> None: ...

    def close(self) -> None: ...


def run(
    folder: Path,
    pad: str,
    *options: str,
    press: Callable[[RecordingView], str] | None = None,
    by_page: bool = False,
    **disk: int,
) -> tuple[int, list[RecordingView]]:
    """Collect into ``folder / "data"``; return the exit status, and the views that a page showed."""
    with (
        hal.open("panda_table", sim=True, clock="lock_step", pad=pad, overrides=["cameras={}"]) as rig,
        Recorder(rig, folder / "data", **disk) as recorder,
    ):
        page = Page(rig, press, None if by_page else "pad") if press is not None else None
        rig.console = page
        args = collect.parser().parse_args([*options])
        status = CollectRun(rig, [rig.robots["panda"]], recorder, args).run()
        return status, page.views if page is not None else []


def pressing(*actions: str) -> Callable[[RecordingView], str]:
    """Press these buttons of the page one after the other, each once it is possible and 0.3 s were recorded."""
    left = iter(actions)
    return lambda view: next(left) if view.phase == "ready" or view.seconds > 0.3 else ""


def test_a_page_has_the_buttons_and_shows_the_state(tmp_path: Path) -> None:
    press = pressing("record", "discard", "discard", "record", "fail", "record", "finish")
    options = ("--mapping", "spacemouse", "--episodes", "2", "--task", "wave")  # a mapping without these buttons
    status, views = run(tmp_path, write_pad(tmp_path, until=30.0), *options, press=press)
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


def test_prompts_for_a_page_name_its_buttons(tmp_path: Path) -> None:
    pad = write_pad(tmp_path, until=30.0)
    status, views = run(tmp_path, pad, "--episodes", "1", press=pressing("record", "finish"), by_page=True)
    assert status == 0
    assert {view.prompt for view in views if view.phase == "ready"} == {'press Record; "Discard" shuffles the objects'}
    assert {view.prompt for view in views if view.phase == "recording"} == {""}


@pytest.mark.parametrize(("disk", "status"), [({"warn_free": 10**18}, 0), ({"stop_free": 10**18}, 1)])
def test_a_full_disk_is_shown_and_the_arm_can_still_be_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], disk: dict[str, int], status: int
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    found, views = run(tmp_path, pad, "--episodes", "1", press=lambda view: "", **disk)
    assert found == status
    printed = capsys.readouterr().out
    if status == 0:
        assert any("only" in view.trouble for view in views)
        assert len(Dataset(tmp_path / "data").episodes) == 1
    else:
        assert "NOT RECORDING" in printed
        assert "has ended" in printed, "the pad drove until its end"
        assert not list((tmp_path / "data").rglob("*.parquet"))


@pytest.mark.parametrize("end", [PS, SQUARE])
def test_a_recording_that_ends_by_itself_is_named_and_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], end: str
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (4.0, end), until=6.0)
    rig = hal.open("panda_table", sim=True, clock="lock_step", pad=pad, overrides=["cameras={}"])
    with rig, Recorder(rig, tmp_path / "data") as recorder:
        read_row = recorder._sampler.row

        def read(*arguments: Any) -> Any:
            if recorder.status().seconds > 0.5:
                raise hal.StaleStateError("camera wrist has sent no picture")
            return read_row(*arguments)

        recorder._sampler.row = read  # type: ignore[method-assign]
        page = rig.console = Page(rig, lambda view: "")
        args = collect.parser().parse_args(["--episodes", "1"])
        assert CollectRun(rig, [rig.robots["panda"]], recorder, args).run() == (end == PS), "it does not count"
    printed = capsys.readouterr().out
    assert "RECORDING ENDED after" in printed
    assert ("not marked a success" in printed) == (end == PS)
    (episode,) = Dataset(tmp_path / "data").episodes
    assert episode.success is (None if end == PS else False)
    assert any("save, not marked" in view.prompt for view in page.views)
    data = str(tmp_path / "data")
    assert dataset.main(["list", data]) == 0
    assert "[camera wrist has sent no picture]" in capsys.readouterr().out
    assert replay.main([data, "--sim", "--set", "cameras={}", "--set", "simulation.clock=lock_step"]) == 0
    assert "ended by itself: camera wrist" in capsys.readouterr().out
    assert export.main([data, "--to", "npz"]) == 0
    assert "that ended by themselves, perhaps before the task: 0" in capsys.readouterr().out


def test_an_arm_that_is_not_simulated_drives_home_while_l2_is_held(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig,
        Recorder(rig, tmp_path / "data") as recorder,
    ):
        arm, hand = rig.robots["panda"], rig.driver("pad")
        assert isinstance(hand, MockPad)
        arm.move_to(arm.home + 0.05)
        args = collect.parser().parse_args(["--episodes", "1"])
        app = CollectRun(rig, [arm], recorder, args)

        def until(true: Callable[[], object]) -> Iterator[None]:
            end = rig.clock.now() + 60.0
            while not true():
                assert rig.clock.now() < end, f"it did not happen, in the phase {app.phase!r}"
                yield

        def user() -> Iterator[None]:
            yield from until(lambda: app.phase == "resetting" and app.session.deadman.connected)
            at_rest = rig.clock.now() + 0.5
            yield from until(lambda: rig.clock.now() > at_rest)
            assert np.abs(arm.state().q_set - arm.home).max() > 0.04, "nothing moves before L2 is held"
            hand.press("l2")
            yield from until(lambda: app.phase == "ready")
            assert np.abs(arm.state().q_set - arm.home).max() < 1e-3
            hand.press("south")
            yield from until(lambda: app.phase == "recording")
            hand.release("south", "l2")
            yield from until(lambda: recorder.status().seconds > 0.2)
            hand.press("home")

        acts = user()
        rig.clock.call_every(0.02, lambda: next(acts, None))  # type: ignore[attr-defined]  # of the lock-step clock
        assert app.run() == 0
    (episode,) = Dataset(tmp_path / "data").episodes
    assert (episode.success, episode.info["seed"]) == (True, seed_of(0))
    printed = capsys.readouterr().out
    assert "release L2, then hold it until the arm is home; then its gripper opens" in printed
    assert "place the objects; south: start recording" in printed


@pytest.mark.parametrize("stops", [True, False])
def test_a_stop_is_named_where_a_demonstration_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stops: bool
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (4.0, PS), until=5.0, held=(1.5, 3.5))
    with (
        hal.open("panda_table", sim=True, clock="lock_step", pad=pad, overrides=["cameras={}"]) as rig,
        Recorder(rig, tmp_path / "data") as recorder,
    ):

        def stop(view: RecordingView) -> str:
            if stops and view.seconds > 1.0:
                rig.stop()
            return ""

        rig.console = Page(rig, stop)
        args = collect.parser().parse_args(["--episodes", "1"])
        assert CollectRun(rig, [rig.robots["panda"]], recorder, args, lambda *_: False).run() == 0
    printed = capsys.readouterr().out
    assert "the cube was not lifted" in printed
    assert ("the arm was stopped in this episode" in printed) is stops
    assert "lock_step" not in printed, "which is for real time"
