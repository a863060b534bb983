"""A small recording to export: a mock rig in lock-step, three episodes; in the first one somebody stops the arm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_kit import drive, mock_rig, record

import hal
from hal.recording import Dataset, Recorder

MARKS = (True, False, None)


def make_recording(folder: Path) -> Dataset:
    """Episodes of 0.6, 0.4 and 0.3 s: a success with a stop in it, a failure, one that nobody marked."""
    with mock_rig() as rig, Recorder(rig, out=folder, fps=20, task="lift the cube") as recorder:
        recorder.start(seed=1)
        drive(rig, 0.3)
        arm = rig.robots["panda"]
        with arm.control(rate_hz=50, unattended=True) as control:
            for tick in rig.clock.rate(50):
                if tick.elapsed > 0.1:
                    break
                control.send(hal.Twist([0.0, 0.05, 0.0]))
            rig.stop()
            rig.clock.sleep(0.2)
            with pytest.raises(hal.MotionStopped):
                control.send(hal.Twist([0.0, 0.05, 0.0]))
        recorder.save(MARKS[0], wait=True)
        rig.rearm()
        record(recorder, 0.4, MARKS[1])
        record(recorder, 0.3, MARKS[2])
    return Dataset(folder)


def pictures(dataset: Dataset, what: str, camera: str) -> list[np.ndarray[Any, Any]]:
    """Of each episode, all in one array."""
    return [
        np.stack(list(episode.frames(camera) if what == "rgb" else episode.depth(camera)))
        for episode in dataset.episodes
    ]
