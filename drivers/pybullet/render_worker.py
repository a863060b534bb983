"""The process that draws the pictures of all simulated cameras in real time.

It holds a mirror of the world, which it poses by the newest snapshot that the servo's process published, so neither
physics nor the app ever waits for a picture.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

from hal.host.memory import SeriesBox
from hal.host.process import Channel, SharedMemory, serve
from hal.host.ring import FrameRing, frame_rings
from hal.host.scheduling import yield_to_others
from hal.specs import CameraSpec, WorldSpec, from_json

from .exposure import Exposure, check_view
from .mirror import Mirror
from .rendering import Renderer, choose_renderer
from .world import World

__all__ = ["RenderWorker", "main"]

_NICE = 5
"""Pictures come after the servo."""
_IDLE = 0.001
"""s to sleep where nothing is due."""


class RenderWorker:
    """Draws each camera's picture at its rate, staggered, whenever the world has gone on since the last one."""

    def __init__(
        self, mirror: Mirror, renderer: Renderer, cameras: Sequence[CameraSpec], rings: dict[str, FrameRing]
    ) -> None:
        self._mirror = mirror
        self._renderer = renderer
        self._cameras = cameras
        self._rings = rings
        for camera in cameras:
            check_view(mirror.world, camera)
        self._exposures = {camera.name: Exposure(camera) for camera in cameras}
        self._numbers = dict.fromkeys(self._exposures, 0)
        start = time.monotonic()
        self._due = {camera.name: start + k / len(cameras) / camera.rate_hz for k, camera in enumerate(cameras)}
        self._shown = dict.fromkeys(self._due, float("-inf"))
        """Time of the world in each camera's last picture."""

    def warm_up(self) -> None:
        """Draw every camera once, so that meshes and shaders are ready when the first snapshot comes."""
        for exposure in self._exposures.values():
            exposure.take(self._mirror.world, self._renderer, 0.0, 0.0, 0)

    def run_once(self) -> float:
        """Draw the cameras that are due; returns when to come again, on the monotonic clock."""
        now = time.monotonic()
        for camera in sorted(self._cameras, key=lambda camera: self._due[camera.name]):
            if self._due[camera.name] <= now:
                t = self._mirror.update()
                if t is None or t <= self._shown[camera.name]:
                    return now + _IDLE  # the world stands still, or an edit is on its way
                self._numbers[camera.name] += 1
                number = self._numbers[camera.name]
                frame = self._exposures[camera.name].take(self._mirror.world, self._renderer, t, t, number)
                self._rings[camera.name].write(frame)
                self._shown[camera.name] = t
                period = 1.0 / camera.rate_hz
                late = time.monotonic() - self._due[camera.name]
                self._due[camera.name] += period * max(1, int(late / period))  # what was missed is left out
        return min(self._due.values())


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; ``memories`` are that of the world's host and that of the pictures."""
    yield_to_others(_NICE)
    world = World(from_json(WorldSpec, config["world"]), mirror=True)
    cameras = [from_json(CameraSpec, camera) for camera in config["cameras"]]
    renderer = choose_renderer(world, config["renderer"])
    snapshots = SeriesBox(memories[0].buffer[config["snapshot_offset"] :], config["snapshot_capacity"])
    mirror = Mirror(world, snapshots)
    worker = RenderWorker(mirror, renderer, cameras, frame_rings(memories[1].buffer, cameras))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        worker.warm_up()
    notes = list(dict.fromkeys(str(warning.message) for warning in caught))
    channel.send({"ready": {"renderer": renderer.description, "notes": notes}})

    def draw() -> float:
        time.sleep(min(_IDLE * 5, max(0.0, worker.run_once() - time.monotonic())))
        return 0.0

    serve(channel, {"edited": mirror.edited}, draw)
