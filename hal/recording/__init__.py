"""Recordings of demonstrations: a crash-safe recorder, recovery after a crash, a reader, and curation.

    from hal.recording import Dataset, Recorder, recover

    recorder = Recorder(rig, out="data/demo", fps=30, task="lift the cube")
    recorder.start(seed=1)
    ...                                    # drive; the recorder runs in the background
    recorder.save(success=True)
    recorder.close()

    for episode in Dataset("data/demo").episodes: print(episode.length, episode.columns["action"].shape)

The format is LeRobotDataset v3.0, with lossless depth, the true time stamps and the rig's whole configuration in
further files (docs/record.md). Needs ``pip install 'robot-hal[record]'``; importing this package does not.
"""

from __future__ import annotations

from .changing import mark_episodes
from .curation import find_motion, split, trim
from .dataset import CameraDepth, Dataset, Episode, EpisodeDepth, KeptRows
from .merging import delete_episodes, extract, merge, pack, set_task
from .recorder import Recorder, RecorderStatus
from .repairing import recover, repair

__all__ = [
    "CameraDepth",
    "Dataset",
    "Episode",
    "EpisodeDepth",
    "KeptRows",
    "Recorder",
    "RecorderStatus",
    "delete_episodes",
    "extract",
    "find_motion",
    "mark_episodes",
    "merge",
    "pack",
    "recover",
    "repair",
    "set_task",
    "split",
    "trim",
]
