"""The recorded pad: file format, clock, faults, and the conversion of evemu recordings."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hal.config.files import Problems
from hal.config.models import load_pad_models
from hal.driver import PadReading
from hal.drivers.playback import convert as converter
from hal.drivers.playback.pad import PlaybackPad, dump_recording, load_recording
from hal.errors import ConfigError, NotSupported
from hal.gamepad import Gamepad
from hal.specs import PadSpec

ROOT = Path(__file__).parents[4]
PADS = ROOT / "tests" / "data" / "pads"
TOUR = PADS / "tour.jsonl"
MODELS = tuple(load_pad_models(Problems()).values())
HEADER: dict[str, Any] = {"format": "hal-pad-events", "version": 1, "model": "dualshock4"}
HEADER |= {"ranges": {"ABS_X": [0, 255], "ABS_Z": [0, 255]}}

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return a function that writes a recording of (t, code, value)."""

    def write(*events: tuple[float, str, int], **header: object) -> Path:
        lines = [json.dumps({**HEADER, **header})]
        for t, code, value in events:
            kind = "abs" if code.startswith("ABS") else "key"
            lines.append(json.dumps({"t": t, "type": kind, "code": code, "value": value}))
        path = tmp_path / "pad.jsonl"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def player(path: Path, **options: object) -> PlaybackPad:
    pad = PlaybackPad(PadSpec("pad", "playback", None, MODELS, options={"file": str(path), **options}))
    pad.open()
    return pad


def test_events_are_played_on_the_clock_of_the_rig(write: Write) -> None:
    pad = player(write((0.0, "ABS_X", 255), (0.5, "BTN_SOUTH", 1), (1.0, "BTN_SOUTH", 0), (1.5, "ABS_X", 128)))
    first = pad.poll(100.0, 0.0)
    assert (first.axes["left_x"], first.buttons, first.t) == (1.0, frozenset(), 100.0)
    assert pad.poll(100.499, 0.0).buttons == frozenset()
    pressed = pad.poll(100.75, 0.0)
    assert pressed.buttons == {"south"}
    assert (pressed.t, pressed.t_device, pressed.seq, pressed.t_alive) == (100.5, 0.5, 2, 100.75)
    assert pad.poll(101.0, 0.0).buttons == frozenset()


def test_recording_waits_for_a_slow_simulated_world(write: Write) -> None:
    path, came = write((0.0, "ABS_X", 128), (0.5, "BTN_SOUTH", 1), (1.0, "BTN_SOUTH", 0)), 7.0
    pad = PlaybackPad(PadSpec("pad", "playback", None, MODELS, options={"file": str(path)}), source=lambda: came)
    pad.open()
    pad.poll(100.0, 0.0)
    came = 7.3
    for now in (100.35, 101.0, 105.0):
        held_up = pad.poll(now, 0.0)
        assert (held_up.buttons, held_up.t, held_up.t_alive) == (frozenset(), 100.0, now), "the world stands still"
    came = 7.6
    pressed = pad.poll(105.3, 0.0)
    assert pressed.buttons == {"south"}
    assert (pressed.t, pressed.t_device) == (pytest.approx(105.2), 0.5), "the world is 4.7 s behind the clock"
    came = 7.9
    assert pad.poll(105.6, 0.0).buttons == {"south"}
    came = 8.1
    assert pad.poll(105.8, 0.0).buttons == frozenset()


def test_pad_is_released_connected_and_alive_after_the_end(write: Write) -> None:
    pad = player(write((0.0, "ABS_X", 255), (0.1, "BTN_SOUTH", 1)))
    assert pad.poll(0.0, 0.0).axes["left_x"] == 1.0
    end = pad.poll(5.0, 0.0)
    assert (end.axes["left_x"], end.buttons, end.connected, end.t_alive, end.seq) == (0.0, frozenset(), True, 5.0, 2)


def test_loop_repeats_and_one_of_zero_duration_ends(write: Write) -> None:
    pad = player(write((0.0, "BTN_SOUTH", 1), (0.4, "BTN_SOUTH", 0), (1.0, "ABS_X", 128)), loop=True)
    seen = [bool(pad.poll(k * 0.3, 0.0).buttons) for k in range(8)]  # 0, 0.3, 0.6, 0.9, 0.2, 0.5, 0.8, 0.1
    assert seen == [True, True, False, False, True, False, False, True]
    pad = player(write((0.0, "BTN_SOUTH", 1)), loop=True)
    assert pad.poll(0.0, 0.0).seq == 1


def test_poll_returns_with_the_next_event(write: Write) -> None:
    pad = player(write((0.0, "ABS_X", 128), (0.01, "BTN_SOUTH", 1), (0.5, "BTN_SOUTH", 0)))
    pad.poll(0.0, 0.0)
    reading = pad.poll(0.0, 60.0)
    assert reading.buttons == {"south"}


def test_pad_comes_back_with_the_controls_of_that_time(write: Write) -> None:
    events = ((0.0, "BTN_SOUTH", 1), (0.5, "ABS_X", 255), (9.0, "BTN_SOUTH", 0))
    pad = player(write(*events), disconnect_at=1.0, reconnect_at=2.0)
    pad.poll(0.0, 0.0)
    assert pad.poll(0.9, 0.0).buttons == {"south"}
    gone = pad.poll(1.5, 0.0)
    assert (gone.connected, gone.buttons, gone.axes["left_x"], gone.t_alive) == (False, frozenset(), 0.0, 0.9)
    back = pad.poll(2.0, 0.0)
    assert (back.connected, back.buttons, back.axes["left_x"], back.t_alive) == (True, {"south"}, 1.0, 2.0)


def test_recording_is_not_a_deadman_of_a_real_arm(write: Write) -> None:
    pad = Gamepad(player(write((0.0, "ABS_X", 128))))
    with pytest.raises(NotSupported):
        pad.hold("l2").check_trust()


def test_recording_may_contain_its_model(write: Write) -> None:
    model = {"name": "own", "title": "Own", "axes": {"ABS_X": "-right_y"}, "buttons": {}}
    pad = player(write((0.0, "ABS_X", 0), (1.0, "ABS_X", 0), model=model))
    assert pad.poll(0.0, 0.0).axes["right_y"] == 1.0


@pytest.mark.parametrize(
    "line",
    [
        {**HEADER, "version": 2},
        {**HEADER, "ranges": {"ABS_X": [5, 5]}},
        {**HEADER, "ranges": {"ABS_Q": [0, 1]}},
        [],
        {"t": -1, "type": "key", "code": "BTN_SOUTH", "value": 1},
        {"t": 1, "type": "rel", "code": "REL_X", "value": 1},
        {"t": 1, "type": "key", "code": "BTN_NOSE", "value": 1},
        {"t": 1, "type": "key", "code": "BTN_SOUTH", "value": 0.5},
        {"t": 1, "type": "key", "code": ["BTN_SOUTH"], "value": 1},
        {"t": 1, "type": "key", "code": "BTN_SOUTH", "value": 1},
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: Any) -> None:
    path = tmp_path / "bad.jsonl"
    before = [HEADER, {"t": 2, "type": "key", "code": "BTN_SOUTH", "value": 1}]
    lines = [line] if isinstance(line, dict) and "version" in line else [*before, line]
    path.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_recording(path)
    assert [(problem.file, problem.key) for problem in caught.value.problems] == [(str(path), f"line {len(lines)}")]


@pytest.mark.parametrize("text", ["", "\n\n", "hello", '{"format": "else"}', "\x00\xff"])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.jsonl"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError) as caught:
        load_recording(path)
    assert {problem.file for problem in caught.value.problems} == {str(path)}


def test_missing_files_unknown_models_and_wrong_options_are_refused(write: Write, tmp_path: Path) -> None:
    wrong: list[tuple[Callable[[], object], str, str]] = [
        (lambda: player(tmp_path / "nowhere.jsonl"), "unreadable", ""),
        (lambda: player(write(model="wheel")), "unknown_model", "line 1"),
        (lambda: player(write(), freez_at=1.0), "unknown_key", "freez_at"),
        (lambda: PlaybackPad(PadSpec("pad", "playback", None, MODELS)), "missing_key", "file"),
    ]
    for make, code, key in wrong:
        with pytest.raises(ConfigError) as caught:
            make()
        assert [(problem.code, problem.key) for problem in caught.value.problems] == [(code, key)]


@pytest.mark.parametrize(("name", "model", "events"), [("ds4", "dualshock4", 38), ("dualsense", "dualsense", 34)])
def test_evemu_recording_converts_and_reads_back(name: str, model: str, events: int) -> None:
    recording = converter.convert(PADS / f"{name}.events", PADS / f"{name}.ioctl", model=model)
    assert (len(recording.events), recording.events[0].t) == (events, 0.0)
    stored = load_recording(PADS / f"{name}.jsonl")
    assert dump_recording(recording._replace(about=stored.about)) == (PADS / f"{name}.jsonl").read_text()


def test_ranges_come_from_the_description_in_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "own.events"
    path.write_text(
        "# EVEMU 1.3\nN: pad\nA: 00 -512 511 0 16 0\nE: 10.5 0003 0000 511\nE: 10.6 0000 0000 0\n", encoding="utf-8"
    )
    recording = converter.convert(path, model="dualshock4")
    assert ([*recording.ranges[0]], len(recording.events)) == ([-512, 511, 16], 1)


def test_converter_reports_every_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.events"
    path.write_text("E: nonsense\nE: 1.0 0003 0000 1\n", encoding="utf-8")
    assert converter.main([str(path), "--model", "dualshock4"]) == 2
    printed = capsys.readouterr().err
    assert "line 1" in printed
    assert "ABS_X" in printed


def test_converted_file_plays(tmp_path: Path) -> None:
    out = tmp_path / "out.jsonl"
    files = [str(PADS / "ds4.events"), "--ioctl", str(PADS / "ds4.ioctl"), "--output", str(out)]
    assert converter.main([*files, "--model", "dualshock4"]) == 0
    pad = player(out)
    pressed: set[str] = set()
    for k in range(400):
        pressed |= pad.poll(k * 0.01, 0.0).buttons
    assert pressed >= {"south", "east", "west", "north", "l1", "r1", "l2", "r2", "select", "start", "l3", "r3"}


# The tour.


def test_tour_is_the_output_of_its_script() -> None:
    script = runpy.run_path(str(PADS / "make_tour.py"))
    assert TOUR.read_text(encoding="utf-8") == "\n".join(script["lines"]()) + "\n"


@pytest.fixture(scope="module")
def tour() -> list[tuple[float, PadReading]]:
    pad = player(TOUR)
    return [(k * 0.01, pad.poll(k * 0.01, 0.0)) for k in range(1400)]


def test_tour_moves_and_turns_the_tool(tour: list[tuple[float, PadReading]]) -> None:
    """With the default mapping, at 0.1 m/s and 0.3 rad/s, counted while the dead-man is held."""
    driven = turned = 0.0
    for _, reading in tour:
        if reading.axes["l2"] > 0.5:
            up = ("l1" in reading.buttons) - ("r1" in reading.buttons)
            driven += 0.001 * (reading.axes["dpad_y"] ** 2 + reading.axes["dpad_x"] ** 2 + up**2) ** 0.5
            turned += 0.003 * sum(abs(v) for k, v in reading.axes.items() if k.endswith("_x") and abs(v) > 0.1)
    assert driven > 0.5
    assert turned > 0.5


def test_tour_releases_the_deadman_while_moving_closes_the_gripper_and_ends_released(tour):
    pad = Gamepad(player(TOUR))
    pad.open(0.0)
    deadman = pad.hold("l2")
    released_in_motion = False
    was_held = False
    grips = []
    for k in range(1400):
        pad.poll_once(k * 0.01)
        moving = pad.state().axis("dpad_y") != 0.0
        released_in_motion |= was_held and not deadman.held and moving
        was_held = deadman.held
        grips.append(pad.state().axis("r2"))
    assert released_in_motion
    assert (deadman.record.presses, max(grips)) == (2, 1.0)
    assert grips[0] == grips[-1] == 0.0
    last = tour[-1][1]
    assert last.connected
    assert not last.buttons
    assert not any(last.axes.values())
    assert not deadman.held
