"""``apps/review.py`` and ``apps/export.py`` as programs, and an episode for the rerun viewer."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from recording_kit import make_recording

from hal.recording import Dataset

APPS = Path(__file__).resolve().parents[2] / "apps"
needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None,
    reason="pip install 'robot-hal[review]'",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("apps") / "demo").root


def run(app: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(APPS / app), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_the_programs_print_what_they_did(folder: Path, tmp_path: Path) -> None:
    done = run("review.py", folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{folder}: 3 episodes of panda, 30 rows at 20 Hz, 1.5 s\n")
    command = ("export.py", folder, "--to", "npz", "--out", tmp_path / "out")
    done = run(*command)
    assert (done.returncode, done.stderr) == (0, ""), "progress is for a terminal"
    done = run(*command)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_an_episode_is_marked_and_another_deleted_on_the_page(tmp_path: Path) -> None:
    root = make_recording(tmp_path / "demo").root
    command = [sys.executable, str(APPS / "review.py"), str(root), "--page"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        link = next(line.strip() for line in program.stdout if line.strip().startswith("http"))
        own, token = link.split("/#")

        def ask(
            path: str, method: str = "GET", token: str = token, origin: str = own, host: str = ""
        ) -> tuple[int, str]:
            headers = {"Authorization": f"Bearer {token}", "Origin": origin} | ({"Host": host} if host else {})
            try:
                with urlopen(Request(own + path, method=method, headers=headers), timeout=30) as answer:
                    return answer.status, answer.read().decode()
            except HTTPError as error:
                return error.code, error.read().decode()

        try:
            listing, jerky = ask("/episodes/0")[1], ask("/episodes/5")[1]
            assert re.findall(r'data-row="(\d)"', listing) == ["0", "1", "2"]
            jerks = [float(row.split("</td><td>")[4]) for row in jerky.split("<tr data-row")[1:]]
            assert jerks == sorted(jerks, reverse=True)
            assert jerks[0] > 0.0
            sheet = ask("/sheet/1")[1]
            assert sheet.count("<image ") == 16, "eight pictures of each camera"
            for step in ("/mark/0/3/failure", "/delete/2/3"):
                assert step in listing + ask("/sheet/0")[1] + ask("/sheet/2")[1], "a button of the page"
                wrong = ({"token": "another"}, {"origin": "http://example.com"}, {"host": "example.com"})
                assert [ask(step, "POST", **one)[0] for one in wrong] == [403, 403, 421]
                assert ask(step)[0] == 404, "a link changes nothing"
                assert [one.success for one in Dataset(root).episodes][:1] == [step.startswith("/mark")]
                assert ask(step, "POST")[0] == 200
            assert ask("/delete/0/3", "POST")[0] == 409, "a page that shows what is gone deletes nothing"
            assert ask("/sheet/0", token="")[0] == 403
        finally:
            program.send_signal(signal.SIGINT)
        assert program.wait(30) == 0
    assert [episode.success for episode in Dataset(root).episodes] == [False, False]
    assert run("review.py", root).stdout.splitlines()[1].startswith("0 succeeded (0 % of those marked), 2 failed")


@needs_rerun
def test_an_episode_for_rerun(folder: Path, tmp_path: Path) -> None:
    """Read again by rerun's own program, with its analytics disabled."""
    path = tmp_path / "look.rrd"
    done = run("review.py", folder, "--episode", "0", "--rrd", path)
    assert done.returncode == 0, done.stderr
    assert not folder.with_name("demo_episode_000000.svg").exists(), "only what was asked for"
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
