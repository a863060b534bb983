"""``apps/review.py`` in this process: statistics, pictures, checks and repairs of a dataset."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest
from app_kit import Done, run_here
from recording_kit import join_metadata, make_recording

from hal.apps import export, review
from hal.errors import HalError
from hal.recording import Dataset, Episode, mark_episodes, review_page
from hal.recording.review import EpisodeSummary, measure_episode
from hal.recording.review_page import ReviewServer, write_replay


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("apps") / "demo").root


def run(*arguments: str | Path) -> Done:
    return run_here(review.main, *arguments)


def test_a_dataset_is_a_table(folder: Path) -> None:
    done = run(folder)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == f"{folder}: 3 episodes of panda, 30 rows at 20 Hz, 1.5 s"
    assert lines[1] == "1 succeeded (50 % of those marked), 1 failed, 1 not marked"
    assert [line.split()[:6] for line in lines[5:8]] == [
        ["0", "14", "0.70", "success", "0", "1"],
        ["1", "9", "0.45", "failure", "0", "0"],
        ["2", "7", "0.35", "-", "0", "0"],
    ]
    assert sum(line.startswith(("robot.", "gripper.", "camera.")) for line in lines) == 4


def test_an_episode_is_a_picture(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "look.svg"
    done = run(folder, "--episode", "1", "--svg", path, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["episodes"][0]["number"] == 1, "only JSON on the standard output"
    assert f"wrote {path}" in done.stderr
    assert ElementTree.parse(path).getroot().get("width") == "1600"
    again = run(folder, "--episode", "1", "--svg", path)
    assert again.returncode == 2
    assert "--force" in again.stderr
    beside = folder.with_name("demo_episode_000002.svg")
    assert f"wrote {beside}" in run(folder, "--episode", "2").stdout
    assert beside.is_file()


def test_a_mistake_is_a_message(folder: Path) -> None:
    for wrong, says in ((("--episode", "7"), "no episode 7"), (("--svg", "x.svg"), "with --episode")):
        done = run(folder, *wrong)
        assert done.returncode == 2
        assert says in done.stderr


def test_a_damaged_episode_is_listed(tmp_path: Path) -> None:
    root = make_recording(tmp_path / "demo").root
    (root / "data/chunk-000/file-002.parquet").unlink()
    done = run(root)
    assert done.returncode == 2
    assert "cannot be read: episode 2: " in done.stdout
    assert "2 episodes of panda, 23 rows" in done.stdout


def test_a_slow_simulation_is_listed(tmp_path: Path) -> None:
    root = make_recording(tmp_path / "demo").root
    assert "real time" not in run(root).stdout
    join_metadata(root)
    for number, pace in ((0, 0.99), (1, 0.8912)):
        file = root / f"episodes/{number:06d}.json"
        about = json.loads(file.read_text())
        driver = about["rig"]["resolved"]["robots"][0]["driver"]
        about["rig"]["resolved"]["world"] = {"driver": driver}
        file.write_text(json.dumps(about | {"pace": {"panda": pace}}))
    done = run(root)
    told = [line for line in done.stdout.splitlines() if "real time" in line]
    assert told == ["episode 1: the simulation ran at 0.89 of real time; its speeds are too low"]
    assert done.returncode == 0
    found = json.loads(run(root, "--json").stdout)
    assert [line["pace"] for line in found["episodes"]] == [0.99, 0.8912, None]


def test_every_file_is_checked_and_a_lost_index_is_rebuilt(tmp_path: Path) -> None:
    root = make_recording(tmp_path / "demo").root
    done = run(root, "--check")
    assert (done.returncode, done.stdout) == (0, "3 episodes checked, 0 problem(s)\n"), done.stderr
    assert run(root, "--repair").stdout.startswith("nothing to repair")
    (root / "meta/info.json").unlink()
    for options in ([], ["--check"], ["--episode", "0"]):
        done = run(root, *options)
        assert done.returncode == 2
        assert done.stderr.startswith("DatasetError: meta/info.json: is missing")
        assert f"hal review {root} --repair" in done.stderr
    done = run(root, "--repair")
    assert done.stdout.startswith("the index was rebuilt from 3 episodes"), done.stderr
    video = root / "videos/observation.images.wrist/chunk-000/file-001.mp4"
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    done = run(root, "--check", "--json")
    assert done.returncode == 2
    (wrong,) = json.loads(done.stdout)["wrong"]
    assert wrong.startswith(f"episode 1: {video.relative_to(root)}: ")
    assert run(root, "--check", "--episode", "0").returncode == 0
    done = run(root)
    assert done.returncode == 2
    assert f"cannot be read: episode 1: {video.relative_to(root)}: " in done.stdout
    assert run(root, "--repair", "--episode", "0").returncode == 2


@pytest.mark.parametrize(
    "file",
    [
        "videos/observation.images.wrist/chunk-000/file-002.mp4",
        "depth/scene/chunk-000/file-002.depth",
        "data/chunk-000/file-002.parquet",
        "episodes/000002.json",
    ],
)
def test_a_truncated_episode_is_named_once_and_can_be_left_out(tmp_path: Path, file: str) -> None:
    root = make_recording(tmp_path / "demo").root
    damaged = root / file
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    done = run(root, "--repair")
    assert done.returncode == 2
    assert f"cannot be repaired: episode 2: {file}: " in done.stdout
    assert "leave it out with hal export --episodes" in done.stdout
    assert "leave it out with hal export --episodes" in run(root).stdout
    done = run(root, "--check")
    assert done.stdout.count(file) == 1
    assert f"3 episodes checked, 1 problem(s); next: hal review {root} --repair" in done.stdout

    assert run_here(export.main, root, "--to", "npz", "--episodes", "0-1").returncode == 0
    for path in [root / "episodes/000002.json", *root.glob("**/chunk-000/file-002.*")]:
        path.rename(tmp_path / str(path.relative_to(root)).replace("/", "_"))
    done = run(root, "--repair")
    assert (done.returncode, done.stdout.split(";")[0]) == (0, "the index was rebuilt from 2 episodes")
    assert run(root, "--check").stdout == "2 episodes checked, 0 problem(s)\n"


@pytest.mark.parametrize("file", ["meta/stats.json", "meta/tasks.parquet"])
def test_a_damaged_index_is_a_warning(tmp_path: Path, file: str) -> None:
    root = make_recording(tmp_path / "demo").root
    assert run(root).stderr == ""
    (root / file).write_bytes((root / file).read_bytes()[:100])
    (warning,) = run(root).stderr.splitlines()
    assert warning.startswith(f"warning: the index is damaged: {file}: cannot be read")
    assert warning.endswith(f"hal review {root} --repair")
    assert run(root, "--repair").returncode == 0
    assert run(root).stderr == ""


def test_the_page_reads_an_episode_again_only_after_another_program_changed_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, read = make_recording(tmp_path / "demo").root, list[int]()

    def measure(episode: Episode) -> EpisodeSummary:
        read.append(episode.number)
        return measure_episode(episode)

    monkeypatch.setattr(review_page, "measure_episode", measure)
    with ReviewServer(root, 0, b"") as server:

        def lines() -> list[int]:
            """Return which episodes are read for a list that is as one of a new server."""
            read.clear()
            assert [server.measure_episode(one) for one in server.read_dataset().episodes] == [
                measure_episode(one) for one in Dataset(root).episodes
            ]
            return read

        assert lines() == [0, 1, 2]
        assert lines() == []
        mark_episodes(root, {2: True})
        assert lines() == [2]
        server.mark_episode(server.read_dataset(), 1, True)
        assert lines() == []
        server.delete_episode(server.read_dataset(), 0)  # what is left gets new numbers, and shares a file
        assert lines() == []


def test_a_replay_finds_a_built_in_urdf_and_names_one_that_is_gone(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
    dataset = make_recording(tmp_path / "demo")
    (common,) = (dataset.root / "episodes").glob("common-*.json")
    text, urdf = common.read_text(), dataset.episodes[0].info["rig"]["resolved"]["robots"][0]["urdf"]
    common.write_text(text.replace(urdf, "/elsewhere/robots/panda.urdf"))
    assert "__VISER_EMBED_DATA__" in write_replay(Dataset(dataset.root).episodes[0])
    common.write_text(text.replace(urdf, "/elsewhere/mine.urdf"))
    with pytest.raises(HalError, match=r"/elsewhere/mine\.urdf"):
        write_replay(Dataset(dataset.root).episodes[0])
