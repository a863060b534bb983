"""``apps/collect.py`` as a person starts it: two demonstrations from a recorded pad, and every other way to press."""

from __future__ import annotations

import json
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")
pytest.importorskip("gymnasium", reason="pip install 'robot-hal[gym]'")
pytest.importorskip("pybullet", reason="pip install 'robot-hal[sim]'")

from app_kit import CIRCLE, CROSS, PS, SQUARE, seed_of, write_pad
from recording_kit import ROUNDED, Stage, at_row, small
from recording_layout import check_layout, check_stamps

import hal
from hal.apps import collect
from hal.learning.episode import reset_scene
from hal.learning.gym import RigEnv
from hal.recording import Dataset, Episode

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "collect.py"
PAD = ROOT / "config" / "teleop" / "demonstrations.jsonl"
MADE_BY = ROOT / "tests" / "data" / "pads" / "make_demonstrations.py"

LOCK_STEP = ("--set", "simulation.clock=lock_step")
QUIET = ("--sim", "--set", "cameras={}")
FAST = (*QUIET, *LOCK_STEP)
SMALL = small(160, 120)


def run(folder: Path, *arguments: object, timeout: float = 100.0) -> subprocess.CompletedProcess[str]:
    """The command, in a process of its own."""
    command = [sys.executable, str(APP), "--out", "data", "--report", "report.json", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=timeout)


Collect = Callable[..., int]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Collect:
    """The command in this process, which is quicker; its exit status."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> int:
        return collect.main(["--out", "data", "--report", "report.json", *map(str, arguments)])

    return call


def report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


def episodes(folder: Path) -> list[Episode]:
    return list(Dataset(folder / "data").episodes)


def start_of_cube(episode: Episode) -> np.ndarray:
    """Where it lay when the recording began, x and y in the world, m."""
    return np.asarray(episode.columns["observation.object.cube"][0, :2])


@pytest.fixture(scope="module")
def world() -> Iterator[hal.Rig]:
    """One to ask where things are put."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=["cameras={}"]) as rig:
        yield rig


def put(world: hal.Rig, seed: int) -> np.ndarray:
    """Where the cube is put with this seed."""
    poses = reset_scene(world, world.robots["panda"], random=np.random.default_rng(seed))
    return np.asarray(poses["cube"].position[:2])


# Two demonstrations.


def check_demonstrations(folder: Path, wanted: int) -> None:
    """They are there, whole, and show what they should."""
    found, info = report(folder), check_layout(folder / "data")
    assert (found["trips"], found["faults"], found["ended"], found["discarded"]) == ([], [], "", 0)
    assert [one["dropped"] for one in found["episodes"]] == [0] * wanted
    documented = {"state", "velocity", "effort", "setpoint", "setpoint_velocity", "tcp", "tcp_set", "twist", "status"}
    documented |= {"pad", "object.cube", "object.duck", "time.grid", "time.objects", "time.robot.panda"}
    documented |= {"time.gripper.panda", "time.pad.pad"}
    for camera in ("scene", "wrist"):
        documented |= {f"images.{camera}", f"camera_pose.{camera}", f"time.camera.{camera}"}
    assert {
        key.removeprefix("observation.") for key in info["features"] if key.startswith("observation.")
    } == documented
    starts = []
    for number, episode in enumerate(episodes(folder)):
        assert (episode.success, episode.task) == (True, "lift the cube")
        assert episode.info["seed"] == seed_of(number)
        assert episode.info["info"] == {"program": "collect", "robot": "panda", "mapping": "default", "speed": 1.0}
        assert episode.info["gaps"] == []
        check_stamps(episode)
        cube, tcp = episode.columns["observation.object.cube"], episode.columns["observation.tcp"]
        pad, names = episode.columns["observation.pad"], episode.names("observation.pad")
        width, target = episode.columns["observation.state"][:, -1], episode.columns["action"][:, -1]
        starts.append(cube[0, :2])
        assert 8.0 < episode.length / 30 < 15.0
        assert cube[0, 2] == pytest.approx(0.63, abs=0.002), "it lay on the table"
        assert cube[-1, 2] > 0.63 + 0.05, "and hangs in the hand at the end"
        assert np.abs(cube[-1, :3] - [-0.55, 0.0, 0.6] - tcp[-1, :3]).max() < 0.025, "between the fingers"
        assert width[0] > 0.075, "which were open"
        assert 0.025 < width[-1] < 0.036, "and hold its thin side, with the cube in between"
        assert target[-1] < 0.01
        assert (episode.columns["observation.status"][:, 1] == 0).all(), "no trip"
        assert pad[:, names.index("l2")].max() == 1.0
        for camera in ("scene", "wrist"):
            assert sum(1 for _ in episode.frames(camera)) == sum(1 for _ in episode.depth(camera)) == episode.length
    assert len({tuple(start.round(2)) for start in starts}) == wanted, "the cube lay elsewhere"


def test_two_demonstrations_by_one_command(tmp_path: Path, world: hal.Rig) -> None:
    pictures = [word for override in SMALL for word in ("--set", override)]
    done = run(tmp_path, "--sim", *LOCK_STEP, *pictures, "--pad", PAD, "--episodes", 2, "--task", "lift the cube")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    check_demonstrations(tmp_path, 2)
    for text in ("Cross: start recording", "2 of 2 in this run", "2 succeeded, 0 failed, 0 discarded"):
        assert text in done.stdout
    assert "unmarked" not in done.stdout
    for episode in episodes(tmp_path):
        assert np.allclose(start_of_cube(episode), put(world, episode.info["seed"]), atol=1e-3)
    check_pictures(tmp_path)


@pytest.mark.parametrize("again", [False, True])
def test_a_demonstration_that_grasps_air_is_a_failure(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str], again: bool
) -> None:
    """With another seed, or after other episodes, the cube lies elsewhere than the recorded pad reaches."""
    if again:
        assert call(*FAST, "--pad", write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0), "--episodes", 1) == 0
    assert call(*FAST, "--pad", "demo", "--episodes", 1, "--seed", 0 if again else 1) == 0
    last = episodes(tmp_path)[-1]
    cube = last.columns["observation.object.cube"]
    assert np.ptp(cube[:, 2]) < 0.02, "it stayed on the table"
    assert last.success is False
    out = capsys.readouterr().out
    assert "closes on air" in out
    assert "the cube was not lifted" in out
    assert "--success returned" not in out
    assert "0 succeeded, 1 failed" in out


@pytest.mark.parametrize(
    ("body", "mark", "says"),
    [
        ("return True", True, "success"),
        (
            "return rig.world.pose('cube').position[2] > 1.0 and observation",
            False,
            "--success returned False",
        ),
        ("return 1 / 0", None, "--success raised ZeroDivisionError"),
    ],
)
def test_a_function_judges_what_is_saved_as_a_success(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str], body: str, mark: bool | None, says: str
) -> None:
    name = f"judge_{mark}".lower()
    (tmp_path / f"{name}.py").write_text(f"def check(rig, observation):\n    {body}\n")
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), (4.0, CROSS), (5.0, SQUARE), until=6.0)
    assert call(*FAST, "--pad", pad, "--episodes", 2, "--success", f"{name}:check") == 0
    assert [episode.success for episode in episodes(tmp_path)] == [mark, False], "a failure stays one"
    assert says in capsys.readouterr().out
    assert call(*FAST, "--pad", pad, "--success", f"{name}:nothing") == 2


def check_pictures(folder: Path) -> None:
    """Every picture shows what its row says: put up in another world and drawn again, depth does not differ."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=SMALL) as rig:
        for episode in episodes(folder):
            stage = Stage(rig, episode)
            for row in (0, episode.length // 2, episode.length - 1):
                stage.put(at_row(episode, row))
                for camera in stage.frames:
                    assert stage.look(camera, row).wrong <= ROUNDED, (episode.number, row, camera)
                    other = 0 if row > 0 else episode.length - 1
                    assert stage.look(camera, other).wrong > 100 * ROUNDED, "another row's picture is another one"


@pytest.mark.slow
def test_a_demonstration_in_real_time(tmp_path: Path) -> None:
    for folder in (tmp_path / "once", tmp_path / "again"):
        folder.mkdir()
        done = run(folder, "--sim", "--pad", "demo", "--episodes", 1, "--task", "lift the cube")
        assert done.returncode == 0, done.stdout + done.stderr
        if not report(folder)["trips"]:  # a program that could not run for a while trips the arm, as it should
            break
    check_demonstrations(folder, 1)


def test_the_recorded_pad_is_what_its_program_makes() -> None:
    """Presses only, and to 0.1 s: other builds of the physics differ in the last bits."""
    made: list[str] = runpy.run_path(str(MADE_BY))["lines"]()
    shipped = PAD.read_text(encoding="utf-8").splitlines()
    assert made[0] == shipped[0]

    def presses(lines: list[str]) -> list[dict[str, Any]]:
        events = [json.loads(line) for line in lines[1:]]
        return [event for event in events if event["type"] == "key" or event["code"].startswith("ABS_HAT")]

    ours, theirs = presses(made), presses(shipped)
    assert [(event["code"], event["value"]) for event in ours] == [(event["code"], event["value"]) for event in theirs]
    assert np.allclose([event["t"] for event in ours], [event["t"] for event in theirs], atol=0.1)


# Other ways to press.


def test_circle_forgets_an_episode_or_asks_for_other_places(call: Collect, tmp_path: Path, world: hal.Rig) -> None:
    forgotten = [(1.0, CROSS), (2.0, CIRCLE), (3.0, CROSS), (4.0, PS)]
    elsewhere = [(5.0, CIRCLE), (6.0, CIRCLE), (7.0, CROSS), (8.0, SQUARE)]
    pad = write_pad(tmp_path, *forgotten, *elsewhere, until=9.0)
    assert call(*FAST, "--pad", pad, "--episodes", 2) == 0
    saved, failed = episodes(tmp_path)
    assert (saved.success, failed.success) == (True, False)
    assert (saved.info["seed"], failed.info["seed"]) == (seed_of(0), seed_of(1, draws=2))
    assert np.allclose(start_of_cube(saved), put(world, seed_of(0)), atol=1e-3), "forgotten: the same place again"
    assert np.allclose(start_of_cube(failed), put(world, seed_of(1, draws=2)), atol=1e-3)
    assert np.abs(put(world, seed_of(1)) - start_of_cube(failed)).max() > 0.01, "not wanted: elsewhere"
    assert report(tmp_path)["discarded"] == 1
    assert [one["success"] for one in report(tmp_path)["episodes"]] == [True, False]


def test_the_seed_of_an_episode_puts_an_environment_where_it_began(call: Collect, tmp_path: Path) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    assert call(*FAST, "--pad", pad, "--episodes", 1, "--seed", 5) == 0
    (episode,) = episodes(tmp_path)
    assert episode.info["seed"] == seed_of(0, seed=5)
    env = RigEnv("panda_table", sim=True, rate_hz=30, overrides=("cameras={}",))
    try:
        _, info = env.reset(seed=episode.info["seed"])
    finally:
        env.close()
    began, cube = episode.columns["observation.object.cube"][0], info["poses"]["cube"]
    assert np.allclose(cube[:2], began[:2], atol=1e-3)
    assert abs(cube[3:] @ began[3:]) == pytest.approx(1.0, abs=1e-4), "turned alike; it dropped onto the table"


def test_the_next_run_goes_on_in_the_same_dataset(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), (2.0, PS), until=3.0)
    for number in (0, 1):
        assert call(*FAST, "--pad", pad, "--episodes", 1) == 0
        assert [one["number"] for one in report(tmp_path)["episodes"]] == [number]
    first, second = episodes(tmp_path)
    assert [first.info["seed"], second.info["seed"]] == [seed_of(0), seed_of(1)], "as in one run"
    assert np.abs(start_of_cube(first) - start_of_cube(second)).max() > 0.01
    assert call(*FAST, "--pad", pad, "--fps", 15) == 2
    assert "fps is 30 there, and 15 here" in capsys.readouterr().err
    assert len(episodes(tmp_path)) == 2


def test_what_may_not_be_pressed_now_does_nothing(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    presses = [(0.6, PS), (1.0, CROSS), (1.5, CROSS), (2.0, CIRCLE), (3.0, PS)]
    pad = write_pad(tmp_path, *presses, until=4.0, held=(1.8, 2.5))
    assert call(*FAST, "--pad", pad, "--episodes", 1) == 0
    (episode,) = episodes(tmp_path)
    assert episode.length == pytest.approx(2.0 * 30, abs=3), "from the first Cross to PS"
    assert report(tmp_path)["discarded"] == 0
    assert "to discard the episode, release L2 first" in capsys.readouterr().out


def test_a_recording_that_ends_early_keeps_what_was_recorded(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), until=2.0)
    assert call(*FAST, "--pad", pad, "--episodes", 2) == 1
    (episode,) = episodes(tmp_path)
    assert episode.success is None
    assert episode.length == pytest.approx(30, abs=3)
    told = capsys.readouterr().out
    assert all(text in told for text in ("has ended", "episode 0 was being recorded: saved, unmarked"))
    (told_of,) = report(tmp_path)["episodes"]
    assert (told_of["success"], told_of["frames"]) == (None, episode.length)
    assert "1 episode(s) saved" in told
    assert "0 succeeded, 0 failed, 1 not marked, 0 discarded" in told


def test_ctrl_c_keeps_what_was_recorded_unmarked(tmp_path: Path) -> None:
    pad = write_pad(tmp_path, (1.0, CROSS), until=60.0)
    command = [sys.executable, str(APP), *QUIET, "--out", "data", "--report", "report.json", "--pad", pad]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as app:
        assert app.stdout is not None
        told = ""
        for line in app.stdout:
            told += line
            if "RECORDING" in line:
                break
        app.send_signal(signal.SIGINT)
        told += app.communicate(timeout=60.0)[0]
    assert app.returncode == 1, told
    assert all(text in told for text in ("episode 0 was being recorded: saved, unmarked", "ended: interrupted"))
    assert "Traceback" not in told
    (episode,) = episodes(tmp_path)
    assert episode.success is None
    assert report(tmp_path)["ended"] == "interrupted"


# What is wrong is said.


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--episodes", "0"], ["--episodes must be 1 or more"]),
        (["--seed", "-1"], ["--seed must be 0 or more"]),
        (["--fps", "0"], ["--fps must be 1 or more"]),
        (["--fps", "500"], ["fps must be"]),
        (["--out", __file__], ["is not a folder"]),
        (["--cameras", "wirst", "--dry-run"], ["no camera 'wirst'"]),
        (["--robot", "pandas"], ["pandas", "panda"]),
        (["--pad", "none"], ["needs a gamepad"]),
        (["--pad", "nothing.jsonl"], ["nothing.jsonl"]),
        (["--mapping", "spacemouse"], ["no button for record and finish", "--console"]),
        (["--report", "/nowhere/report.json"], ["/nowhere"]),
    ],
)
def test_a_persons_mistake_is_a_message(
    call: Collect, capsys: pytest.CaptureFixture[str], arguments: list[str], texts: list[str]
) -> None:
    assert call(*FAST, "--pad", PAD, *arguments) == 2
    said = capsys.readouterr().err
    for text in texts:
        assert text in said
    assert not Path("data").exists(), "nothing was written"


def test_a_folder_that_holds_something_else_is_left_alone(
    call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "thesis.tex").write_text("years of work")
    assert call(*FAST, "--pad", PAD) == 2
    assert "data" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["thesis.tex"]


def test_a_dry_run_writes_nothing(call: Collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(*FAST, "--pad", PAD, "--episodes", 3, "--dry-run") == 0
    assert "dataset  data: 3 episode(s) at 30 rows/s" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
