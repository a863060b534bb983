"""``apps/dataset.py``: what it does to a recording."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from app_kit import run_here
from recording_kit import check_layout, mock_rig, record

from hal.apps.dataset import main
from hal.recording import Dataset, Recorder
from hal.recording.checking import check_dataset


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes with different marks, lengths and tasks."""
    out = tmp_path_factory.mktemp("recorded") / "demo"
    with mock_rig() as rig, Recorder(rig, out, fps=20, task="lift") as recorder:
        for seconds, success in ((0.3, True), (0.4, False), (0.5, None), (0.6, True)):
            recorder.task = "lower" if seconds > 0.55 else "lift"
            record(recorder, seconds, success)
    return out


@pytest.fixture
def demo(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "demo"))


def lengths(folder: Path) -> list[int]:
    assert not list(check_dataset(Dataset(folder)))
    check_layout(folder)
    return [episode.length for episode in Dataset(folder).episodes]


@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        ([], "0,1,2,3"),
        (["--succeeded"], "0,3"),
        (["--failed"], "1"),
        (["--unmarked"], "2"),
        (["--task", "LOW"], "3"),
        (["--longer", "0.35", "--shorter", "0.58"], "1,2"),
        (["--dropped"], ""),
    ],
)
def test_a_list_can_be_narrowed(recorded: Path, options: list[str], numbers: str) -> None:
    done = run_here(main, "list", str(recorded), "--numbers", *options)
    assert (done.returncode, done.stdout.strip()) == (0, numbers)


def test_a_list_shows_every_episode(recorded: Path) -> None:
    done = run_here(main, "list", str(recorded))
    assert done.returncode == 0
    assert [line.split()[2] for line in done.stdout.splitlines()[1:5]] == ["success", "failure", "-", "success"]


def test_deleted_episodes_are_gone_and_the_others_are_whole(demo: Path, recorded: Path) -> None:
    before = Dataset(recorded).episodes
    assert run_here(main, "delete", str(demo), "0,2", "--yes").returncode == 0
    assert lengths(demo) == [before[1].length, before[3].length]
    for old, new in zip((before[1], before[3]), Dataset(demo).episodes, strict=True):
        assert (old.columns["action"] == new.columns["action"]).all()
        for camera in old.cameras:
            for stream in ("color", "depth"):
                for one, other in zip(old.pictures(camera, stream), new.pictures(camera, stream), strict=True):
                    assert (one == other).all()
    with mock_rig() as rig, Recorder(rig, demo, fps=20, task="lift") as recorder:
        record(recorder, 0.2, True)  # the dataset goes on
    assert len(lengths(demo)) == 3


def test_nothing_is_deleted_without_a_yes(demo: Path) -> None:
    done = run_here(main, "delete", str(demo), "0")
    assert done.returncode == 2
    assert "--yes" in done.stderr
    assert len(lengths(demo)) == 4


def test_marks_and_tasks_change(demo: Path) -> None:
    assert run_here(main, "mark", str(demo), "1-2", "success").returncode == 0
    assert run_here(main, "mark", str(demo), "0", "none").returncode == 0
    assert run_here(main, "task", str(demo), "lift it", "--episodes", "0-1").returncode == 0
    assert len(lengths(demo)) == 4
    episodes = Dataset(demo).episodes
    assert [episode.success for episode in episodes] == [None, True, True, True]
    assert [episode.task for episode in episodes] == ["lift it", "lift it", "lift", "lower"]
    assert sorted({int(episode.columns["task_index"][0]) for episode in episodes}) == [0, 1, 2]


def test_some_episodes_become_a_dataset_and_merge_again(demo: Path, tmp_path: Path) -> None:
    rest, both = tmp_path / "rest", tmp_path / "both"
    assert run_here(main, "extract", str(demo), "1,3", "--out", str(rest)).returncode == 0
    assert run_here(main, "merge", str(rest), str(demo), "--out", str(both)).returncode == 0
    all_of = lengths(demo)
    assert lengths(both) == [all_of[1], all_of[3], *all_of]


@pytest.mark.parametrize(
    "command",
    [
        ["delete", "0-3", "--yes"],
        ["delete", "4", "--yes"],
        ["mark", "9", "success"],
        ["extract", "7", "--out", "elsewhere"],
        ["task", "text", "--episodes", "x"],
    ],
)
def test_a_command_that_cannot_be_done_changes_nothing(demo: Path, command: list[str]) -> None:
    name, *rest = command
    before = {path: path.read_bytes() for path in demo.rglob("*") if path.is_file()}
    assert run_here(main, name, str(demo), *rest).returncode == 2
    assert {path: path.read_bytes() for path in demo.rglob("*") if path.is_file()} == before
