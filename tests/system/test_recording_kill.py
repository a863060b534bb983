"""``kill -9`` at a random moment: of the program and of its writer, at once.

Three times here, on a computer that may be busy; HAL_RECORDING_KILLS=100 does it more often, and is stricter.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from recording_kit import check_layout

from hal.recording import Dataset, recover

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("HAL_RECORDING_KILLS", "3"))
LOST = 0.5 if "HAL_RECORDING_KILLS" in os.environ else 1.5
"""s of the live episode that may be missing."""
HERE = Path(__file__).parent


def start(out: Path, seed: int) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(HERE.parent / "kits")}
    command = [sys.executable, str(HERE / "recording_app.py"), str(out), str(seed)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


@pytest.mark.parametrize("seed", range(KILLS))
def test_every_finished_episode_is_intact_and_the_live_one_but_for_its_end(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    out = tmp_path / "out"
    app = start(out, seed)
    first: dict[str, Any] = json.loads(app.stdout.readline())
    assert first["what"] == "ready"
    time.sleep(chance.uniform(0.5, 5.0))
    victims = [app.pid, first["writer"]]
    chance.shuffle(victims)
    killed = time.monotonic()
    for victim in victims:
        os.kill(victim, signal.SIGKILL)
    said = [json.loads(line) for line in app.stdout if line.endswith("\n")]
    app.wait()
    saved = [line["rows"] for line in said if line["what"] == "saved"]
    last = said[-1] if said else first

    recovered = recover(out) if out.exists() else []
    if not (out / "meta/info.json").exists():
        assert not saved
        assert last["what"] == "ready" or killed - last["t"] < LOST, f"nothing was there yet: {last}, {recovered}"
        return
    check_layout(out)
    episodes = Dataset(out).episodes
    lengths = [episode.length for episode in episodes]
    assert lengths[: len(saved)] == saved
    assert [episode.success for episode in episodes[: len(saved)]] == [True] * len(saved)
    for episode in episodes:
        for camera in episode.cameras:
            assert sum(1 for _ in episode.frames(camera)) == episode.length
            assert sum(1 for _ in episode.depth(camera)) == episode.length
    if last["what"] == "begun" and killed - last["t"] > LOST:
        assert len(episodes) == len(saved) + 1
        assert killed - episodes[-1].stamps["grid"][-1] <= LOST
        assert len(recovered) == 1
    if last["what"] == "ending":
        assert len(episodes) == len(saved) + 1
        assert last["t"] - episodes[-1].stamps["grid"][-1] <= LOST
