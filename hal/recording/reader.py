"""Reading what was recorded: columns as arrays, pictures one by one."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, DeviceNotFound
from .columns import TIMES
from .depth import DepthReader
from .layout import Layout, read_json
from .library import require
from .video import read_video

__all__ = ["Dataset", "Episode"]


class Episode:
    """One episode. Nothing is read before it is asked for."""

    def __init__(self, layout: Layout, number: int, meta: dict[str, Any]) -> None:
        self._layout = layout
        self._meta = meta
        self.number = number
        self.fps: int = meta["fps"]

    @cached_property
    def info(self) -> dict[str, Any]:
        """What else is known: seed, cameras, gaps, versions, the rig's whole configuration. As ``episodes/N.json``."""
        found: dict[str, Any] = read_json(self._layout.about(self.number))
        return found

    @property
    def length(self) -> int:
        """Number of rows."""
        return int(self.info["length"])

    @property
    def task(self) -> str:
        """What was to be done."""
        return str(self.info["task"])

    @property
    def success(self) -> bool | None:
        """Was it? None where nobody said."""
        mark = self.info["success"]
        return None if mark is None else bool(mark)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Every column by its key: (rows, n), or (rows,) where it is one number."""
        import pyarrow.parquet as pq

        table = pq.read_table(self._layout.data(self.number))
        found = {}
        for key in table.column_names:
            column = table[key].combine_chunks()
            shape = self._meta["features"][key]["shape"]
            values = column.flatten() if shape != [1] else column
            found[key] = values.to_numpy(zero_copy_only=False).reshape(-1, *(shape if shape != [1] else ()))
        return found

    def names(self, key: str) -> list[str]:
        """What the numbers of a column are."""
        return list(self._meta["features"][key]["names"] or [key])

    @cached_property
    def stamps(self) -> dict[str, NDArray[np.float64]]:
        """True times (rows,) on the rig's clock, s: ``grid``, when each row was due, and of each source
        (``robot.panda``, ``camera.wrist``) when it measured what stands in the row. NaN where it never did."""
        start = float(self.info["t_start"])
        times = {key.removeprefix(TIMES): value for key, value in self.columns.items() if key.startswith(TIMES)}
        return {name: start + (value if value.ndim == 1 else value[:, 0]) for name, value in times.items()}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose pictures were kept."""
        return tuple(self.info["cameras"])

    def frames(self, camera: str) -> Iterator[NDArray[np.uint8]]:
        """The colour picture (H, W, 3) RGB of every row. DeviceNotFound where none was kept."""
        return read_video(self._kept(self._layout.video(camera, self.number), camera, "colour"))

    def depth(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """The depth picture (H, W) of every row, m; 0 for what was not measured. DeviceNotFound where none was kept."""
        return iter(DepthReader(self._kept(self._layout.depth(camera, self.number), camera, "depth")))

    def _kept(self, path: Path, camera: str, what: str) -> Path:
        if not path.exists():
            there = ", ".join(self.cameras) or "none"
            raise DeviceNotFound(f"episode {self.number} has no {what} of a camera {camera!r}; cameras: {there}")
        return path

    def __len__(self) -> int:
        return self.length

    def __repr__(self) -> str:
        return f"<Episode {self.number}: {self.length} rows at {self.fps} Hz, {self.task!r}>"


class Dataset:
    """The finished episodes in a folder. Raises CommandError where there are none, DriverMissing."""

    def __init__(self, out: str | Path) -> None:
        require()
        layout = Layout(out)
        if not layout.info.exists():
            raise CommandError(f"there is no episode in {layout.root}{_hint(layout)}")
        self.root = layout.root
        self.info: dict[str, Any] = read_json(layout.info)
        """``meta/info.json``."""
        self.fps: int = self.info["fps"]
        self.episodes = tuple(Episode(layout, number, self.info) for number in range(self.info["total_episodes"]))

    def __len__(self) -> int:
        return len(self.episodes)

    def __repr__(self) -> str:
        return f"<Dataset {self.root}: {len(self.episodes)} episodes, {self.info['total_frames']} rows>"


def _hint(layout: Layout) -> str:
    """How to mend what was not finished; nothing where all was."""
    left = len(layout.partials())
    if not left:
        return ""
    call = f"from hal.recording import recover; print(recover({str(layout.root)!r}))"
    many = "is one" if left == 1 else f"are {left}"
    return f"; there {many} not finished; mend that with: python -c {shlex.quote(call)}"
