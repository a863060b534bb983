"""Generation of datasets: what a worker makes of an episode, and what becomes of those of workers that die."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from errors_kit import raises_code

from hal.errors import CommandError, ConnectionLost
from hal.learning.episode_worker import EpisodeRecipe, EpisodeResult, EpisodeWorker
from hal.learning.generate import EpisodeFailed, GenerateProgress, WorkerHandle, generate
from hal.recording import Dataset

for library in ("pyarrow", "av", "zstandard"):
    pytest.importorskip(library, reason="pip install 'robot-hal[record]'")

MODULE = """
import hal

broken = True


def wait(rig, random):
    rig.clock.sleep(0.1 + 0.1 * random.random())
    return True


def various(rig, random):
    rig.clock.sleep(0.1)
    global seed
    seed += 1
    if seed == 1:
        rig.clock.sleep(100.0)
    if seed == 2:
        raise hal.CommandError("no such pose")
    if seed == 3:
        return False
    if seed == 4 and broken:
        raise ValueError("a mistake")
    if seed == 5 and broken:
        rig.world.pose("cbue")


def judge(rig, observation):
    return observation.t > 0.0


seed = 0
"""
RIG = {"config": "panda_table", "driver": "mock", "overrides": ["cameras={}"]}


@pytest.fixture
def skills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module of the skills, which is imported in this process."""
    (tmp_path / "skills.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    import skills

    yield skills
    del sys.modules["skills"]


class WorkerHere(WorkerHandle):
    """A worker in this process, which dies in some episodes: before or after they are saved."""

    before: list[int]
    after: list[int]

    def __init__(self, recipe: dict[str, Any], folder: str, index: int) -> None:
        self.worker = EpisodeWorker(recipe, folder)

    def make(self, number: int) -> EpisodeResult:
        if number in self.before:
            self.before.remove(number)
            raise ConnectionLost("killed")
        result = EpisodeResult(**self.worker.make(number))
        if number in self.after:
            self.after.remove(number)
            raise ConnectionLost("killed")
        return result

    def kill(self) -> None:
        self.worker.close()

    def close(self) -> None:
        self.worker.close()


def test_every_episode_is_made_once_although_workers_die(tmp_path: Path, skills: Any) -> None:
    recipe, out = EpisodeRecipe(RIG, skill="skills:wait", seed=5, task="wait"), tmp_path / "out"
    WorkerHere.before, WorkerHere.after = [0, 1, 1, 1], [2]
    seen: list[GenerateProgress] = []
    with pytest.raises(EpisodeFailed) as failed:
        generate(recipe, out, 3, start_worker=WorkerHere)
    assert (failed.value.code, failed.value.episode, failed.value.seed) == ("worker_dies", 1, 6)
    assert not out.exists()

    made = generate(recipe, out, 3, start_worker=WorkerHere, on_progress=seen.append)
    assert [result.number for result in made] == [1, 2], "the first one was there already"
    assert [result.seed for result in made] == [6, 7]
    assert seen[-1][:4] == (3, 3, 3, 3)
    episodes = Dataset(out).episodes
    assert [episode.info["seed"] for episode in episodes] == [5, 6, 7]
    assert len({episode.length for episode in episodes}) > 1, "the seed decides"
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(("out", "."))) == ["out"]

    assert generate(recipe, out, 3) == [], "nothing is left to do"
    rig = {**RIG, "engine": "mujoco"}
    for changed, count, code in (
        (replace(recipe, seed=4), 3, "other_recipe"),
        (replace(recipe, rig=rig, plan="0"), 3, "other_recipe"),
        (replace(recipe, plan="0"), 3, "other_recipe"),
        (recipe, 2, "fewer_episodes"),
    ):
        with raises_code(CommandError, code):
            generate(changed, out, count)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").touch()
    with raises_code(CommandError, "output_exists"):
        generate(recipe, tmp_path / "other", 3)


class WorkerWithoutPlace(WorkerHandle):
    """The first worker is ready, dies once, and records nothing; the others wait for ever, as in a small cluster."""

    deaths: list[int]

    def __init__(self, recipe: dict[str, Any], folder: str, index: int) -> None:
        self.index, self.killed = index, threading.Event()

    def wait_ready(self) -> None:
        if self.index:
            assert self.killed.wait(60.0)
            raise ConnectionLost("killed")

    def make(self, number: int) -> EpisodeResult:
        if number in self.deaths:
            self.deaths.remove(number)
            raise ConnectionLost("killed")
        return EpisodeResult(number, number, None, "done")

    def kill(self) -> None:
        self.killed.set()

    def close(self) -> None:
        self.killed.set()


def test_workers_without_a_place_are_no_dead_ones(tmp_path: Path) -> None:
    WorkerWithoutPlace.deaths, seen, events = [1, 3], list[GenerateProgress](), list[str]()
    made = generate(
        EpisodeRecipe(RIG, skill="skills:wait"),
        tmp_path / "out",
        4,
        workers=3,
        start_worker=WorkerWithoutPlace,
        on_progress=seen.append,
        on_event=events.append,
    )
    assert [result.number for result in made] == [0, 1, 2, 3]
    assert [(event.split()[1], event.split()[5].strip(",")) for event in events] == [("0", "1"), ("0", "3")]
    assert (seen[-1].restarts, seen[-1].waiting) == (2, 0)


@pytest.mark.slow
def test_uploaded_episodes_of_a_dead_worker_are_kept(tmp_path: Path, skills: Any) -> None:
    pytest.importorskip("fsspec", reason="pip install 'robot-hal[ray]'")
    recipe, address, out = EpisodeRecipe(RIG, skill="skills:wait"), (tmp_path / "bucket").as_uri(), tmp_path / "out"
    WorkerHere.before, WorkerHere.after = [2, 2, 2], [1]
    with raises_code(EpisodeFailed, "worker_dies"):
        generate(recipe, out, 3, upload=address, start_worker=WorkerHere)
    assert len(list(tmp_path.glob("bucket/*/*.true.zip"))) == 2
    assert not any(tmp_path.glob("out*/**/*.json")), "nothing is recorded beside the result"
    with raises_code(CommandError, "other_recipe"):
        generate(replace(recipe, seed=1), out, 3, upload=address, start_worker=WorkerHere)
    made = generate(recipe, out, 3, upload=address, start_worker=WorkerHere)
    assert [result.number for result in made] == [2], "the others were there"
    assert [episode.info["seed"] for episode in Dataset(out).episodes] == [0, 1, 2]
    assert [path for path in (tmp_path / "bucket").rglob("*") if path.is_file()] == []


def test_a_rig_file_of_the_program_is_found_in_the_working_directory(
    tmp_path: Path, skills: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []

    def refuse(**options: Any) -> None:
        opened.append(options["config"])
        raise CommandError("not now")

    monkeypatch.setattr("hal.open", refuse)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here.yaml").touch()
    for config in ("/elsewhere/rigs/a.yaml", str(tmp_path / "here.yaml"), "panda_table"):
        worker = EpisodeWorker(asdict(EpisodeRecipe({"config": config}, skill="skills:wait")), "part", (), "/elsewhere")
        assert worker.recipe.rig["config"] == config, "the same recipe on every computer"
        with pytest.raises(CommandError):
            worker.make(0)
    assert opened == [str(tmp_path / "rigs/a.yaml"), str(tmp_path / "here.yaml"), "panda_table"]


def test_how_a_skill_ends_decides_the_mark(tmp_path: Path, skills: Any) -> None:
    recipe = EpisodeRecipe(RIG, skill="skills:various", success="skills:judge", seconds=1.0)
    worker = EpisodeWorker(asdict(recipe), str(tmp_path / "part"))
    try:
        ends = [(result["success"], result["ended"]) for result in map(worker.make, range(5))]
        assert ends == [(False, "time"), (False, "stopped"), (False, "done"), (None, "error"), (None, "error")]
        skills.broken = False
        skills.seed = 3
        assert worker.make(3)["success"], "judged"
    finally:
        worker.close()
    episodes = Dataset(tmp_path / "part").episodes
    assert [episode.success for episode in episodes] == [False, False, False, True], "an error is not saved"
    assert [episode.length for episode in episodes] == [31, 4, 4, 4]
