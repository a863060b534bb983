"""The simulated camera, and what draws its pictures: this process in lock-step, a process of its own in real time.

What is drawn is a copy of the world without physics. The process of its own poses it by the newest snapshot of the
servo's process, so neither the physics nor the app waits for a picture.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any, ClassVar, TypeAlias

from hal import registry
from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConfigError, ConnectionLost, DriverMissing, NotSupported, Problem
from hal.geometry import Pose
from hal.host.hosts import SNAPSHOT_CAPACITY, Host, LocalHost, RemoteHost
from hal.host.memory import SeriesBox
from hal.host.process import Channel, Child, SharedMemory, serve
from hal.host.ring import FrameRing, frame_rings, frame_rings_size
from hal.host.scheduling import yield_to_others
from hal.preflight import CheckResult
from hal.randomization import vary_camera
from hal.specs import CameraSpec, Plan, WorldSpec, from_json, to_json
from hal.views import CameraRenderer

from .drawn import DrawnWorld
from .exposure import Exposure, check_view
from .mirror import LocalMirror, WorldMirror
from .renderer import GLRenderer, Renderer

_NICE = 5
"""Niceness of the process that draws: pictures come after the servo."""
_IDLE = 0.001
"""Sleep where nothing is due, s."""


# --- the camera ------------------------------------------------------------------------------------------------------


class SimulatedCamera(CameraDriver):
    """A camera in the simulated world; ``source`` is one of :data:`FrameSource`."""

    simulated: ClassVar[bool] = True

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._open = False
        self._info = self.nominal_info(f"simulated {PurePath(spec.model).stem}")
        if spec.options:
            from .depth_noise import noise_of

            sensor = spec.depth_sensor if noise_of(spec) is not None else None
            if sensor is not None:  # with noise, depth comes in whole units, as from a real camera
                self._info = replace(self._info, depth_scale=sensor.unit)

    @property
    def info(self) -> CameraInfo:
        """The figures of the camera's model, by which the pictures are drawn."""
        return self._info

    def vary(self, values: Mapping[str, Any]) -> None:
        """Take the calibration that a randomization of the world gives this camera."""
        self._info = SimulatedCamera(vary_camera(self.spec, values)).info

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
        self._open = False


class DirectSource:
    """Source in lock-step: draws the present state of the world in the caller's thread, each state once.

    A camera with a latency draws the state that the world had before. Raises ConfigError if it has no place in the
    world.
    """

    def __init__(self, mirror: LocalMirror, renderer: Renderer, spec: CameraSpec, now: Callable[[], float]) -> None:
        check_view(mirror.drawn, spec)
        self._mirror = mirror
        self._renderer = renderer
        self._exposure = Exposure(spec)
        self._now = now
        self._seq = 0
        self._newest: tuple[tuple[int, int], RawFrame] | None = None
        """The newest frame, and the world's version that it shows."""

    def grab(self, timeout: float) -> RawFrame:
        mirror, version = self._mirror, self._mirror.world.version
        if self._newest is None or self._newest[0] != version:
            self._seq += 1
            randomized = mirror.drawn.randomized
            shown = mirror.update(randomized.get(f"cameras.{self._exposure.spec.name}", "latency_s"))
            t = self._now() - (mirror.world.t - shown)
            frame = self._exposure.capture(mirror.drawn, self._renderer, t, shown, self._seq)
            self._newest = version, frame
        return self._newest[1]


class SharedSource:
    """Source in real time: the newest picture of the process that draws, in the ring.

    ``check`` raises ConnectionLost when that process has ended.
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


FrameSource: TypeAlias = DirectSource | SharedSource


class SimulatedPictures(CameraRenderer):
    def __init__(self, host: Host, cameras: Sequence[CameraSpec], renderer: str) -> None:
        super().__init__(host, cameras, renderer)
        self._child: Child | None = None
        self._renderer: Renderer | None = None
        self._description = ""
        if isinstance(host, LocalHost):
            self._mirror = LocalMirror(host.cycle.world)
            self._renderer = choose_renderer(self._mirror.drawn, renderer)
            self.notes = tuple(_list_notes(self._mirror.drawn, self._renderer))
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
            self._child = Child("renderer", "hal.drivers.scene.camera:main", config, memories)
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
        return DirectSource(self._mirror, self._renderer, spec, self.host.now)

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        if self._child is not None:  # in lock-step the world itself reports its edits
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
        self,
        drawn: DrawnWorld,
        mirror: WorldMirror,
        renderer: Renderer,
        cameras: Sequence[CameraSpec],
        rings: dict[str, FrameRing],
    ) -> None:
        self._drawn = drawn
        self._mirror = mirror
        self._renderer = renderer
        self._cameras = cameras
        self._rings = rings
        for camera in cameras:
            check_view(drawn, camera)
        self._exposures = {camera.name: Exposure(camera) for camera in cameras}
        self._numbers = dict.fromkeys(self._exposures, 0)
        start = time.monotonic()
        self._due = {camera.name: start + k / len(cameras) / camera.rate_hz for k, camera in enumerate(cameras)}
        self._shown = dict.fromkeys(self._due, float("-inf"))
        """Time of the world in each camera's last picture, s."""
        self._late: list[tuple[float, str, RawFrame]] = []
        """Pictures of cameras with a latency, and when they are handed out, s on the monotonic clock."""
        self._handed_out = dict.fromkeys(self._exposures, 0)
        """Number of each camera's newest picture that was handed out."""

    def warm_up(self) -> None:
        """Draw every camera once, so that meshes and shaders are ready when the first snapshot comes."""
        for exposure in self._exposures.values():
            exposure.capture(self._drawn, self._renderer, 0.0, 0.0, 0)

    def run_once(self) -> float:
        """Draw the cameras that are due and return when the next one is due, s on the monotonic clock."""
        now = time.monotonic()
        waiting, self._late = self._late, []
        for due, name, frame in waiting:
            self._hand_out(due, name, frame, now)
        for camera in sorted(self._cameras, key=lambda camera: self._due[camera.name]):
            if self._due[camera.name] <= now:
                t = self._mirror.update()
                if t is None or t <= self._shown[camera.name]:
                    return now + _IDLE  # the world has not changed, or an edit has not arrived
                self._numbers[camera.name] += 1
                number = self._numbers[camera.name]
                frame = self._exposures[camera.name].capture(self._drawn, self._renderer, t, t, number)
                latency = self._exposures[camera.name].latency
                self._hand_out(t + latency if latency else now, camera.name, frame, time.monotonic())
                self._shown[camera.name] = t
                period = 1.0 / camera.rate_hz
                late = time.monotonic() - self._due[camera.name]
                self._due[camera.name] += period * max(1, int(late / period))  # missed pictures are left out
        return min([*self._due.values(), *(due for due, _, _ in self._late)])

    def _hand_out(self, due: float, name: str, frame: RawFrame, now: float) -> None:
        if due <= now:
            if frame.seq > self._handed_out[name]:  # a shorter latency makes newer pictures overtake older ones
                self._rings[name].write(frame)
                self._handed_out[name] = frame.seq
        else:
            self._late.append((due, name, frame))


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the process that draws; ``memories`` are that of the world's host and that of the pictures."""
    yield_to_others(_NICE)
    drawn = DrawnWorld(from_json(WorldSpec, config["world"]))
    cameras = [from_json(CameraSpec, camera) for camera in config["cameras"]]
    renderer = choose_renderer(drawn, config["renderer"])
    snapshots = SeriesBox(memories[0].buffer[config["snapshot_offset"] :], config["snapshot_capacity"])
    mirror = WorldMirror(drawn, snapshots)
    worker = RenderWorker(drawn, mirror, renderer, cameras, frame_rings(memories[1].buffer, cameras))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        worker.warm_up()
    notes = list(dict.fromkeys([*_list_notes(drawn, renderer), *(str(warning.message) for warning in caught)]))
    channel.send({"ready": {"renderer": renderer.description, "notes": notes}})

    def draw() -> float:
        time.sleep(min(_IDLE * 5, max(0.0, worker.run_once() - time.monotonic())))
        return 0.0

    serve(channel, {"edited": mirror.note_edit}, draw)


# --- renderers -------------------------------------------------------------------------------------------------------


def choose_renderer(scene: DrawnWorld, name: str = "auto") -> Renderer:
    """Return the renderer ``gl`` or ``tiny``, or with ``auto`` the first of them that works on this machine.

    Its ``description`` has the reason why ``gl`` was not chosen, and the remedy. Raises ConfigError for another name,
    and DriverMissing if the one that was named, or each of them, is not available.
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
    try:
        renderer: Renderer = registry.load(registry.provider("software_renderer"), "software_renderer")(scene)
    except DriverMissing as error:
        if reason:
            raise DriverMissing(f"no renderer for simulated cameras{reason}; or else: {error}") from error
        raise
    renderer.description += reason
    return renderer


def _list_notes(drawn: DrawnWorld, renderer: Renderer) -> list[str]:
    """Return messages for the user: what is not drawn as the rig and its files describe it."""
    ranges = drawn.spec.randomize.variations if drawn.spec.randomize is not None else ()
    kinds = {word for item in ranges for word in (item.key.split(".")[0], item.key.split(".")[-1])}
    constant = [word for word in ("light", "background", "texture", "exposure") if word in kinds]
    if not constant or isinstance(renderer, GLRenderer):
        return drawn.notes
    return [
        *drawn.notes,
        f"simulation.randomize: {', '.join(constant)}: without effect, as only OpenGL draws them; these pictures are "
        f"drawn by {renderer.description}",
    ]


def check_pictures(plan: Plan) -> Iterator[CheckResult]:
    """Draw a picture with each simulated camera of a rig, for ``hal check``."""
    assert plan.world is not None
    scene = DrawnWorld(plan.world)
    renderer = choose_renderer(scene, plan.renderer)
    try:
        found = []
        for camera in plan.cameras:
            if camera.driver == plan.world.driver:
                for _ in range(2):  # the first picture loads meshes
                    start = time.perf_counter()
                    renderer.render(camera, Pose())
                    spent = time.perf_counter() - start
                found.append(f"{camera.name} {camera.width}x{camera.height} in {1e3 * spent:.1f} ms")
        slow = plan.renderer == "auto" and not isinstance(renderer, GLRenderer)
        yield CheckResult(
            "renderer",
            "warn" if slow else "ok",
            f"{renderer.description}: {', '.join(found)}",
            "OpenGL draws several times as fast" if slow else "",
        )
    finally:
        renderer.close()
