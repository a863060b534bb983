"""A recording may end at any byte and at any step; what is whole stays, and recovering twice does nothing twice."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recording_kit import check_layout, drive, kill_writer, mock_rig, record

from hal.errors import ConnectionLost
from hal.recording import Dataset, Recorder, changing, finish, layout, mark_episodes, recover
from hal.recording.checking import check_dataset
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


def test_a_mark_of_an_open_dataset_finishes_what_a_killed_writer_left(out: Path) -> None:
    mark_episodes(Dataset(out), {0: False})
    assert [episode.success for episode in Dataset(out).episodes] == [False, None]


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


class Steps:
    """Counts every file that is synced, every rename and every removal of a folder; at one of them the process ends."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done = 0
        self.fatal = -1
        for module in (layout, finish, changing):
            monkeypatch.setattr(module, "sync_to_disk", self._counted(layout.sync_to_disk))
        for owner, name in ((Path, "replace"), (Path, "rename"), (shutil, "rmtree")):
            monkeypatch.setattr(owner, name, self._counted(getattr(owner, name)))

    def _counted(self, act: Callable[..., object]) -> Callable[..., object]:
        def step(*args: object, **more: object) -> object:
            self.done += 1
            if 0 < self.fatal <= self.done:  # what the program does about it is not done, either
                raise Killed
            return act(*args, **more)

        return step

    def kill_at(self, step: int, act: Callable[[], object]) -> None:
        """Do something, and be killed at a step of it."""
        self.done, self.fatal = 0, step
        with pytest.raises(Killed):
            act()
        self.fatal = -1


@pytest.mark.slow
def test_it_may_be_killed_at_every_step_of_finishing(
    torn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After each step the dataset opens and can be recovered."""
    steps = Steps(monkeypatch)
    reference = Path(shutil.copytree(torn, tmp_path / "reference"))
    recover(reference)
    total = steps.done
    want = Dataset(reference).episodes[1].columns["action"]
    frames = list(Dataset(reference).episodes[1].frames("wrist"))
    assert total > 30
    for step in range(1, total + 1):
        out = Path(shutil.copytree(torn, tmp_path / f"killed{step}"))
        steps.kill_at(step, lambda: recover(out))  # noqa: B023
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


@pytest.mark.slow
def test_it_may_be_killed_at_every_step_of_a_mark(torn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After each step the dataset opens with the marks before or after; the next change, or recovery, completes it."""
    before = Path(shutil.copytree(torn, tmp_path / "before"))
    recover(before)
    linked = tmp_path / "linked"
    shutil.copytree(before, linked, copy_function=os.link)
    steps = Steps(monkeypatch)
    after = Path(shutil.copytree(before, tmp_path / "after"))
    marks = {0: False, 1: True}
    mark_episodes(after, marks)
    total, seen = steps.done, set()
    assert [episode.success for episode in Dataset(before).episodes] == [True, None]
    for step in range(1, total + 1):
        out = Path(shutil.copytree(linked, tmp_path / "killed", copy_function=os.link))
        steps.kill_at(step, lambda: mark_episodes(out, marks))  # noqa: B023
        found = [episode.success for episode in Dataset(out).episodes]
        seen.add(tuple(found))
        for was, now, asked in zip((True, None), found, marks.values(), strict=True):
            assert now in (was, asked)
        made = (out / "episodes/change.partial/list.json").exists() or found == [False, True]
        expected = [False, True] if made else [True, None]
        if step % 2:
            recover(out)
        else:
            mark_episodes(out, dict(enumerate(expected)))
        assert [episode.success for episode in Dataset(out).episodes] == expected
        assert not list(check_dataset(Dataset(out)))
        assert (content(out) == content(after)) is made
        shutil.rmtree(out)
    assert {(True, None), (False, True)} <= seen
    assert content(linked) == content(before), "files that are linked elsewhere stay as they are there"


def content(root: Path) -> dict[str, bytes]:
    """Return the content of every file of a dataset, by its name."""
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*.*") if path.is_file()}
