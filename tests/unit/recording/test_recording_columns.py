"""Rigs that are not the built-in one: two arms, no gripper known, objects that come and go."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from recording_kit import check_layout, mock_rig

import hal
from hal.recording import Dataset, Recorder
from hal.recording.sampling import RowSampler
from hal.types import BUTTONS

TWO = {
    "robots": {
        "left": {"model": "panda", "base": {"position": [0, 0.4, 0]}},
        "right": {"model": "panda", "base": {"position": [0, -0.4, 0]}},
    },
    "objects": [],
}


def test_two_arms_share_the_columns(tmp_path: Path) -> None:
    with hal.open(TWO, driver="mock") as rig, Recorder(rig, tmp_path / "out") as recorder:
        recorder.start()
        rig.clock.sleep(0.5)
        recorder.save(wait=True)
    info = check_layout(tmp_path / "out")
    names = info["features"]["action"]["names"]
    assert len(names) == 16
    assert names[0].startswith("left.")
    assert names[7] == "left.gripper"
    assert names[8].startswith("right.")
    episode = Dataset(tmp_path / "out").episodes[0]
    assert episode.columns["observation.tcp"].shape == (episode.length, 14)
    assert set(episode.stamps) == {"grid", "robot.left", "robot.right", "gripper.left", "gripper.right"}


def test_every_column_is_in_the_documentation() -> None:
    text = (Path(__file__).parents[3] / "docs" / "record.md").read_text(encoding="utf-8")
    table = "".join(re.findall(r"^\| (`(?:observation|action|rig|source|intervention|next).*?) \|", text, re.MULTILINE))
    keys = {f"rig.time{key}" if key.startswith(".") else key for key in re.findall(r"`([\w.]+)`", table)}
    with mock_rig() as rig:
        columns = RowSampler(rig, rig.cameras).columns
    missing = [one.key for one in columns if not {one.key, re.sub(r"\.\w+$", ".NAME", one.key)} & keys]
    assert not missing


def test_a_dataset_of_earlier_columns_takes_more_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the gripper's force, and from a time when pads had a button less, one more, and another order."""

    def record() -> list[str]:
        with mock_rig() as rig, Recorder(rig, tmp_path / "out") as recorder:
            recorder.start()
            rig.clock.sleep(0.5)
            recorder.save(wait=True)
            return recorder.notes

    with monkeypatch.context() as earlier:
        earlier.setattr("hal.recording.sampling.BUTTONS", ("turbo", *BUTTONS[-2::-1]))
        earlier.setattr(RowSampler, "_fit", lambda sampler, known: [], raising=True)
        build = RowSampler._add
        keep = lambda sampler, key, *rest: None if key == "rig.setpoint_force" else build(sampler, key, *rest)  # noqa: E731
        earlier.setattr(RowSampler, "_add", keep)
        record()
    notes = record()
    info = check_layout(tmp_path / "out")
    assert info["total_episodes"] == 2
    assert "rig.setpoint_force" not in info["features"]
    assert any("rig.setpoint_force" in note and f"button_{BUTTONS[-1]}" in note for note in notes)
    first, second = Dataset(tmp_path / "out").episodes
    assert first.columns["rig.pad"].shape[1] == second.columns["rig.pad"].shape[1]
    pressed = second.columns["rig.pad"][:, info["features"]["rig.pad"]["names"].index("connected")]
    assert pressed.all(), "each number is under its own name"
    assert not second.columns["rig.pad"][:, info["features"]["rig.pad"]["names"].index("button_turbo")].any()


def test_an_object_that_is_taken_away_is_not_known_any_more(tmp_path: Path) -> None:
    with (
        hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=["cameras={}"]) as rig,
        Recorder(rig, tmp_path / "out") as recorder,
    ):
        recorder.start()
        rig.clock.sleep(0.2)
        rig.world.remove("duck")
        rig.clock.sleep(0.2)
        recorder.save(wait=True)
    check_layout(tmp_path / "out")
    episode = Dataset(tmp_path / "out").episodes[0]
    duck = episode.columns["rig.object.duck"]
    assert np.isfinite(duck[:6]).all()
    assert np.isnan(duck[-5:]).all()
    assert np.isfinite(episode.columns["rig.object.cube"]).all()
    assert "rig.object.table" not in episode.columns, "what stands still is in the episode's own file"
    assert set(episode.info["objects_at_start"]) == {"floor", "table", "cube", "duck"}


def test_columns_without_an_open_pad_match_those_with_one(tmp_path: Path) -> None:
    for pad in (None, "none"):
        with (
            hal.open("panda_table", driver="mock", pad=pad, overrides=["cameras={}"]) as rig,
            Recorder(rig, tmp_path / "out") as recorder,
        ):
            assert set(rig.gamepads) == ({"pad"} if pad is None else set())
            recorder.start()
            rig.clock.sleep(0.3)
            recorder.save(wait=True)
    check_layout(tmp_path / "out")
    driven, by_itself = Dataset(tmp_path / "out").episodes
    connected = driven.names("rig.pad").index("connected")
    assert (driven.columns["rig.pad"][:, connected] == 1.0).all()
    assert (by_itself.columns["rig.pad"] == 0.0).all()
    assert np.isnan(by_itself.stamps["pad.pad"]).all()
