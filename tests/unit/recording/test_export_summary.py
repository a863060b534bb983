"""A dataset in numbers, and an episode on a sheet."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from recording_kit import make_recording

from hal.recording import Dataset
from hal.recording.review import draw_sheet, summarize, summary_as_json, ticks

RED, BLUE, ORANGE, PINK = (215, 60, 50), (0, 90, 181), (240, 140, 30), (250, 205, 200)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_recording(tmp_path_factory.mktemp("summary") / "demo")


def test_the_numbers_are_those_of_the_rows(dataset: Dataset) -> None:
    found = summarize(dataset)
    assert (found.successes, found.failures, found.unmarked) == (1, 1, 1)
    assert found.rows == sum(episode.length for episode in dataset.episodes)
    assert found.seconds == pytest.approx(found.rows / 20)
    assert [line.trips for line in found.episodes] == [1, 0, 0], "the first one was stopped"
    assert found.bytes == sum(file.stat().st_size for file in dataset.root.rglob("*") if file.is_file())
    assert [each.source for each in found.timing] == ["robot.panda", "gripper.panda", "camera.scene", "camera.wrist"]
    assert all(each.period == pytest.approx(50.0) for each in found.timing), "lock-step is even"
    assert all(each.jitter == pytest.approx(0.0, abs=0.01) for each in found.timing)


def test_uneven_times_are_reported(dataset: Dataset) -> None:
    (episode,) = Dataset(dataset.root).episodes[:1]
    wrist, scene = (episode.columns[f"rig.time.camera.{name}"].copy() for name in ("wrist", "scene"))
    wrist[4:, 0] -= 0.02  # one came 20 ms early, and all after it
    wrist[8] = wrist[7]  # and one not at all
    scene[:2] = np.nan
    episode.columns.update({"rig.time.camera.wrist": wrist, "rig.time.camera.scene": scene})
    found = {each.source: each for each in summarize(dataset, [episode]).timing}
    camera_times = found["camera.wrist"]
    assert camera_times.repeated == 1
    assert camera_times.longest == pytest.approx(100.0)
    assert camera_times.oldest == pytest.approx(70.0)
    assert camera_times.jitter > 5.0
    assert found["camera.scene"].repeated == 0, "what never spoke does not count"
    assert found["camera.scene"].period == pytest.approx(50.0)


def test_an_episode_that_cannot_be_read_does_not_hide_the_others(tmp_path: Path) -> None:
    dataset = make_recording(tmp_path / "demo")
    (dataset.root / "data/chunk-000/file-001.parquet").write_bytes(b"nothing")
    found = summarize(Dataset(dataset.root))
    assert [line.number for line in found.episodes] == [0, 2]
    assert len(found.broken) == 1
    assert found.broken[0].startswith("episode 1: ")


def test_json_has_no_number_that_json_does_not_have(dataset: Dataset) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(text)

    found = json.loads(summary_as_json(summarize(dataset, dataset.episodes[:1])), parse_constant=refuse)
    assert found["rows"] == dataset.episodes[0].length
    assert found["timing"][0]["source"] == "robot.panda"


# The sheet.


def test_the_sheet_shows_pictures_curves_and_stops(dataset: Dataset) -> None:
    stopped, calm = (draw_sheet(dataset.episodes[k]) for k in (0, 1))
    for sheet in (stopped, calm):
        root = ElementTree.fromstring(sheet)
        assert root.get("width") == "1600"
        lines = [each.get("stroke") for each in root.iter("{http://www.w3.org/2000/svg}polyline")]
        assert lines.count(f"rgb{BLUE}") >= 8, "every joint and the gripper"
        assert lines.count(f"rgb{ORANGE}") >= 8
    assert f"rgb{RED}" in stopped
    assert f"rgb{PINK}" in stopped
    assert f"rgb{RED}" not in calm
    assert f"rgb{PINK}" not in calm
    data = base64.b64decode(re.findall(r"base64,([^\"]+)", stopped)[0])
    first = next(dataset.episodes[0].frames("scene"))
    corner = np.asarray(Image.open(io.BytesIO(data)))[8, 8].astype(int)
    assert np.abs(corner - first[1:5, 1:5].mean(axis=(0, 1))).max() < 25, "the first picture comes first"


def test_jerk_and_idle_time_rank_episodes(dataset: Dataset) -> None:
    line = summarize(dataset, [dataset.episodes[1]]).episodes[0]
    joints = dataset.episodes[1].columns["rig.setpoint"][:, :7].astype(float)
    steps = np.diff(joints, axis=0)
    assert line.idle == pytest.approx(np.mean(np.abs(steps).max(axis=1) * dataset.fps <= 0.02))
    assert line.jerk == pytest.approx(np.sqrt(np.mean((np.diff(steps, 2, axis=0) * dataset.fps**3) ** 2)))
    assert line.jerk > 0.0


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [(0.0, 1.0, [0.0, 0.5, 1.0]), (-0.21, 0.19, [-0.2, -0.1, 0.0, 0.1]), (0.0, 80.0, [0.0, 20.0, 40.0, 60.0, 80.0])],
)
def test_ticks_are_round(low: float, high: float, found: list[float]) -> None:
    assert ticks(low, high, 5) == pytest.approx(found)
