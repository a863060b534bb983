"""The simulated camera, and what draws its pictures: this process in lock-step, a process of its own in real time.

That process holds a mirror of the world, which it poses by the newest snapshot of the servo's process, so neither the
physics nor the app waits for a picture.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConfigError, ConnectionLost, DriverMissing, NotSupported, Problem
from hal.geometry import Pose
from hal.host.hosts import SNAPSHOT_CAPACITY, Host, LocalHost, RemoteHost
from hal.host.memory import SeriesBox
from hal.host.process import Channel, Child, SharedMemory, serve
from hal.host.ring import FrameRing, frame_rings, frame_rings_size
from hal.host.scheduling import yield_to_others
from hal.specs import CameraSpec, WorldSpec, from_json, to_json
from hal.views import CameraRenderer

from .exposure import Exposure, check_view, noise_of
from .mirror import WorldMirror
from .renderer import BACKGROUND, LUMINANCE, GLRenderer, RenderedImages, Renderer
from .world import PyBulletWorld

__all__ = [
    "DirectSource",
    "FrameSource",
    "PyBulletCamera",
    "PyBulletPictures",
    "RenderWorker",
    "SharedSource",
    "TinyRenderer",
    "choose_renderer",
    "main",
]

_NICE = 5
"""Niceness of the process that draws: pictures come after the servo."""
_IDLE = 0.001
"""Sleep where nothing is due, s."""


# --- the camera ------------------------------------------------------------------------------------------------------


class FrameSource(Protocol):
    """Source of the frames of one camera."""

    def grab(self, timeout: float) -> RawFrame | None:
        """Return the next frame, as :meth:`hal.camera.CameraDriver.grab`."""


class PyBulletCamera(CameraDriver):
    """A camera in the simulated world; ``source`` is a :class:`FrameSource`."""

    simulated: ClassVar[bool] = True

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._open = False
        info = self.nominal_info(f"simulated {PurePath(spec.model).stem}")
        sensor = spec.depth_sensor if noise_of(spec) is not None else None
        # With noise, depth comes in whole units, as from a real camera.
        self._info = replace(info, depth_scale=sensor.unit) if sensor is not None else info

    @property
    def info(self) -> CameraInfo:
        """The figures of the camera's model, by which the pictures are drawn."""
        return self._info

    def open(self) -> None:
        if not hasattr(self.source, "grab"):
            raise NotSupported(
                f"camera {self.spec.name} is simulated: it needs a simulated world", code="world_missing"
            )
        self._open = True

    def grab(self, timeout: float) -> RawFrame | None:
        if not self._open:
            raise ConnectionLost(f"camera {self.spec.name} is not open")
        source: FrameSource = self.source  # type: ignore[assignment]  # checked by open
        try:
            return source.grab(timeout)
        except ConnectionLost as error:  # the process that draws has ended, and is not started again
            lost = ConnectionLost(f"{error}; open the rig again")
            lost.final = True
            raise lost from error

    def close(self) -> None:
        """Disconnect; the rig owns the source."""
        self._open = False


class DirectSource:
    """Source in lock-step: draws the present state of the world in the caller's thread, each state once.

    Args:
        world: The world.
        renderer: Draws it.
        spec: The camera.
        now: The clock of the rig.

    Raises:
        ConfigError: The camera has no place in the world.
    """

    def __init__(self, world: PyBulletWorld, renderer: Renderer, spec: CameraSpec, now: Callable[[], float]) -> None:
        check_view(world, spec)
        self._world = world
        self._renderer = renderer
        self._exposure = Exposure(spec)
        self._now = now
        self._seq = 0
        self._drawn: tuple[tuple[int, int], RawFrame] | None = None
        """The newest frame, and the world's version that it shows."""

    def grab(self, timeout: float) -> RawFrame:
        version = self._world.version
        if self._drawn is None or self._drawn[0] != version:
            self._seq += 1
            frame = self._exposure.capture(self._world, self._renderer, self._now(), self._world.t, self._seq)
            self._drawn = version, frame
        return self._drawn[1]


class SharedSource:
    """Source in real time: the newest picture of the process that draws.

    Args:
        ring: Where that process puts the camera's pictures.
        check: Raises ConnectionLost when that process has ended.
    """

    def __init__(self, ring: FrameRing, check: Callable[[], None]) -> None:
        self._ring = ring
        self._check = check
        self._seq = 0

    def grab(self, timeout: float) -> RawFrame | None:
        frame = self._ring.wait(self._seq, timeout)
        if frame is None:
            self._check()
        else:
            self._seq = frame.seq
        return frame


class PyBulletPictures(CameraRenderer):
    """Draws the pictures of all simulated cameras of one world."""

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
            self._child = Child("renderer", "hal.drivers.pybullet.camera:main", config, memories)
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
        if self._child is not None:  # in lock-step the renderer draws the very world that was edited
            self._child.notify("edited", {"method": method, "params": params, "revision": revision})

    def describe(self) -> str:
        return self._description

    def close(self) -> None:
        if self._child is not None:
            self._child.close()
            self._memory.close()
        if self._renderer is not None:
            self._renderer.close()


# --- the process that draws ------------------------------------------------------------------------------------------


class RenderWorker:
    """Draws each camera's picture at its rate, staggered, whenever the world has changed since the last one."""

    def __init__(
        self, mirror: WorldMirror, renderer: Renderer, cameras: Sequence[CameraSpec], rings: dict[str, FrameRing]
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
        """Time of the world in each camera's last picture, s."""

    def warm_up(self) -> None:
        """Draw every camera once, so that meshes and shaders are ready when the first snapshot comes."""
        for exposure in self._exposures.values():
            exposure.capture(self._mirror.world, self._renderer, 0.0, 0.0, 0)

    def run_once(self) -> float:
        """Draw the cameras that are due and return when the next one is due, s on the monotonic clock."""
        now = time.monotonic()
        for camera in sorted(self._cameras, key=lambda camera: self._due[camera.name]):
            if self._due[camera.name] <= now:
                t = self._mirror.update()
                if t is None or t <= self._shown[camera.name]:
                    return now + _IDLE  # the world has not changed, or an edit has not arrived
                self._numbers[camera.name] += 1
                number = self._numbers[camera.name]
                frame = self._exposures[camera.name].capture(self._mirror.world, self._renderer, t, t, number)
                self._rings[camera.name].write(frame)
                self._shown[camera.name] = t
                period = 1.0 / camera.rate_hz
                late = time.monotonic() - self._due[camera.name]
                self._due[camera.name] += period * max(1, int(late / period))  # missed pictures are left out
        return min(self._due.values())


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the process that draws; ``memories`` are that of the world's host and that of the pictures."""
    yield_to_others(_NICE)
    world = PyBulletWorld(from_json(WorldSpec, config["world"]), mirror=True)
    cameras = [from_json(CameraSpec, camera) for camera in config["cameras"]]
    renderer = choose_renderer(world, config["renderer"])
    snapshots = SeriesBox(memories[0].buffer[config["snapshot_offset"] :], config["snapshot_capacity"])
    mirror = WorldMirror(world, snapshots)
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


# --- renderers -------------------------------------------------------------------------------------------------------


def choose_renderer(scene: PyBulletWorld, name: str = "auto") -> Renderer:
    """Return the renderer ``gl`` or ``tiny``, or with ``auto`` the first of them that works on this machine.

    Its ``description`` has the reason why ``gl`` was not chosen, and the remedy.

    Raises:
        ConfigError: No renderer of that name.
        DriverMissing: ``gl`` was required by name and is not available.
    """
    if name not in ("auto", "gl", "tiny"):
        message = f"is {name!r}; renderers: auto, gl, tiny"
        raise ConfigError([Problem("simulation", "simulation.renderer", message, "unknown_renderer")])
    reason = ""
    if name != "tiny":
        try:
            return GLRenderer(scene)
        except DriverMissing as error:
            if name == "gl":
                raise
            reason = f"; OpenGL is not available: {error}"
    renderer = TinyRenderer(scene)
    renderer.description += reason
    return renderer


_NEAR, _FAR = 0.05, 20.0
"""Range of its depth, m; depth is stored as a share between the two, so they set its resolution (3 um at 1 m)."""
_SAMPLE = (0.0, 1.0)
"""Place in a pixel at which it samples, from the upper left corner; measured against tilted planes."""


class TinyRenderer(Renderer):
    """PyBullet's own renderer, in software and without shadows: always available, several times slower than OpenGL."""

    def __init__(self, scene: PyBulletWorld) -> None:
        self._scene = scene
        self.description = "PyBullet's TinyRenderer, several times slower than OpenGL"

    def render(self, camera: CameraSpec, T_world_camera: Pose) -> RenderedImages:
        client = self._scene.client
        wanted = camera.streams
        flags = 0 if "segmentation" in wanted else client.ER_NO_SEGMENTATION_MASK
        _, _, rgba, depth, segmentation = client.getCameraImage(
            camera.width,
            camera.height,
            _column_major(np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(T_world_camera.matrix())),
            _column_major(_projection(camera)),
            shadow=0,
            flags=flags,
            renderer=client.ER_TINY_RENDERER,
        )
        shape = (camera.height, camera.width)
        share = np.asarray(depth, np.float32).reshape(shape)
        color = np.ascontiguousarray(np.asarray(rgba, np.uint8).reshape(*shape, 4)[..., :3])
        color[share == 1.0] = np.round(255 * np.array(BACKGROUND))
        return RenderedImages(
            color if "color" in wanted else None,
            _metres(share, camera.depth_min, camera.depth_max) if "depth" in wanted else None,
            np.round(color @ np.array(LUMINANCE)).astype(np.uint8) if "infrared" in wanted else None,
            self._indices(np.asarray(segmentation).reshape(shape)) if "segmentation" in wanted else None,
        )

    def _indices(self, numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        bodies = {body.id: body.index for body in self._scene.bodies.values()}
        table = np.full(max(bodies, default=0) + 2, -1, np.int32)
        table[list(bodies)] = list(bodies.values())
        return table[numbers]  # -1, the background, takes the last one, which is -1


def _metres(share: NDArray[np.float32], nearest: float, farthest: float) -> NDArray[np.float32]:
    """Return depth along the axis, m, 0 outside the camera's range, of OpenGL's share between near and far."""
    depth: NDArray[np.float32] = np.float32(_FAR * _NEAR) / (np.float32(_FAR) - np.float32(_FAR - _NEAR) * share)
    depth[(depth < nearest) | (depth > farthest) | (share == 1.0)] = 0
    return depth


def _projection(camera: CameraSpec) -> NDArray[np.float64]:
    """Return OpenGL's projection (4, 4) for any K; rows of the picture downwards, camera looking along -z."""
    K = np.array(camera.K)
    matrix = np.zeros((4, 4))
    matrix[0, :3] = K[0] * 2 / camera.width
    matrix[0, 2] += 2 * _SAMPLE[0] / camera.width - 1
    matrix[1, :3] = K[1] * 2 / camera.height
    matrix[1, 2] += 2 * _SAMPLE[1] / camera.height - 1
    matrix[1] *= -1
    matrix[2, 2:] = (_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)
    matrix[3, 2] = 1
    projection: NDArray[np.float64] = matrix @ np.diag([1.0, -1.0, -1.0, 1.0])
    return projection


def _column_major(matrix: NDArray[np.float64]) -> list[float]:
    values: list[float] = matrix.T.reshape(-1).tolist()
    return values
