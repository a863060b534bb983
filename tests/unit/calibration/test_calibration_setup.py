"""The result in the rig's file: one entry changes, every other byte stays."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from errors_kit import raises_code

from hal.calibration import setup
from hal.calibration.setup import (
    CalibrationSetup,
    RigFileOutput,
    back_up,
    find_setup,
    initial_guess,
    replace_camera_entry,
    write_file,
)
from hal.config import load
from hal.config.data_files import find_data
from hal.errors import CommandError, ConfigError
from hal.geometry import Pose

VALUE = "[0.1, 0.2, 0.3, 0, 0, 0, 1]"
HAND = f"{{robot: arm, link: hand, pose: {VALUE}}}"

BLOCK = """\
# A rig.
robots: {arm: {model: panda}}      # äöü, before the place
cameras:
  other: {model: pinhole, look_at: {target: [0, 0, 0], distance: 1}}
  wrist:                           # on the hand
    model: pinhole
    look_at:                       # by hand
      target: [0, 0, 0]            # of the table
      distance: 1.0                # m
    # what follows is another matter
    streams: [color]

gamepads: {}
"""


def test_a_block_is_replaced_and_what_follows_stays() -> None:
    old = (
        "    look_at:                       # by hand\n      target: [0, 0, 0]            # of the table\n"
        "      distance: 1.0   "
    )
    assert old in BLOCK
    assert replace_camera_entry(BLOCK, "wrist", "pose", VALUE) == BLOCK.replace(old, f"    pose: {VALUE}   ")


WAYS = [
    ("cameras: {wrist: {model: a, pose: [1, 2], sim: true}} # x\n", "pose: [1, 2]", "@"),
    ("cameras: {wrist: {model: a}, b: {model: c}}\n", "{model: a}", "{model: a, @}"),
    ("cameras:\n  wrist:\n    model: a # m\n\n  # of b\n  b: {model: c}\n", "# m\n", "# m\n    @\n"),
    ("cameras:\n  wrist:\n    model: a", "model: a", "model: a\n    @"),
    ("cameras:\r\n  wrist:\r\n    model: a\r\nsim: true\r\n", "model: a\r\n", "model: a\r\n    @\r\n"),
    (
        "cameras:\r\n  wrist:\r\n    attached:\r\n      {robot: b}\r\n    model: a\r\n",
        "attached:\r\n      {robot: b}",
        "@",
    ),
    ("\ufeffcameras:\n  wrist:\n    look_at: {distance: 1} # s\n    model: a\n", "look_at: {distance: 1}", "@"),
    ("cameras:\n  wrist:\n    streams:\n    - a\n    - b # d\nsim: true\n", "b # d\n", "b # d\n    @\n"),
    ('"cameras":\n  "wrist":\n    "pose": [1,\n      2] # p\n    model: a\n', '"pose": [1,\n      2]', "@"),
]
"""A file, the part of it that is replaced, and its replacement, with @ for the new entry."""


@pytest.mark.parametrize("key", ["pose", "attached"])
@pytest.mark.parametrize(("text", "old", "new"), WAYS)
def test_all_styles_of_yaml(text: str, old: str, new: str, key: str) -> None:
    value = VALUE if key == "pose" else HAND
    assert text.count(old) == 1
    assert replace_camera_entry(text, "wrist", key, value) == text.replace(old, new.replace("@", f"{key}: {value}"))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("cameras:\n  a: &a {model: m, pose: [1]}\n  wrist: *a\n", "shared_keys"),
        ("cameras:\n  a: &a {model: m}\n  wrist: *a\n", "shared_keys"),
        ("cameras:\n  a: &a {model: m, pose: [1]}\n  wrist: {<<: *a, sim: true}\n", "shared_keys"),
        ("p: &p [1, 2]\ncameras:\n  wrist: {model: a, pose: *p}\n", "not_editable"),
        ("cameras: {}\n", "not_editable"),
        ("cameras:\n  wrist:\n", "not_editable"),
        ("cameras: [1, 2]\n", "not_editable"),
        ("cameras: {wrist: {model: a, pose: }}}\n", "not_editable"),
        ("cameras:\n  wrist: {model: a, pose: [1], look_at: {distance: 1}}\n", "not_editable"),
        ("cameras:\n  wrist:\n    pose: [1]\n    pose: [2]\n", "not_editable"),
        ("cameras:\n  wrist: {model: a}\n  wrist: {model: b}\n", "not_editable"),
        ("cameras: {wrist: {model: a}}\ncameras: {wrist: {model: b}}\n", "not_editable"),
    ],
)
def test_a_file_that_cannot_be_edited_safely_is_refused_with_what_to_write(text: str, code: str) -> None:
    with pytest.raises(CommandError) as caught:
        replace_camera_entry(text, "wrist", "attached", HAND)
    assert caught.value.code == code
    assert f"attached: {HAND}" in str(caught.value)


def test_a_file_is_written_whole_and_keeps_its_permissions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, link = tmp_path / "real.yaml", tmp_path / "link.yaml"
    real.write_text("old")
    real.chmod(0o640)
    link.symlink_to(real)
    write_file(link, "new\r\n")
    assert link.is_symlink()
    assert (real.read_bytes(), real.stat().st_mode & 0o777) == (b"new\r\n", 0o640)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(setup.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_file(real, "newer")
    assert real.read_bytes() == b"new\r\n"
    assert sorted(os.listdir(tmp_path)) == ["link.yaml", "real.yaml"]


def test_backups_never_overwrite_each_other(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    names = []
    for text in ("a", "b", "c"):
        path.write_text(text)
        names.append(back_up(path).name)
    assert names == ["rig.yaml.bak", "rig.yaml.bak2", "rig.yaml.bak3"]
    assert [(tmp_path / name).read_text() for name in names] == ["a", "b", "c"]


def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(find_data("config", "panda_calibration.yaml").read_text())
    return path


def test_the_written_pose_is_loaded_again(tmp_path: Path) -> None:
    path = rig(tmp_path)
    config = load(path)
    setting = find_setup(config, config.resolve())
    assert (setting.eye, setting.link, setting.link_name) == ("in-hand", "panda_hand", "hand")
    solved = Pose([-0.0912345, 0.0123456, 0.0234567], [0.1, -0.2, 0.7, 0.6])
    output = RigFileOutput.of(str(path), None, setting.camera)
    assert f"{path}.bak" in output.write(*setting.entry(solved))[0]
    again = load(path)
    view = again.resolve().cameras[0].view
    assert (view.robot, view.link) == ("panda", "panda_hand")
    distance, angle = Pose(view.position, view.orientation).distance(solved)
    assert distance < 1e-6
    assert angle < 1e-7
    known = find_setup(again, again.resolve()).known
    assert known.distance(solved)[0] < 1e-6


def test_a_camera_beside_the_arm_gets_a_pose_in_the_world(tmp_path: Path) -> None:
    config = load("panda_calibration_held")
    setting = find_setup(config, config.resolve())
    assert (setting.eye, setting.link, setting.frame) == ("to-hand", "panda_hand", "the world")
    output = RigFileOutput.of(config.resolve().source, str(tmp_path / "mine.yaml"), setting.camera)
    output.write(*setting.entry(Pose([1.0, 2.0, 3.0])))
    view = load(tmp_path / "mine.yaml").resolve().cameras[0].view
    assert view.robot is None
    assert view.position == (1.0, 2.0, 3.0)


def test_a_rig_that_would_not_load_is_not_written(tmp_path: Path) -> None:
    path = rig(tmp_path)
    before = path.read_bytes()
    with pytest.raises(ConfigError):
        RigFileOutput(path, path, "wrist").write("attached", f"{{robot: unknown, link: hand, pose: {VALUE}}}")
    assert (path.read_bytes(), os.listdir(tmp_path)) == (before, ["rig.yaml"])


def test_a_place_that_cannot_be_edited_refuses_a_place_only(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("cameras:\n  a: {model: webcam, pose: &p [0, 0, 1, 1, 0, 0, 0]}\n  b: {pose: *p, model: webcam}\n")
    output = RigFileOutput.of(str(path), None, "b")
    assert "b: {pose: *p, model: webcam, intrinsics: {" in output.check(
        "intrinsics", "{width: 640, height: 480, fx: 1, fy: 1, cx: 0, cy: 0}"
    )
    with raises_code(CommandError, "not_editable"):
        output.check("pose", VALUE)


def test_a_built_in_rig_and_a_missing_folder_are_not_written_to(tmp_path: Path) -> None:
    built_in = str(find_data("config", "panda_calibration.yaml"))
    assert RigFileOutput.of(built_in, None, "wrist") is None
    with raises_code(CommandError, "no_folder"):
        RigFileOutput.of(built_in, str(tmp_path / "nowhere" / "rig.yaml"), "wrist")


def chosen(rig_name: str = "panda_table", **wanted: object) -> CalibrationSetup:
    config = load(rig_name, sim=True)
    return find_setup(config, config.resolve(), **wanted)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wanted", "code"),
    [
        ({}, "missing_camera"),
        ({"camera": "wirst"}, "unknown_camera"),
        ({"camera": "wrist", "robot": "pandas"}, "unknown_robot"),
        ({"camera": "wrist", "link": "panda_hnad"}, "unknown_link"),
        ({"camera": "wrist", "link": "panda_leftfinger"}, "link_moves"),
    ],
)
def test_missing_and_misspelt_names_are_refused(wanted: dict[str, object], code: str) -> None:
    with raises_code(CommandError, code):
        chosen(**wanted)


def test_the_setup_comes_from_the_rig_and_the_options() -> None:
    wrist, scene = chosen(camera="wrist"), chosen(camera="scene")
    assert (wrist.eye, wrist.link, wrist.known is None) == ("in-hand", "panda_hand", False)
    assert (scene.eye, scene.link, scene.known is None) == ("to-hand", "panda_hand", False)
    moved = chosen(camera="scene", eye="in-hand", link="panda_link7")
    assert (moved.eye, moved.link, moved.known) == ("in-hand", "panda_link7", None)
    other = chosen(camera="wrist", link="panda_link7")
    assert (other.link, other.known) == ("panda_link7", None)
    with raises_code(CommandError, "missing_guess"):
        initial_guess(other, None)
    assert initial_guess(other, VALUE) == Pose([0.1, 0.2, 0.3])
    for wrong in ("[1, 2]", "{", "[0, 0, 0, 0, 0, 0, 0]"):
        with raises_code(CommandError, "bad_guess"):
            initial_guess(other, wrong)
