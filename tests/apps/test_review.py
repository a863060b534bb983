"""The review as a person starts it."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from app_kit import run_here
from PIL import Image
from recording_kit import make_recording

from hal.apps import export, review

ROOT = Path(__file__).resolve().parents[2]
needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None,
    reason="pip install 'robot-hal[review]'",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("apps") / "demo").root


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "apps" / "review.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


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
    assert sum(line.startswith("panda_joint") for line in lines) == 7
    assert sum(line.startswith(("robot.", "gripper.", "camera.")) for line in lines) == 4


def test_an_episode_is_a_picture(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "look.png"
    done = run(folder, "--episode", "1", "--png", path, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["episodes"][0]["number"] == 1, "only JSON on the standard output"
    assert f"wrote {path}" in done.stderr
    with Image.open(path) as image:
        image.load()
        assert image.size[0] == 1600
    again = run(folder, "--episode", "1", "--png", path)
    assert again.returncode == 2
    assert "--force overwrites it" in again.stderr
    beside = folder.with_name("demo_episode_000002.png")
    assert f"wrote {beside}" in run(folder, "--episode", "2").stdout
    assert beside.is_file()


def test_what_is_wrong_is_said_in_words(folder: Path) -> None:
    for wrong, says in ((("--episode", "7"), "no episode 7"), (("--png", "x.png"), "which with --episode")):
        done = run(folder, *wrong)
        assert done.returncode == 2
        assert says in done.stderr
        assert "Traceback" not in done.stderr


def test_a_damaged_episode_is_told_and_is_the_exit_status(tmp_path: Path) -> None:
    root = make_recording(tmp_path / "demo").root
    (root / "data/chunk-000/file-002.parquet").unlink()
    done = run(root)
    assert done.returncode == 2
    assert "cannot be read: episode 2: " in done.stdout
    assert "2 episodes of panda, 23 rows" in done.stdout


def test_a_simulation_that_was_too_slow_is_told(tmp_path: Path) -> None:
    root = make_recording(tmp_path / "demo").root
    assert "real time" not in run(root).stdout
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


@needs_rerun
def test_an_episode_for_rerun(folder: Path, tmp_path: Path) -> None:
    """Read again by rerun's own program, which must not tell anybody that it was."""
    path = tmp_path / "look.rrd"
    done = run(folder, "--episode", "0", "--rrd", path)
    assert done.returncode == 0, done.stderr
    assert not folder.with_name("demo_episode_000000.png").exists(), "only what was asked for"
    assert path.read_bytes()[:4] == b"RRF2"

    home = {**os.environ, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}

    def rerun(*arguments: str) -> str:
        command = [sys.executable, "-m", "rerun", *arguments]
        return subprocess.run(command, env=home, capture_output=True, text=True, timeout=60, check=True).stdout

    rerun("analytics", "disable")
    rerun("rrd", "verify", str(path))
    rows: dict[tuple[str, str], int] = {}
    for line in rerun("rrd", "print", str(path)).splitlines():  # a chunk; slow logging makes several of one thing
        if match := re.match(r"Chunk\(\w+\) with (\d+) rows .* - /(\S+) - data columns: \[(\w+):", line):
            thing = (match[2], match[3])
            rows[thing] = rows.get(thing, 0) + int(match[1])
    for place, kind in (
        ("joints/panda/panda_joint7/measured", "Scalars"),
        ("gripper/panda/commanded", "Scalars"),
        ("world/panda/tcp", "Transform3D"),
        ("world/cameras/scene", "Transform3D"),
        ("world/cameras/wrist/rgb", "EncodedImage"),
        ("world/cameras/scene/depth", "EncodedDepthImage"),
    ):
        assert rows.get((place, kind)) == 14, place
    assert rows["world/cameras/scene", "Pinhole"] == 1
    assert rows["status/panda", "TextLog"] == 3, "idle, following, stopped"


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
        assert f"hal-review {root} --repair" in done.stderr
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
    done = run_here(review.main, root, "--repair")
    assert done.returncode == 2
    assert f"cannot be repaired: episode 2: {file}: " in done.stdout
    assert "leave it out with hal-export --episodes" in done.stdout
    assert "leave it out with hal-export --episodes" in run_here(review.main, root).stdout
    done = run_here(review.main, root, "--check")
    assert done.stdout.count(file) == 1
    assert f"3 episodes checked, 1 problem(s); next: hal-review {root} --repair" in done.stdout

    assert run_here(export.main, root, "--to", "npz", "--episodes", "0-1").returncode == 0
    for path in [root / "episodes/000002.json", *root.glob("**/chunk-000/file-002.*")]:
        path.rename(tmp_path / str(path.relative_to(root)).replace("/", "_"))
    done = run_here(review.main, root, "--repair")
    assert (done.returncode, done.stdout.split(";")[0]) == (0, "the index was rebuilt from 2 episodes")
    assert run_here(review.main, root, "--check").stdout == "2 episodes checked, 0 problem(s)\n"


@pytest.mark.parametrize("file", ["meta/stats.json", "meta/tasks.parquet"])
def test_a_damaged_index_is_a_warning(tmp_path: Path, file: str) -> None:
    root = make_recording(tmp_path / "demo").root
    assert run_here(review.main, root).stderr == ""
    (root / file).write_bytes((root / file).read_bytes()[:100])
    (warning,) = run_here(review.main, root).stderr.splitlines()
    assert warning.startswith(f"warning: the index is damaged: {file}: cannot be read")
    assert warning.endswith(f"hal-review {root} --repair")
    assert run_here(review.main, root, "--repair").returncode == 0
    assert run_here(review.main, root).stderr == ""
