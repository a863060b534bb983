"""What the console serves and shows: its files, the view of a recording, states and pictures."""

from __future__ import annotations

import io
import json
import logging
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from web_kit import camera, frame

from hal.driver import GripperReading, Reading
from hal.drivers.web.console import recording_message
from hal.drivers.web.pictures import DEPTH_COLORS, UNKNOWN_COLOR, PictureCredit, compress, smooth_picture
from hal.drivers.web.process import LogLimit
from hal.drivers.web.server import keys_module, read_page_files
from hal.drivers.web.telemetry import Telemetry
from hal.errors import CommandError
from hal.host.records import GroupMemory, ServoRecord
from hal.pads.keyboard import keyboard_table
from hal.servo.watchdog import PAD_SILENCE
from hal.types import BUTTONS, PAGE_AXES, Limited, RobotStatus, Trip
from hal.views import RecordingView


def test_the_page_gets_the_constants_of_the_project() -> None:
    lines = keys_module(keyboard_table("browser")._asdict())[0].decode().splitlines()
    found = {
        match[1]: json.loads(match[2]) for line in lines if (match := re.fullmatch(r"export const (\w+) = (.*);", line))
    }
    assert (found["AXES"], found["BUTTONS"], found["PAD_SILENCE"]) == ([*PAGE_AXES], [*BUTTONS], PAD_SILENCE)
    assert found["ONE_SIDED"] == ["l2", "r2"]
    used = {
        name
        for text in read_page_files().values()
        for name in re.findall(rb"import \{([^}]*)\} from \"./keys.js\"", text[0])
    }
    assert {name.strip() for names in used for name in names.decode().split(",")} <= set(found)


def test_only_files_of_a_page_are_read(tmp_path: Path) -> None:
    for name in ("index.html", "pad.js", "page.css", "icon.svg", "icon.png", "__init__.py", "notes.txt", ".hidden"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder.js").mkdir()
    files = read_page_files(tmp_path)
    assert sorted(files) == ["index.html", "pad.js", "page.css"]
    assert files["pad.js"] == (b"pad.js", "text/javascript; charset=utf-8")


def test_the_log_of_libraries_is_limited() -> None:
    written = io.StringIO()
    handler = logging.StreamHandler(written)
    handler.addFilter(LogLimit(3))
    for k in range(1000):
        try:
            raise OSError(f"no more files, {k}")
        except OSError as error:
            record = logging.LogRecord("asyncio", logging.ERROR, "", 0, "said %d", (k,), (OSError, error, None))
        handler.handle(record)
    lines = written.getvalue().splitlines()
    assert lines[0] == "said 0"
    assert "OSError: no more files, 2" in lines
    assert lines[-1] == "further records of this kind are not shown"
    assert not any("3" in line for line in lines)


VIEW = RecordingView(
    phase="recording",
    prompt="put the cube on the plate, then save",
    task="the cube on the plate",
    episode=22,
    saved=2,
    wanted=10,
    succeeded=1,
    failed=1,
    discarded=3,
    seconds=12.345,
    frames=370,
    dropped=0,
    free_bytes=41_200_000_000,
    trouble="",
    actions=("finish", "fail", "discard"),
)


def test_a_view_reaches_the_pages_whole() -> None:
    message = recording_message(VIEW)
    assert message.keys() == set(RecordingView.__slots__)
    assert message | {"seconds": 12.345, "actions": VIEW.actions} == {
        name: getattr(VIEW, name) for name in RecordingView.__slots__
    }
    assert (message["seconds"], message["actions"]) == (12.35, ["finish", "fail", "discard"])


def test_numbers_may_be_numpy_scalars() -> None:
    view = replace(VIEW, frames=np.int64(3), free_bytes=np.uint64(1 << 40), seconds=np.float32(0.5))
    message = json.loads(json.dumps(recording_message(view)))
    assert (message["frames"], message["free_bytes"], message["seconds"]) == (3, 1 << 40, 0.5)


def test_texts_become_one_line_of_limited_length() -> None:
    message = recording_message(replace(VIEW, prompt="two\nlines  of it", trouble="no space left " * 1000))
    assert (message["prompt"], len(message["trouble"])) == ("two lines of it", 300)


@pytest.mark.parametrize(
    "wrong",
    [
        {"phase": "paused"},
        {"actions": ("record", "erase")},
        {"actions": "record"},
        {"seconds": float("nan")},
        {"seconds": float("inf")},
        {"seconds": -0.1},
    ],
)
def test_invalid_views(wrong: dict[str, Any]) -> None:
    with pytest.raises(CommandError):
        replace(VIEW, **wrong)


ARM = {"name": "arm", "rate_hz": 240.0, "joints": [["arm", 3]], "grippers": [], "gripper_of": {"arm": "arm.gripper"}}
HAND = {"name": "arm.gripper", "rate_hz": 100.0, "joints": [], "grippers": ["arm.gripper"], "gripper_of": {}}


def test_a_gripper_of_another_process_is_shown_with_its_arm_until_it_is_silent() -> None:
    memories = [
        memoryview(bytearray(GroupMemory.size([("arm", 3)]))),
        memoryview(bytearray(GroupMemory.size([], ["arm.gripper"]))),
    ]
    arm = GroupMemory(memories[0], [("arm", 3)]).robots["arm"]
    hand = GroupMemory(memories[1], [], ["arm.gripper"]).grippers["arm.gripper"]
    telemetry = Telemetry([ARM, HAND], memories)

    def gripper(now: float) -> object:
        zero = (0.0, 0.0, 0.0)
        servo = ServoRecord(RobotStatus.IDLE, Trip.NONE, Limited.NONE, 0, 0, False, 0, now, now, zero, zero)
        tcp = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        arm.put_state(Reading(now, now, 1, zero, zero), servo, tcp, tcp, (0.0,) * 6)
        return telemetry.snapshot(now)["robots"]["arm"]["gripper"]

    assert gripper(1.0) is None
    hand.put(GripperReading(1.0, 1.0, 1, 0.03, 0.0, False, True))
    shown = {"width": 0.03, "width_target": 0.0, "moving": False, "grasped": True}
    assert (gripper(1.1), gripper(1.4)) == (shown, shown)
    assert gripper(1.6) is None


@pytest.mark.parametrize("order", [1, -1])
def test_the_order_of_the_processes_does_not_matter(order: int) -> None:
    memories = [memoryview(bytearray(GroupMemory.size([("arm", 3)], ["arm.gripper"]))) for _ in range(2)]
    telemetry = Telemetry([ARM, HAND][::order], memories)
    assert set(telemetry.snapshot(0.0)["hosts"]) == {"arm", "arm.gripper"}


def pixels(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg))).astype(int)


@pytest.mark.parametrize("divisor", [1, 2])
def test_depth_gets_darker_with_the_distance_and_what_was_not_measured_is_grey(divisor: int) -> None:
    """What is left out when a picture is made smaller does not count: a mean would be a depth that is nowhere."""
    spec = camera("depth", 128, 32, "depth")  # 0.2 to 2.2 m
    depth = frame(spec, 0.7)
    values = 0.0, 0.2, 2.2, 9.0, float("nan"), float("inf"), -1.0, 0.1
    depth.depth[::divisor, ::divisor] = np.repeat(values, 16)[::divisor]
    row = pixels(compress(depth, spec, divisor))[8, 8 // divisor :: 16 // divisor]
    near, far, unknown = DEPTH_COLORS[0], DEPTH_COLORS[-1], UNKNOWN_COLOR
    assert np.abs(row - [unknown, near, far, far, unknown, far, unknown, near]).max() <= 6


def test_bodies_of_a_segmentation_have_different_colours_and_none_is_black() -> None:
    spec = camera("scene/segmentation", 64, 16, "segmentation")
    numbers = frame(spec, 0.0)
    numbers.segmentation[:] = np.repeat((-1, 0, 1, 2), 16)
    row = pixels(compress(numbers, spec))[8, 8::16]
    assert row[0].max() <= 3
    assert min(np.abs(one - other).max() for k, one in enumerate(row) for other in row[:k]) > 40


def test_the_colours_of_depth_are_in_order_and_unlike_that_of_unknown_depth() -> None:
    light = [0.3 * red + 0.6 * green + 0.1 * blue for red, green, blue in DEPTH_COLORS]
    assert light == sorted(light, reverse=True)
    assert min(np.ptp(color) for color in DEPTH_COLORS) > 60, "every one has a hue"


def test_infrared_is_grey() -> None:
    spec = camera("ir", 32, 16, "infrared")
    for divisor, shape in ((1, (16, 32)), (3, (5, 11))):
        image = pixels(compress(frame(spec, 90), spec, divisor))
        assert image.shape == shape
        assert np.abs(image - 90).max() <= 2


def test_colours_are_not_swapped() -> None:
    spec = camera("color", 32, 16)
    red = frame(spec, 0)
    red.color[:, :, 0] = 250
    for divisor in (1, 2):
        assert np.abs(pixels(compress(red, spec, divisor)) - [250, 0, 0]).max() <= 4


def test_a_page_gets_the_newest_picture_once_it_has_drawn_the_last() -> None:
    credit = PictureCredit()
    credit.watch({"a": 640, "b": 640})
    assert (credit.allows("a", 0), credit.allows("b", 3)) == (False, True), "there is none of a"
    credit.spend("b", 3)
    assert not credit.allows("b", 5)
    credit.watch({"b": 320})
    assert not credit.allows("b", 5), "asking again for the same gives no credit"
    for name in ("b", "b", "a"):
        credit.give_back(name)
    assert (credit.allows("a", 1), credit.allows("b", 5)) == (False, True)
    credit.spend("b", 5)
    credit.give_back("b")
    assert not credit.allows("b", 5), "it has the newest one"


def test_a_small_picture_has_softer_stairs_and_lone_pixels_and_is_not_changed_itself() -> None:
    """A steep edge as it is drawn with one sample a pixel, and a glint."""
    row, column = np.mgrid[:60, :80]
    picture = np.where((row > 0.3 * column + 10)[:, :, None], 200, 60).astype(np.uint8).repeat(3, axis=2)
    picture[5, 60] = 255
    before = picture.copy()
    found = smooth_picture(picture)
    assert (picture == before).all(), "what others get of this frame stays as it is"
    steps = np.unique(found[:, 20:60, 0])
    assert len(steps) > 4, "an edge passes through values in between"
    assert steps.min() >= 60
    assert steps.max() <= 200
    assert found[5, 60].max() < 160, "a lone pixel becomes more like those around it"
    far = abs(row - 0.3 * column - 10) > 8
    far[3:8, 58:63] = False
    assert (found[far] == picture[far]).all(), "surfaces stay as they are"


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3), (48, 64)])
def test_any_size_and_any_noise_can_be_smoothed(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    found = smooth_picture(noise)
    assert (found.shape, found.dtype) == (noise.shape, noise.dtype)
