"""``hal calibrate intrinsics`` on a video of rendered pictures of the board, whose lens is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="needs OpenCV: pip install 'robot-hal[calibration]'")
pytest.importorskip("av", reason="needs PyAV: pip install 'robot-hal[record]'")

import av
import cv2
from calibration_kit import SIZE, WEBCAM, K, hold, picture

from hal.apps import calibrate
from hal.config import load
from hal.images import distort_points

RIG = """
sim: false
cameras:
  # above the table
  scene: {model: webcam, drivers: {real: video}, capture: {width: 640, height: 480, rate_hz: 5}, real: {file: v.mkv}}
"""


def test_the_lens_of_a_video_is_found_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with av.open(tmp_path / "v.mkv", "w") as container:
        stream = container.add_stream("ffv1", rate=5)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "gray"
        for pose in hold(30):
            frame = av.VideoFrame.from_ndarray(picture(pose, cv2, WEBCAM, finer=2), format="gray")
            for packet in stream.encode(frame):
                container.mux(packet)
        container.mux(stream.encode())
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG)
    assert calibrate.main(["intrinsics", "--config", str(rig), "--views", "20", "--yes"]) == 0
    assert "view 20 of 20" in capsys.readouterr().out
    assert "# above the table" in rig.read_text()
    found = load(rig).resolve().cameras[0]
    rays = np.dstack(np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7))).reshape(-1, 2)
    cameras = (found.distortion, np.array(found.K)), (WEBCAM, K)
    seen, true = (distort_points(rays, lens) @ k[:2, :2].T + k[:2, 2] for lens, k in cameras)
    assert np.abs(seen - true).max() < 2.5, "the principal point is known to a pixel or two"


def test_a_camera_that_knows_its_lens_is_refused(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("cameras: {scene: {model: realsense_d435, sim: false, real: {}}}")
    assert calibrate.main(["intrinsics", "--config", str(rig)]) == 2
    rig.write_text("cameras: {scene: {model: webcam, pose: [0, 0, 1, 1, 0, 0, 0]}}")
    assert calibrate.main(["intrinsics", "--config", str(rig)]) == 2
