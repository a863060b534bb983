"""Small recordings of mock rigs, and a check of a dataset's layout that knows nothing of the recorder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import hal
from hal.rig import Rig

pa = pytest.importorskip("pyarrow", reason="pip install 'robot-hal[record]'")
av = pytest.importorskip("av", reason="pip install 'robot-hal[record]'")
pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

import pyarrow.parquet as pq  # noqa: E402

from hal.recording import Recorder  # noqa: E402

CAMERAS = ("scene", "wrist")
SIZE = (64, 48)


def small(width: int = SIZE[0], height: int = SIZE[1]) -> list[str]:
    """Overrides that make both cameras' pictures small."""
    return [
        f"cameras.{name}.output.{key}={value}"
        for name in CAMERAS
        for key, value in (("width", width), ("height", height))
    ]


def mock_rig(clock: str = "lock_step", *overrides: str, **more: Any) -> Rig:
    """A mock of the built-in rig."""
    return hal.open("panda_table", driver="mock", clock=clock, overrides=[*small(), *overrides], **more)


def drive(rig: Rig, seconds: float) -> None:
    """Move the arm a little."""
    arm = rig.robots["panda"]
    with arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            if tick.elapsed > seconds:
                break
            control.send(hal.Twist([0.0, 0.0, 0.05]), gripper=0.5)


def record(recorder: Recorder, seconds: float, success: bool | None = True) -> None:
    """One episode."""
    recorder.start(seed=1)
    drive(recorder.rig, seconds)
    recorder.save(success, wait=True)


TYPES = {"float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64()}
INDICES = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]


def check_layout(root: Path) -> dict[str, Any]:
    """A LeRobotDataset v3.0 with one file per episode, as its documentation and its loader have it; info comes back."""
    info: dict[str, Any] = json.loads((root / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    total, features = info["total_episodes"], info["features"]
    assert info["splits"] == {"train": f"0:{total}"}
    assert isinstance(info["fps"], int)
    assert info["chunks_size"] == 1000
    videos = [key for key, feature in features.items() if feature["dtype"] == "video"]
    assert not [key for key in features if "/" in key]
    for key in ("observation.state", "action"):
        assert features[key]["dtype"] == "float32"
        assert features[key]["shape"] == [len(features[key]["names"])]
    tasks = pq.read_table(root / "meta/tasks.parquet")
    assert tasks.schema.names == ["task_index", "__index_level_0__"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    assert len(tasks) == info["total_tasks"]

    files = sorted(root.glob("data/*/*.parquet"))
    entries = sorted(root.glob("meta/episodes/*/*.parquet"))
    assert len(files) == len(entries) == total
    stats = json.loads((root / "meta/stats.json").read_text())
    assert set(stats) == set(features)
    at = 0
    for number, (file, entry) in enumerate(zip(files, entries, strict=True)):
        place = {"chunk_index": number // 1000, "file_index": number % 1000}
        assert file == root / info["data_path"].format(**place)
        row = pq.read_table(entry).to_pylist()
        assert len(row) == 1
        row = row[0]
        length = row["length"]
        assert [row[key] for key in INDICES] == [number, length, at, at + length]
        assert row["tasks"][0] in tasks["__index_level_0__"].to_pylist()
        assert (row["data/chunk_index"], row["data/file_index"]) == (place["chunk_index"], place["file_index"])
        table = pq.read_table(file)
        assert table.schema.names == [key for key in features if key not in videos]
        for key in table.schema.names:
            kind, shape = TYPES[features[key]["dtype"]], features[key]["shape"]
            assert table.schema.field(key).type == (kind if shape == [1] else pa.list_(kind, shape[0])), key
            for part in ("min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99"):
                assert len(row[f"stats/{key}/{part}"]) == len(stats[key][part]) == shape[0], (key, part)
        assert table["index"].to_pylist() == list(range(at, at + length))
        assert table["frame_index"].to_pylist() == list(range(length))
        assert set(table["episode_index"].to_pylist()) == {number}
        stamps = table["timestamp"].to_numpy()
        assert abs(stamps - [k / info["fps"] for k in range(length)]).max() < 1e-5
        for key in videos:
            check_video(root / info["video_path"].format(video_key=key, **place), features[key], info["fps"], length)
            assert row[f"videos/{key}/from_timestamp"] == 0.0
            assert row[f"videos/{key}/to_timestamp"] == pytest.approx(length / info["fps"])
            assert len(stats[key]["mean"]) == 3
            assert len(stats[key]["mean"][0][0]) == 1
        at += length
    assert at == info["total_frames"]
    assert not list(root.glob("episodes/*.partial")), "nothing is left over"
    assert not list(root.rglob("*.new"))
    return info


def check_video(path: Path, feature: dict[str, Any], fps: int, length: int) -> None:
    """Every picture is there, at its time to within LeRobot's tolerance of 0.1 ms."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.codec.canonical_name == feature["info"]["video.codec"]
        assert stream.average_rate == fps
        times = []
        for frame in container.decode(stream):
            times.append(float(frame.pts * stream.time_base))
            assert [frame.height, frame.width, 3] == feature["shape"]
    assert len(times) == length
    assert all(abs(t - k / fps) < 1e-4 for k, t in enumerate(times))
