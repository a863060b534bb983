"""``--dry-run`` finds what would fail later, opens nothing, and moves nothing."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hal.apps import teleop
from hal.config.data_files import find_data

PANDA = "robots: {panda: {model: panda}}\n"
REAL = "robots: {panda: {model: panda, sim: false, drivers: {real: mock}, real: {}, gripper: {enabled: false}}}\n"


def dry_run(folder: Path, rig: str, *options: str) -> int:
    (folder / "rig.yaml").write_text(rig)
    return teleop.main(["--config", str(folder / "rig.yaml"), "--dry-run", *options])


def bad_model(folder: Path) -> str:
    (folder / "pad.yaml").write_text("name: mine\nmatch: []\naxes: {left_x: ABS_NOTHING}\nbuttons: {}\n")
    return PANDA + "gamepads: {pad: {model: pad.yaml}}\n"


def bad_recording(folder: Path) -> str:
    (folder / "tour.jsonl").write_text('{"not": "a recording"}\n')
    return PANDA + "gamepads: {pad: {driver: playback, file: tour.jsonl}}\n"


def wrong_options(folder: Path) -> str:
    return PANDA + "gamepads: {pad: {driver: evdev, options: {devise: /dev/input/event3}}}\n"


def wrong_playback_options(folder: Path) -> str:
    (folder / "tour.jsonl").write_text(find_data("config", "teleop/tour.jsonl").read_text())
    return PANDA + "gamepads: {pad: {driver: playback, file: tour.jsonl, options: {lop: true}}}\n"


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (bad_model, "pad.yaml: axes"),
        (bad_recording, "gamepads.pad.file: "),
        (wrong_playback_options, "gamepads.pad.options.lop"),
        (wrong_options, "devise"),
    ],
)
def test_a_pad_of_the_rig_is_checked(
    rig: Callable[[Path], str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert dry_run(tmp_path, rig(tmp_path)) == 2
    assert words in capsys.readouterr().err


WITH_PAD = PANDA + "gamepads: {pad: {}}\n"


@pytest.mark.parametrize(
    ("rig", "options", "words"),
    [
        (WITH_PAD, ["--pad", "{folder}/broken.jsonl"], "broken.jsonl: line 1"),
        (WITH_PAD, ["--pad", "nothing.jsonl"], "there is no pad"),
        (WITH_PAD, ["--pad", "keyboard"], "terminal"),
        (WITH_PAD, ["--pad", "web", "--set", "simulation.clock=lock_step"], "NotSupported: the console"),
        (REAL + "gamepads: {pad: {}}\n", ["--pad", "demo"], "cannot hold the dead-man of a real arm"),
        (WITH_PAD, ["--listen", "8470"], "--listen takes an address"),
        (WITH_PAD, ["--listen", "203.0.113.7"], "--listen: cannot listen at 203.0.113.7"),
        (WITH_PAD, ["--listen", "no.such.host.invalid"], "no.such.host.invalid"),
        (WITH_PAD, ["--listen", "127.0.0.1:{taken}"], "127.0.0.1, port {taken}"),
        (WITH_PAD, ["--report", "{folder}"], "is a folder"),
        (WITH_PAD, ["--report", "{folder}/none/run.json"], "does not exist"),
        (WITH_PAD, ["--robot", "arm"], "no robot 'arm'"),
        (WITH_PAD, ["--mapping", "nothing"], "there is no mapping"),
    ],
)
def test_an_option_is_checked(
    rig: str, options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.jsonl").write_text(json.dumps({"pad": 1}) + "\n")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        given = [option.replace("{folder}", str(tmp_path)).replace("{taken}", port) for option in options]
        assert dry_run(tmp_path, rig, *given) == 2
    assert words.replace("{taken}", port) in capsys.readouterr().err


def test_what_is_in_order_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tour = str(find_data("config", "teleop/tour.jsonl"))
    options = ["--pad", tour, "--listen", "127.0.0.1", "--report", str(tmp_path / "run.json"), "--console"]
    assert dry_run(tmp_path, WITH_PAD, *options) == 0
    assert "is valid" in capsys.readouterr().out
    assert not (tmp_path / "run.json").exists()


@pytest.mark.parametrize(
    ("model", "library", "other"), [("fr3", "pylibfranka", "panda_py"), ("panda", "panda_py", "pylibfranka")]
)
def test_a_missing_library_of_an_arm_is_listed(
    model: str,
    library: str,
    other: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "pylibfranka", None)
    monkeypatch.setitem(sys.modules, "panda_py", None)
    real = f"robots: {{arm: {{model: {model}, sim: false, real: {{host: 172.16.0.2}}, gripper: {{enabled: false}}}}}}\n"
    assert dry_run(tmp_path, real, "--pad", "web") == 0
    output = capsys.readouterr().out
    assert f"missing  {library}: pip install" in output
    assert other not in output
