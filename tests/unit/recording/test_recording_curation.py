"""Trimming and splitting: which rows and episodes, and that nothing else changes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from app_kit import run_here
from errors_kit import raises_code
from recording_kit import check_layout, drive, join_metadata, make_recording, mock_rig

from hal.apps.dataset import main
from hal.errors import CommandError
from hal.recording import Dataset, Episode, KeptRows, Recorder, curation, find_motion, split, trim
from hal.recording.checking import check_dataset

LAST = {"next.success", "next.done"}
NUMBERED = {"index", "frame_index", "timestamp", "episode_index", "task_index"}


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two episodes that stand still, drive, stand still, drive and stand still; and one that never moves."""
    out = tmp_path_factory.mktemp("still") / "demo"
    with mock_rig() as rig, Recorder(rig, out, fps=20, task="lift") as recorder:
        for success in (True, False):
            recorder.start()
            rig.clock.sleep(0.75)
            drive(rig, 0.3)
            rig.clock.sleep(0.6)
            drive(rig, 0.3)
            rig.clock.sleep(1.0)
            recorder.save(success, wait=True)
        recorder.start()
        rig.clock.sleep(0.3)
        recorder.save(None, wait=True)
    return Dataset(out)


def check_kept(before: Episode, after: Episode, kept: KeptRows) -> None:
    """Check that rows, pictures, depth and true times are those of the rows that were kept, to the bit."""
    rows = slice(*kept)
    assert after.length == kept.end - kept.first
    for key, values in before.columns.items():
        if not key.startswith("rig.time.") and key not in LAST | NUMBERED:
            assert np.array_equal(after.columns[key], values[rows], equal_nan=values.dtype.kind == "f"), key
    for source, times in before.stamps.items():
        assert np.array_equal(after.stamps[source], times[rows], equal_nan=True), source
    assert abs(after.columns["rig.time.grid"][0]) < 1e-6, "times count from the first row"
    for key in LAST & after.columns.keys():
        assert not after.columns[key][:-1].any()
    assert after.columns["next.done"][-1]
    assert after.columns["next.success"][-1] == (before.success is True)
    assert (after.task, after.success) == (before.task, before.success)
    for camera in before.cameras:
        assert np.array_equal(list(after.frames(camera)), list(before.frames(camera))[rows])
        assert np.array_equal(list(after.depth(camera)), list(before.depth(camera))[rows])


def moving(episode: Episode) -> np.ndarray:
    """Rows between which the commanded position changes."""
    return np.flatnonzero(np.abs(np.diff(episode.columns["rig.setpoint"], axis=0)).max(axis=1) > 1e-4)


def test_only_the_still_rows_at_both_ends_are_found(still: Dataset) -> None:
    for episode in still.episodes[:2]:
        rows = moving(episode)
        kept = find_motion(episode, keep=0.0)
        assert rows[0] - 4 <= kept.first <= rows[0], "at most a row for the next action, and one for a key frame"
        assert kept.first % 2 == 0, "every second picture is a key frame"
        assert rows[-1] < kept.end <= episode.length - 10
        assert np.diff(rows).max() > 8, "it stands still in the middle, too"
        assert find_motion(episode, keep=100.0) == (0, episode.length)
        longer = find_motion(episode, keep=0.2)
        assert kept.first - 5 <= longer.first < kept.first
        assert longer.end == kept.end + 4
    assert find_motion(still.episodes[2]) == (0, still.episodes[2].length), "an episode without motion stays"


def test_thresholds_and_what_is_unknown(still: Dataset) -> None:
    rows = still.episodes[2].length

    def found(**changes: np.ndarray) -> KeptRows:
        episode = Dataset(still.root).episodes[2]
        for name, values in changes.items():
            key = {"dq": "observation.velocity", "q": "observation.state", "target": "rig.setpoint"}[name]
            episode.columns[key] = episode.columns[key] + values
        return find_motion(episode, keep=0.0)

    one = np.zeros((rows, 8))
    one[4, 2] = 0.019
    assert found(dq=one[:, :7]) == (0, rows), "slower than the threshold"
    one[4, 2] = 0.021
    assert found(dq=one[:, :7]) == (2, 5), "from the key frame before the row whose action leads there"
    assert found(dq=np.where(one[:, :7] > 0.0, np.nan, 0.0)) == (0, rows), "unknown, and the positions do not change"
    for key in ("q", "target"):
        closing = np.zeros((rows, 8))
        closing[3:, 7] = -0.002
        assert found(**{key: closing}) == (2, 3), f"the gripper's {key}"
        assert found(**{key: closing / 4.0}) == (0, rows)
    with raises_code(CommandError, "bad_threshold"):
        find_motion(still.episodes[0], speed=0.0)
    with raises_code(CommandError, "bad_threshold"):
        find_motion(still.episodes[0], keep=float("nan"))


def test_a_trimmed_dataset_keeps_everything_else(still: Dataset, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(still.root, tmp_path / "demo"))
    plan = run_here(main, "trim", str(folder), "--dry-run")
    assert plan.returncode == 0
    assert [line.split(":")[0] for line in plan.stdout.splitlines()[:-1]] == ["episode 0", "episode 1"]
    assert "would be removed" in plan.stdout
    assert check_layout(folder)["total_frames"] == sum(map(len, still.episodes)), "nothing was done"
    assert run_here(main, "trim", str(folder)).returncode == 2, "not without a yes"
    assert run_here(main, "trim", str(folder), "--yes").returncode == 0
    assert list(check_dataset(Dataset(folder))) == []
    check_layout(folder)
    for before, after in zip(still.episodes, Dataset(folder).episodes, strict=True):
        check_kept(before, after, find_motion(before))
    assert run_here(main, "trim", str(folder), "--yes").stdout == "nothing to trim\n"
    assert run_here(main, "check", str(folder)).returncode == 0


def test_rows_can_be_chosen_and_metadata_follows(still: Dataset, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(still.root, tmp_path / "demo"))
    join_metadata(folder)
    path = folder / "episodes/000000.json"
    about = json.loads(path.read_text())
    gaps = [{"from_s": t, "to_s": t + 0.05, "rows": 1, "why": "disk"} for t in (0.1, 0.8, 2.5)]
    path.write_text(json.dumps(about | {"gaps": gaps, "dropped": 3}))
    rows = still.episodes[0].length
    for kept in (KeptRows(0, rows + 1), KeptRows(6, 6), KeptRows(-2, 9), KeptRows(7, 20)):  # 7 is no key frame
        with raises_code(CommandError, "bad_rows"):
            trim(folder, {0: kept})
    with raises_code(CommandError, "no_episodes"):
        trim(folder, {7: KeptRows(0, 1)})
    first, second = KeptRows(8, rows - 6), KeptRows(2, rows - 24)
    out = tmp_path / "out"
    assert trim(folder, {0: first}, out) == 14
    assert Dataset(folder).episodes[0].length == rows, "the source is only read"
    assert trim(out, {0: second}) == 12
    after = Dataset(out).episodes[0]
    check_kept(Dataset(folder).episodes[0], after, KeptRows(10, rows - 16))
    assert after.info["trimmed"] == {"first": 10, "rows": rows}
    (gap,) = after.info["gaps"]
    assert gap["from_s"] == pytest.approx(0.8 - 0.5, abs=1e-6)
    assert after.info["dropped"] == 1
    assert after.info["rig"] == about["rig"]
    before = Path(shutil.copytree(out, tmp_path / "before"))
    kept = KeptRows(0, still.episodes[2].length - 2)
    assert trim(out, {2: kept}) == 2, "only at the end of the last one: no file gets another number"
    check_kept(Dataset(before).episodes[2], Dataset(out).episodes[2], kept)
    assert list(check_dataset(Dataset(out))) == []
    with mock_rig() as rig, Recorder(rig, out, fps=20, task="lift") as recorder:
        recorder.start()
        drive(rig, 0.2)
        recorder.save(True, wait=True)
    assert list(check_dataset(Dataset(out))) == []


def test_objects_start_in_the_first_row_that_is_kept(still: Dataset) -> None:
    episode = Dataset(still.root).episodes[0]
    poses = np.arange(7.0 * episode.length).reshape(-1, 7)
    lost = np.where(np.arange(episode.length)[:, None] < 10, np.nan, poses)
    episode.columns.update({"rig.object.cube": poses, "rig.object.lost": lost})
    start = {"cube": [0.0] * 7, "lost": [1.0] * 7, "table": [2.0] * 7}
    episode.info["objects_at_start"] = start
    found = curation._TrimmedEpisode(episode, KeptRows(8, 20)).info["objects_at_start"]
    assert found == start | {"cube": poses[8].tolist()}, "a table has no column, and a lost cube no pose"
    assert episode.info["objects_at_start"]["cube"] == [0.0] * 7, "the recording's own stay"


def test_a_split_has_every_episode_once(tmp_path: Path) -> None:
    source = make_recording(tmp_path / "demo")
    done = run_here(main, "split", str(source.root), "--by-mark", "--out", str(tmp_path / "marks"))
    assert done.returncode == 0
    for name, number in (("success", 0), ("failure", 1), ("unmarked", 2)):
        part = Dataset(tmp_path / "marks" / name)
        assert list(check_dataset(part)) == []
        before, (after,) = source.episodes[number], part.episodes
        check_kept(before, after, KeptRows(0, before.length))
        assert after.info["rig"] == before.info["rig"]
    lists = ["--episodes", "train=0,2;val=1"]
    assert run_here(main, "split", str(source.root), *lists, "--out", str(tmp_path / "lists")).returncode == 0
    assert [len(Dataset(tmp_path / "lists" / name)) for name in ("train", "val")] == [2, 1]
    shares = ["--shares", "train=0.67,val=0.33"]
    assert run_here(main, "split", str(source.root), *shares, "--out", str(tmp_path / "shares")).returncode == 0
    assert sorted(len(Dataset(tmp_path / "shares" / name)) for name in ("train", "val")) == [1, 2]


def test_shares_are_random_and_the_same_for_a_seed() -> None:
    parts = curation.shares(100, {"train": 0.8, "val": 0.15})
    assert [len(part) for part in parts.values()] == [80, 15]
    assert not set(parts["train"]) & set(parts["val"])
    assert parts == curation.shares(100, {"train": 0.8, "val": 0.15})
    assert parts != curation.shares(100, {"train": 0.8, "val": 0.15}, seed=1)
    assert parts["train"] != list(range(80))
    for wrong in ({"a": 0.7, "b": 0.7}, {"a": 0.0}, {"a": float("nan")}, {"a": 0.001, "b": 0.5}):
        with raises_code(CommandError, "bad_split"):
            curation.shares(100, wrong)


@pytest.mark.parametrize("parts", [{}, {"a": []}, {"a": [0, 1], "b": [1]}, {"../a": [0]}, {"": [0]}])
def test_a_split_that_cannot_be_done_leaves_nothing(
    still: Dataset, tmp_path: Path, parts: dict[str, list[int]]
) -> None:
    with raises_code(CommandError, "bad_split"):
        split(still.root, parts, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_split_appears_whole_or_not_at_all(still: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = curation.extract

    def fails(dataset: Path, episodes: list[int], out: Path) -> int:
        if out.name == "b":
            raise OSError("the disk is full")
        return whole(dataset, episodes, out)

    monkeypatch.setattr(curation, "extract", fails)
    with pytest.raises(OSError, match="full"):
        split(still.root, {"a": [0], "b": [1]}, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    with raises_code(CommandError, "output_exists"):
        split(still.root, {"a": [0]}, tmp_path / "out")
