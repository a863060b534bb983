"""``hal generate`` as a program: workers and the program itself are killed, and the rows are those of one worker.

One kill here; HAL_GENERATE_KILLS=20 does more.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from recording_layout import check_layout
from waiting import wait_until

from hal.recording import Dataset

ROOT = Path(__file__).resolve().parents[2]
KILLS = int(os.environ.get("HAL_GENERATE_KILLS", "1"))
EPISODES = 2 * KILLS + 1


def command(out: Path, *more: str) -> list[str]:
    """Return the command line of a run; its seconds are simulated."""
    program = [sys.executable, str(ROOT / "apps" / "generate.py"), "--skill", "pick:pick", "--sim", "--fps", "15"]
    return [*program, "--set", "cameras={}", "--episodes", str(EPISODES), "--out", str(out), *more]


def start(out: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(command(out, *more), cwd=ROOT / "examples", stdout=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset that one worker generates."""
    out = tmp_path_factory.mktemp("one") / "out"
    app = start(out)
    assert app.wait(100.0) == 0
    return out


def check_same(out: Path, expected: Path, episodes: int = EPISODES) -> None:
    """Check that a dataset has every episode once, with the expected rows, and that nothing else is left."""
    check_layout(out)
    found, wanted = Dataset(out).episodes, Dataset(expected).episodes[:episodes]
    assert [episode.info["seed"] for episode in found] == list(range(episodes))
    for one, other in zip(found, wanted, strict=True):
        assert one.success, "the cube was lifted"
        for key, values in other.columns.items():
            assert one.columns[key].tobytes() == values.tobytes(), (one.number, key)
    if episodes == EPISODES:
        assert (out / "meta/stats.json").read_bytes() == (expected / "meta/stats.json").read_bytes()
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def workers(pid: int) -> list[int]:
    """Return the child processes of a program."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def saved(out: Path) -> int:
    return len(list(out.with_name("out.parts").glob("worker-*/episodes/*.json")))


def wait_for_episodes(app: subprocess.Popen[str], out: Path, count: int) -> None:
    deadline = time.monotonic() + 60.0
    while saved(out) < count and app.poll() is None:
        assert time.monotonic() < deadline, "no episode was saved"
        time.sleep(0.01)


@pytest.mark.slow
def test_killed_workers_lose_and_double_nothing(tmp_path: Path, expected: Path) -> None:
    out = tmp_path / "out"
    app = start(out, "--workers", "2")
    kills = 0
    while kills < KILLS and app.poll() is None:
        wait_for_episodes(app, out, 1 + 2 * kills)
        time.sleep(0.2)  # by then another one is being made
        for pid in workers(app.pid)[:1]:
            os.kill(pid, signal.SIGKILL)
            kills += 1
    printed, _ = app.communicate(timeout=100.0)
    assert app.returncode == 0, printed
    assert kills == KILLS
    check_same(out, expected)


@pytest.mark.slow
def test_an_interrupted_run_continues_and_its_workers_end(tmp_path: Path, expected: Path) -> None:
    out = tmp_path / "out"
    for number, count in ((signal.SIGTERM, 1), (signal.SIGKILL, 2)):
        app = start(out, "--workers", "2")
        wait_for_episodes(app, out, count)
        wait_until(lambda app=app: workers(app.pid), "working")
        children = workers(app.pid)
        app.send_signal(number)
        app.wait(60.0)
        wait_until(lambda left=children: not any(Path(f"/proc/{pid}").exists() for pid in left), "without workers")
        assert not out.exists()
        assert saved(out) >= count
    done = subprocess.run(command(out), cwd=ROOT / "examples", capture_output=True, text=True, timeout=100.0)
    assert done.returncode == 0, done.stderr
    assert "new)" in done.stdout, "the finished episodes were kept"
    check_same(out, expected)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="pip install 'robot-hal[ray]'")
def test_a_ray_cluster_of_this_computer_makes_the_same_rows(tmp_path: Path, expected: Path) -> None:
    run = command(tmp_path / "out", "--workers", "1", "--ray", "local", "--episodes", "1")
    done = subprocess.run(run, cwd=ROOT / "examples", capture_output=True, text=True, timeout=110.0)
    assert done.returncode == 0, done.stderr
    check_same(tmp_path / "out", expected, episodes=1)


WATCHED = """
import os, tempfile
from pathlib import Path
from pick import pick as picked


def pick(rig, random):
    node = Path(tempfile.gettempdir())
    with open(os.environ["WATCH"], "a") as file:
        file.write(f"{node.name} {os.environ['CUDA_VISIBLE_DEVICES']} {len(list(node.iterdir()))} {__file__}\\n")
    return picked(rig, random)
"""


@pytest.fixture
def nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a cluster of two nodes, each with a processor, two graphics cards, and a temporary folder."""
    pytest.importorskip("ray", reason="pip install 'robot-hal[ray]'")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # the loopback address stays what it is
    from ray.cluster_utils import Cluster

    own = {"node_ip_address": "127.0.0.1", "include_dashboard": False, "object_store_memory": 80_000_000}
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as ray:
        monkeypatch.setenv("RAY_TMPDIR", ray)  # where a cluster leaves its address, in a folder that has to exist
        (Path(ray) / "ray").mkdir()
        cluster = Cluster(True, head_node_args={**own, "num_cpus": 0, "temp_dir": ray})
        try:
            for name in ("node_0", "node_1"):
                (tmp_path / name).mkdir()
                cluster.add_node(num_cpus=1, num_gpus=2, env_vars={"TMPDIR": str(tmp_path / name)}, **own)
            yield cluster.address
        finally:
            cluster.shutdown()


@pytest.mark.slow
def test_nodes_without_a_shared_folder_upload_what_they_make(nodes: str, tmp_path: Path, expected: Path) -> None:
    pytest.importorskip("fsspec", reason="pip install 'robot-hal[ray]'")
    watch, program, out = tmp_path / "watch.txt", tmp_path / "program", tmp_path / "result" / "out"
    program.mkdir(), out.parent.mkdir()
    (program / "pick.py").write_bytes((ROOT / "examples" / "pick.py").read_bytes())
    (program / "watched.py").write_text(WATCHED)
    (program / "environment.yaml").write_text(f"working_dir: .\nenv_vars: {{WATCH: {watch}}}\n")
    options = ["--workers", "3", "--ray", nodes, "--gpus", "0.5", "--runtime-env", "environment.yaml"]
    run = command(out, *options, "--upload", (tmp_path / "bucket").as_uri(), "--skill", "watched:pick")
    done = subprocess.run(run, cwd=program, capture_output=True, text=True, timeout=200.0)
    assert done.returncode == 0, done.stdout + done.stderr
    found = [line.split() for line in watch.read_text().splitlines()]
    assert {place for place, *_ in found} == {"node_0", "node_1"}
    assert {cards for _, cards, *_ in found} <= {"0", "1"}
    assert {files for _, _, files, _ in found} == {"1"}, "the temporary folder of the one worker that has room there"
    assert not any(Path(module).is_relative_to(program) for *_, module in found), "each node has a copy"
    check_same(out, expected)
    assert not any(path.is_file() for name in ("node_0", "node_1", "bucket") for path in (tmp_path / name).rglob("*"))
