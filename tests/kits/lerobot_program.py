"""Run by the interpreter of a LeRobot environment: what LeRobot reads in datasets, and what its own tools make of them.

    python lerobot_program.py '[["delete", "SOURCE", "OUT", [1]], ["read", "FOLDER", "items.npz"]]'

Jobs: ``read`` writes every item of a dataset into one file; ``delete``, ``split``, ``merge``, ``remove`` and ``add``
call LeRobot's tools.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import dataset_tools as tools
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def opened(folder: str) -> Any:
    """Return a dataset, read with PyAV."""
    return LeRobotDataset(f"local/{Path(folder).name}", root=folder, video_backend="pyav")


def read(folder: str, out: str) -> None:
    """Write all items of a dataset: numbers as they are, pictures (H, W, 3) as bytes."""
    found: dict[str, list[Any]] = {}
    dataset = opened(folder)
    for k in range(dataset.num_frames):
        for key, value in dataset[k].items():
            if key.startswith("observation.images"):
                value = np.round(value.numpy() * 255).astype(np.uint8).transpose(1, 2, 0)
            found.setdefault(key, []).append(value if isinstance(value, str) else np.asarray(value))
    np.savez(out, **{key: np.array(values) for key, values in found.items()})


def edit(job: str, source: str, out: str, *more: Any) -> None:
    """Call one of LeRobot's tools."""
    dataset, name = opened(source), f"local/{Path(out).name}"
    if job == "delete":
        tools.delete_episodes(dataset, *more, Path(out), name)
    elif job == "split":
        tools.split_dataset(dataset, *more, Path(out))
    elif job == "merge":
        tools.merge_datasets([dataset, dataset], name, Path(out))
    elif job == "remove":
        tools.remove_feature(dataset, *more, Path(out), name)
    else:
        values = np.linspace(0.0, 1.0, dataset.num_frames, dtype=np.float32)[:, None]
        feature = {"dtype": "float32", "shape": (1,), "names": None}
        tools.add_features(dataset, {"reward": (values, feature)}, Path(out), name)


if __name__ == "__main__":
    for first, *rest in json.loads(sys.argv[1]):
        read(*rest) if first == "read" else edit(first, *rest)
