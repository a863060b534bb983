"""``apps/review.py`` and ``apps/export.py`` as programs, and an episode for the rerun viewer."""

from __future__ import annotations

import base64
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")
pytest.importorskip("viser", reason="pip install 'robot-hal[viewer]'")

import msgspec
import zstandard
from app_kit import CROSS, PS, write_pad
from recording_kit import make_recording, small

from hal.apps import collect
from hal.geometry import Pose
from hal.recording import Dataset, Episode

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


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of a person: the arm moves up in the first, and rests in the others."""
    folder = tmp_path_factory.mktemp("collected")
    presses = [(1.0, CROSS), (1.4, "BTN_TL", 0.5), (2.6, PS), (4.0, CROSS), (4.5, PS), (6.0, CROSS), (6.5, PS)]
    pad = write_pad(folder, *presses, until=7.0, held=(1.2, 2.4))
    sets = [word for one in ("simulation.clock=lock_step", *small()) for word in ("--set", one)]
    command = ["--sim", *sets, "--no-depth", "--pad", pad, "--episodes", "3", "--out", str(folder / "data")]
    assert collect.main(command) == 0
    return folder / "data"


class Page:
    """``hal review --page`` as a program, and a browser's requests."""

    def __init__(self, root: Path) -> None:
        command = [sys.executable, str(APPS / "review.py"), str(root), "--page"]
        self.program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.program.stdout is not None
        link = next(line.strip() for line in self.program.stdout if line.strip().startswith("http"))
        self.own, self.token = link.split("/#")

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.program.send_signal(signal.SIGINT)
        assert self.program.wait(30) == 0

    def ask(
        self, path: str, method: str = "GET", token: str | None = None, origin: str = "", host: str = ""
    ) -> tuple[int, str]:
        headers = {"Authorization": f"Bearer {self.token if token is None else token}", "Origin": origin or self.own}
        headers |= {"Host": host} if host else {}
        try:
            with urlopen(Request(self.own + path, method=method, headers=headers), timeout=60) as answer:
                return answer.status, answer.read().decode()
        except HTTPError as error:
            return error.code, error.read().decode()


def last_poses(page: str) -> tuple[float, dict[str, Pose]]:
    """Return how long a replay is, s, and the pose of each node at its end, in its parent's frame."""
    found = re.search('__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found is not None
    inside = zstandard.ZstdDecompressor().decompressobj().decompress(base64.b64decode(found[1])[8:])
    content = msgspec.msgpack.decode(inside[8 : 8 + int.from_bytes(inside[:8], "little")])
    nodes: dict[str, Pose] = {}
    for _, message in content["messages"]:
        if "name" in message:
            known = nodes.get(message["name"], Pose())
            w, *xyz = message.get("wxyz", (known.orientation[3], *known.orientation[:3]))
            nodes[message["name"]] = Pose(message.get("position", known.position), (*xyz, w))
    return content["durationSeconds"], nodes


def test_what_a_person_collected_is_ranked_shown_replayed_marked_deleted_and_exported(
    collected: Path, tmp_path: Path
) -> None:
    before = Dataset(collected).episodes
    started = [episode.info["started"] for episode in before]
    with Page(collected) as page:
        listing, jerky = page.ask("/episodes/0")[1], page.ask("/episodes/5")[1]
        assert re.findall(r'data-row="(\d)"', listing) == ["0", "1", "2"]
        jerks = [float(row.split("</td><td>")[4]) for row in jerky.split("<tr data-row")[1:]]
        assert jerks == sorted(jerks, reverse=True)
        assert jerks[0] > 1.0
        sheet = page.ask("/sheet/0")[1]
        assert sheet.count("<image ") == 16, "eight pictures of each camera"
        assert 'data-replay="0"' in sheet
        check_replay(page.ask(f"/replay/{page.token}/0", token="")[1], before[0])
        for path in (f"/replay/{page.token}x/0", "/replay/0", "/sheet/0"):
            assert page.ask(path, token="")[0] == 403
        for step in ("/mark/0/3/failure", "/mark/2/3/none", "/delete/1/3"):
            assert step in "".join(page.ask(f"/sheet/{number}")[1] for number in range(3)), "a button of the page"
            wrong = ({"token": "another"}, {"origin": "http://example.com"}, {"host": "example.com"})
            assert [page.ask(step, "POST", **one)[0] for one in wrong] == [403, 403, 421]
            assert page.ask(step)[0] == 404, "a link changes nothing"
            assert len(Dataset(collected)) == 3
            assert page.ask(step, "POST")[0] == 200
        assert page.ask("/delete/0/3", "POST")[0] == 409, "a page that shows what is gone deletes nothing"
        assert page.ask("/mark/1/2/success", "POST")[0] == 200
        assert re.findall(r'data-row="(\d)".*?<td>(failure|success|-)</td>', page.ask("/episodes/0")[1], re.DOTALL) == [
            ("0", "failure"),
            ("1", "success"),
        ]
    with Page(collected) as page:
        assert len(re.findall("data-row", page.ask("/episodes/0")[1])) == 2, "after a restart, too"
        assert started[2] in page.ask("/sheet/1")[1]
    assert run("review.py", collected).stdout.splitlines()[1].startswith("1 succeeded (50 % of those marked), 1 failed")
    assert run("review.py", collected, "--check").returncode == 0
    done = run("export.py", collected, "--to", "npz", "--out", tmp_path / "out", "--successful-only")
    assert done.returncode == 0, done.stderr
    (exported,) = json.loads((tmp_path / "out" / "export.json").read_text())["episodes"]
    assert exported["started"] == started[2]


def check_replay(page: str, episode: Episode) -> None:
    """Check that a replay ends where the recording does: the tool by the joints, the set-point, the cube."""
    seconds, nodes = last_poses(page)
    assert seconds == pytest.approx(np.ptp(episode.stamps["grid"]))
    (robot,) = episode.info["rig"]["resolved"]["robots"]
    place, tool = "/arms/panda", Pose()
    (hand,) = [name for name in nodes if name.endswith(f"/{robot['kinematics']['tcp_link']}")]
    for part in hand.removeprefix(f"{place}/").split("/"):
        place = f"{place}/{part}"
        tool = tool @ nodes[place]
    tool = tool @ Pose(robot["kinematics"]["tcp_position"], robot["kinematics"]["tcp_orientation"])
    for shown, key in ((tool, "observation.tcp"), (nodes["/arms/panda/set"], "rig.tcp_set")):
        assert shown.position == pytest.approx(episode.columns[key][-1, :3], abs=1e-4)
    assert np.ptp(episode.columns["observation.tcp"][:, 2]) > 0.03, "the arm has moved"
    assert nodes["/bodies/cube/0"].position == pytest.approx(episode.columns["rig.object.cube"][-1, :3], abs=1e-4)


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
