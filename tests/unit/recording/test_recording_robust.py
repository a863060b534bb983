"""Misuse of a recorder, and unusual but valid uses."""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import check_layout, check_stamps, drive, kill_writer, mock_rig, record

import hal
from hal.errors import CommandError, ConnectionLost, HalError
from hal.recording import Dataset, Recorder, recover
from hal.rig import Rig


@pytest.fixture
def rig() -> Iterator[Rig]:
    with mock_rig() as opened:
        yield opened


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


# Time.


@pytest.mark.parametrize("first", [0, 1])
def test_two_recorders_at_once_end_in_any_order(rig: Rig, tmp_path: Path, first: int) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    with Recorder(rig, folders[0], fps=30) as a, Recorder(rig, folders[1], fps=20) as b:
        recorders = (a, b)
        a.start()
        rig.clock.sleep(0.5)
        b.start()
        rig.clock.sleep(0.5)
        recorders[first].save(wait=True)
        rig.clock.sleep(0.5)
        recorders[1 - first].save(wait=True)
        rig.clock.sleep(0.5)
    spans = [[1.0, 1.0], [1.5, 0.5]]  # s, of each recorder
    for k, (folder, fps) in enumerate(zip(folders, (30, 20), strict=True)):
        check_layout(folder)
        episode = Dataset(folder).episodes[0]
        check_stamps(episode)
        assert episode.length == round(spans[first][k] * fps) + 1
        assert np.allclose(np.diff(episode.stamps["grid"]), 1 / fps, atol=0.005)


def test_rows_after_save_are_not_part_of_the_episode(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        for _ in range(2):
            recorder.start()
            rig.clock.sleep(0.2)
            now = rig.clock.now()
            recorder.save()
            rig.clock.sleep(1.0)  # the episode is being finished meanwhile
            recorder.wait_saved()
            assert recorder.episodes == recorder.status().episode + 1
            recorder.start()  # and the next one waits for that
            assert recorder.status().state == "recording"
            recorder.discard()
            assert Dataset(out).episodes[-1].stamps["grid"][-1] == pytest.approx(now, abs=0.005)
            assert Dataset(out).episodes[-1].length == 7
    assert check_layout(out)["total_episodes"] == 2


def test_ten_seconds_may_pass_in_one_step(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        recorder.start()
        rig.clock.sleep(10.0)
        recorder.save(wait=True)
    check_layout(out)
    episode = Dataset(out).episodes[0]
    assert (episode.length, episode.info["gaps"]) == (301, [])
    check_stamps(episode)


def test_a_simulation_cannot_be_recorded_faster_than_it_steps(rig: Rig, out: Path) -> None:
    with hal.open("panda_table", driver="mock", overrides=["simulation.physics_hz=100"]) as slow:
        steps = 1.0 / _step(slow)
        with raises_code(CommandError, "bad_fps"):
            Recorder(slow, out, fps=math.ceil(steps) + 1)
    with Recorder(rig, out, fps=24.0) as recorder:  # type: ignore[arg-type]
        record(recorder, 0.2)
    assert check_layout(out)["fps"] == 24


def _step(rig: Rig) -> float:
    before = rig.clock.now()
    rig.clock.sleep(1e-6)
    return rig.clock.now() - before


# Threads.


def test_any_thread_may_start_save_and_discard(rig: Rig, out: Path) -> None:
    """Each call succeeds or raises its error; saved episodes exist."""
    saved: list[bool] = []
    odd: list[BaseException] = []

    def save() -> None:
        recorder.save(wait=len(saved) % 2 == 0)
        saved.append(True)

    def work(turn: int) -> None:
        acts = (recorder.start, save, recorder.discard)[turn : turn + 2]
        for k in range(6):
            try:
                acts[k % 2]()
            except CommandError:
                pass
            except BaseException as error:
                odd.append(error)

    with Recorder(rig, out) as recorder:
        threads = [threading.Thread(target=work, args=(turn,)) for turn in (0, 0, 1, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
        assert not odd
        still_open = recorder.status().state == "recording"
    assert saved, "not one was saved"
    assert check_layout(out)["total_episodes"] == len(saved) + still_open
    assert recover(out) == []


def test_an_episode_ends_while_another_thread_advances_time(rig: Rig, out: Path) -> None:
    stop = threading.Event()

    def go_on() -> None:
        while not stop.wait(0.001):
            rig.clock.sleep(0.3)

    thread = threading.Thread(target=go_on)
    with Recorder(rig, out) as recorder:
        thread.start()
        try:
            lengths = []
            for _ in range(4):
                recorder.start()
                while recorder.status().frames < 5:
                    stop.wait(0.001)
                recorder.save(wait=True)
                lengths.append(recorder.status().frames)
        finally:
            stop.set()
            thread.join(30.0)
    check_layout(out)
    assert [episode.length for episode in Dataset(out).episodes] == lengths, "not a row is counted and not written"


# Nothing to save, and failures in the background.


def test_episodes_of_one_row_and_of_none(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        recorder.start()
        recorder.save(wait=True)
        rig.driver("panda").inject(disconnect=True)
        rig.clock.sleep(0.1)
        recorder.start()
        assert (recorder.status().frames, recorder.status().dropped) == (0, 1)
        with raises_code(CommandError, "no_rows"):
            recorder.save(wait=True)
        recorder.start()
        recorder.save()
        rig.driver("panda").inject(disconnect=False)
        rig.clock.sleep(0.2)
        recorder.start()
        assert "no row was recorded" in recorder.notes[-1], "the reason of a failure in the background"
        rig.clock.sleep(0.1)
        recorder.save(wait=True)
    assert check_layout(out)["total_episodes"] == 2
    assert [episode.length for episode in Dataset(out).episodes] == [1, 4]


@pytest.mark.slow
def test_in_real_time_even_the_shortest_episode_has_a_row(out: Path) -> None:
    with mock_rig("real_time") as rig, Recorder(rig, out) as recorder:
        for _ in range(5):
            recorder.start()
            recorder.save(wait=True)
    assert check_layout(out)["total_episodes"] == 5


def test_a_discarded_episode_does_not_come_back(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        recorder.start()
        drive(rig, 0.2)
        kill_writer(recorder)
        recorder.discard()
        record(recorder, 0.2)
        assert recorder.notes == []
    assert check_layout(out)["total_episodes"] == 1


def test_a_rig_that_is_closed_first(out: Path) -> None:
    with mock_rig() as rig:
        recorder = Recorder(rig, out)
        recorder.start()
        rig.clock.sleep(0.3)
    recorder.save(wait=True)
    with pytest.raises(ConnectionLost):
        recorder.start()
    assert recorder.status().state == "idle"
    recorder.close()
    assert check_layout(out)["total_frames"] == 10


# Folders, names and values.


@pytest.mark.parametrize("name", ["-rf", "ä%03d?#&'\" x:y", "gone/{number}/away"])
def test_any_folder_name_works(rig: Rig, tmp_path: Path, name: str) -> None:
    with Recorder(rig, tmp_path / name, task="") as recorder:
        record(recorder, 0.1)
    check_layout(tmp_path / name)
    episode = Dataset(tmp_path / name).episodes[0]
    assert sum(1 for _ in episode.frames("wrist")) == sum(1 for _ in episode.depth("wrist")) == episode.length


def test_a_relative_folder_is_one_of_where_the_recorder_was_made(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with Recorder(rig, "out") as recorder:
        (tmp_path / "elsewhere").mkdir()
        os.chdir("elsewhere")
        record(recorder, 0.1)
        assert recorder.root == tmp_path / "out"
    check_layout(tmp_path / "out")
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_folder_that_cannot_be_created_is_an_error_and_may_be_fixed(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "a").write_text("a file")
    with Recorder(rig, tmp_path / "a" / "b") as recorder:
        for _ in range(2):
            with raises_code(CommandError, "cannot_write"):
                recorder.start()
            assert recorder.status().state == "idle"
        rig.clock.sleep(0.1)
        (tmp_path / "a").unlink()
        record(recorder, 0.1)
    assert check_layout(tmp_path / "a" / "b")["total_frames"] > 3


def test_a_task_may_be_any_text_and_a_seed_any_whole_number(rig: Rig, out: Path) -> None:
    tasks = ["", "lift\nthe cube", "Würfel 🎲", "'; --"]
    with Recorder(rig, out) as recorder:
        for task in tasks:
            recorder.task = task
            recorder.start(seed=np.int64(7), info={"n": 1})  # type: ignore[arg-type]
            recorder.save(wait=True)
        for wrong in ("caf\udce9", None, 3):
            recorder.task = wrong  # type: ignore[assignment]
            with raises_code(CommandError, "bad_metadata"):
                recorder.start()
        recorder.task = "fine"
        for seed in (1.5, "one"):
            with raises_code(CommandError, "bad_metadata"):
                recorder.start(seed=seed)  # type: ignore[arg-type]
        for value in (math.nan, np.float32(1.0), b"raw"):
            with raises_code(CommandError, "bad_metadata"):
                recorder.start(info={"value": value})
        assert recorder.status().state == "idle"
    assert check_layout(out)["total_tasks"] == len(tasks)
    assert [(episode.task, episode.info["seed"]) for episode in Dataset(out).episodes] == [(t, 7) for t in tasks]


# What others left behind.


def test_an_unfinished_episode_that_is_damaged_is_named(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        recorder.start()
        drive(rig, 0.2)
        kill_writer(recorder)
        with pytest.raises(ConnectionLost):
            recorder.save(wait=True)
        (partial,) = out.glob("episodes/*.partial")
        about = json.loads((partial / "about.json").read_text())
        (partial / "about.json").write_text(json.dumps({"features": about["features"]}))
        for use in (recorder.start, lambda: recover(out)):
            with raises_code(HalError, "damaged_episode"):
                use()
        partial.rename(out.parent / "broken")
        record(recorder, 0.1)
    assert check_layout(out)["total_episodes"] == 1
