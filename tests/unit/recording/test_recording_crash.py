"""A recording may end at any byte and at any step; what is whole stays, and recovering twice does nothing twice."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from recording_kit import check_layout, drive, kill_writer, mock_rig, record

from hal.errors import ConnectionLost
from hal.recording import Dataset, Recorder, finish, layout, recover
from hal.recording.live import LiveContent


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One finished episode, and one whose writer was killed."""
    out = tmp_path_factory.mktemp("torn") / "out"
    with mock_rig() as rig, Recorder(rig, out, task="lift") as recorder:
        record(recorder, 0.3)
        recorder.start(seed=2)
        drive(rig, 0.5)
        kill_writer(recorder)
        with pytest.raises(ConnectionLost, match="ended"):
            recorder.save(wait=True)
    (folder,) = out.glob("episodes/*.partial")
    assert folder.name == "000001.partial"
    return out


@pytest.fixture
def out(torn: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(torn, tmp_path / "out"))


def test_what_a_killed_writer_leaves_becomes_an_episode(out: Path) -> None:
    first = Dataset(out).episodes[0]
    assert len(Dataset(out)) == 1, "it opens before it is recovered, with what was finished"
    assert recover(out) == ["000001.partial was not finished: recovered as episode 1"]
    check_layout(out)
    episode = Dataset(out).episodes[1]
    assert episode.success is None
    assert episode.info["recovered"] is True
    assert (episode.info["seed"], episode.task) == (2, "lift")
    assert episode.length >= 10, "of some 17"
    assert np.array_equal(Dataset(out).episodes[0].columns["action"], first.columns["action"])
    assert recover(out) == []
    with mock_rig() as rig, Recorder(rig, out, task="lift") as recorder:
        record(recorder, 0.3)
        assert recorder.notes == []
    check_layout(out)


@pytest.mark.parametrize("mark", [True, False])
def test_the_mark_survives_a_killed_writer(tmp_path: Path, mark: bool) -> None:
    with mock_rig() as rig, Recorder(rig, tmp_path / "out") as recorder:
        record(recorder, 0.3)
        recorder.start()
        drive(rig, 1.0)
        kill_writer(recorder)
        with pytest.raises(ConnectionLost):
            recorder.save(mark, wait=True)
    recover(tmp_path / "out")
    episode = Dataset(tmp_path / "out").episodes[1]
    assert (episode.success, episode.info["recovered"]) == (mark, True)
    assert check_layout(tmp_path / "out")["total_episodes"] == 2


def test_the_next_recording_recovers_by_itself(out: Path) -> None:
    with mock_rig() as rig, Recorder(rig, out) as recorder:
        record(recorder, 0.2)
        assert recorder.notes == ["000001.partial was not finished: recovered as episode 1"]
        assert recorder.status().episode == 2
    assert check_layout(out)["total_episodes"] == 3


@pytest.mark.parametrize("name", ["rows.arrow", "scene.mp4", "wrist.depth"])
def test_a_live_file_may_end_at_any_byte(torn: Path, tmp_path: Path, name: str) -> None:
    whole = next(torn.glob("episodes/*.partial"))
    size = (whole / name).stat().st_size
    lengths = []
    for end in [0, 1, 20, *np.linspace(21, size, 40, dtype=int).tolist()]:
        folder = Path(shutil.copytree(whole, tmp_path / "cut"))
        with (folder / name).open("rb+") as file:
            file.truncate(end)
        try:
            lengths.append(LiveContent(folder).length)
        except ValueError:  # not even its first line
            lengths.append(0)
        shutil.rmtree(folder)
    assert lengths == sorted(lengths)
    assert lengths[0] == 0
    assert lengths[-1] == LiveContent(Path(shutil.copytree(whole, tmp_path / "again"))).length >= 10
    assert len(set(lengths)) > 5


@pytest.mark.parametrize("gone", ["about.json", "rows.arrow", "scene.mp4"])
def test_an_episode_of_which_nothing_can_be_read_is_removed(out: Path, gone: str) -> None:
    next(out.glob("episodes/*.partial")).joinpath(gone).unlink()
    assert recover(out) == ["000001.partial held no whole row and was removed"]
    assert check_layout(out)["total_episodes"] == 1


class Killed(BaseException):
    """Stands for the end of the process."""


@pytest.mark.slow
def test_it_may_be_killed_at_every_step_of_finishing(
    torn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file that is synced and every rename is a step; after each, the dataset opens and can be recovered."""
    steps = [0]
    at = [-1]

    def counted(act):  # type: ignore[no-untyped-def]
        def step(*args: object, **more: object) -> object:
            steps[0] += 1
            if steps[0] == at[0]:
                raise Killed
            return act(*args, **more)

        return step

    monkeypatch.setattr(layout, "sync_to_disk", counted(layout.sync_to_disk))
    monkeypatch.setattr(finish, "sync_to_disk", counted(finish.sync_to_disk))
    monkeypatch.setattr(Path, "replace", counted(Path.replace))
    monkeypatch.setattr(Path, "rename", counted(Path.rename))
    monkeypatch.setattr(shutil, "rmtree", counted(shutil.rmtree))

    reference = Path(shutil.copytree(torn, tmp_path / "reference"))
    recover(reference)
    total = steps[0]
    want = Dataset(reference).episodes[1].columns["action"]
    frames = list(Dataset(reference).episodes[1].frames("wrist"))
    assert total > 30
    for step in range(1, total + 1):
        at[0] = -1
        out = Path(shutil.copytree(torn, tmp_path / f"killed{step}"))
        steps[0], at[0] = 0, step
        with pytest.raises(Killed):
            recover(out)
        at[0] = -1
        assert len(Dataset(out)) in (1, 2)
        for episode in Dataset(out).episodes:
            assert len(episode.columns["action"]) == episode.length
            assert sum(1 for _ in episode.frames("scene")) == episode.length
        recover(out)
        assert check_layout(out)["total_episodes"] == 2, f"killed at step {step}"
        assert np.array_equal(Dataset(out).episodes[1].columns["action"], want)
        assert all(np.array_equal(a, b) for a, b in zip(Dataset(out).episodes[1].frames("wrist"), frames, strict=True))
        stats = (out / "meta/stats.json").read_text()
        assert stats == (reference / "meta/stats.json").read_text(), "nothing counts twice"
        assert not list(out.glob("episodes/*.removed"))
        shutil.rmtree(out)
