"""Who draws the pictures of a rig's simulated cameras: this process in lock-step, one of its own in real time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hal.errors import NotSupported
from hal.host.hosts import SNAPSHOT_CAPACITY, Host, LocalHost, RemoteHost
from hal.host.process import Child, SharedMemory
from hal.host.ring import frame_rings, frame_rings_size
from hal.specs import CameraSpec, to_json
from hal.views import Pictures

from .camera import DirectSource, FrameSource, SharedSource
from .rendering import Renderer, choose_renderer

__all__ = ["PyBulletPictures"]


class PyBulletPictures(Pictures):
    """The renderer of all simulated cameras of one world."""

    def __init__(self, host: Host, cameras: Sequence[CameraSpec], renderer: str) -> None:
        super().__init__(host, cameras, renderer)
        self._child: Child | None = None
        self._renderer: Renderer | None = None
        self._description = ""
        if isinstance(host, LocalHost):
            self._renderer = choose_renderer(host.cycle.world, renderer)
            self._description = self._renderer.description
        elif isinstance(host, RemoteHost):
            self._memory = SharedMemory(frame_rings_size(cameras))
            self._rings = frame_rings(self._memory.buffer, cameras)
            config = {
                "world": to_json(host.spec.world),
                "cameras": [to_json(camera) for camera in cameras],
                "renderer": renderer,
                "snapshot_offset": host.snapshot_offset,
                "snapshot_capacity": SNAPSHOT_CAPACITY,
            }
            memories = [host.shared, self._memory]
            self._child = Child("renderer", "hal.drivers.pybullet.render_worker:main", config, memories)
        else:
            raise NotSupported(f"no pictures from a {type(host).__name__}")

    def wait_ready(self) -> None:
        if self._child is not None:
            ready = self._child.wait_ready()
            self._description = ready["renderer"]
            self.notes = tuple(ready["notes"])

    def source(self, camera: str) -> FrameSource:
        spec = self.cameras[camera]
        if self._child is not None:
            return SharedSource(self._rings[camera], self._child.check)
        assert isinstance(self.host, LocalHost)
        assert self._renderer is not None
        return DirectSource(self.host.cycle.world, self._renderer, spec, self.host.now)

    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        if self._child is not None:  # in lock-step the renderer looks at the very world that was edited
            self._child.notify("edited", {"method": method, "params": params, "revision": revision})

    def describe(self) -> str:
        return self._description

    def close(self) -> None:
        if self._child is not None:
            self._child.close()
            self._memory.close()
        if self._renderer is not None:
            self._renderer.close()
