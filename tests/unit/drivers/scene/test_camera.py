"""The simulated camera: where it is, what it stamps, and how the process that draws follows the world's edits."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from engines_kit import need_engine
from errors_kit import raises_code
from pictures_kit import box, camera, drawn, look_at, renderer, stepped
from specs import data, panda, world_spec

from hal.driver import RawFrame
from hal.drivers.scene.camera import (
    DirectSource,
    RenderWorker,
    SharedSource,
    SimulatedCamera,
    SimulatedPictures,
    choose_renderer,
)
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.exposure import camera_pose
from hal.drivers.scene.mirror import LocalMirror, WorldMirror
from hal.drivers.scene.renderer import create_context
from hal.drivers.scene.world import SimulatedWorld
from hal.errors import ConfigError, ConnectionLost, DriverMissing, NotSupported
from hal.geometry import Pose
from hal.host.hosts import RemoteHost
from hal.host.memory import SeriesBox
from hal.host.ring import frame_rings, frame_rings_size
from hal.specs import BodySpec, GroupSpec, ViewSpec, to_json

STILL = (0.0, 0.0, 0.0, 1.0)
ABOVE = look_at((0.0, 0.0, 1.2), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
FROM_ABOVE = ViewSpec(tuple(ABOVE.position), tuple(ABOVE.orientation))


def ball(name: str, x: float, **more: object) -> BodySpec:
    return BodySpec(name, (x, 0.0, 0.1), STILL, "sphere", radius=0.1, **{"mass": 1.0, **more})


class TestDirect:
    """Lock-step."""

    def test_an_attached_camera_follows_its_link(self) -> None:
        view = ViewSpec((0.02, -0.05, 0.1), (0.0, 0.38268343, 0.0, 0.92387953), "panda", "panda_hand")
        spec = camera(40, 30, view=view)
        with stepped(robots=(panda(),)) as world:
            mirror = LocalMirror(world)
            driver = SimulatedCamera(
                spec, DirectSource(mirror, renderer("tiny", mirror.drawn), spec, lambda: 10.0 + world.t)
            )
            driver.open()
            before = driver.grab(0.0)
            world.reset("panda", q=[0.5, -0.3, 0.2, -1.8, 0.1, 1.4, 0.2])
            after = driver.grab(0.0)
            distance, angle = before.T_world_camera.distance(after.T_world_camera)
            assert distance > 0.1
            assert angle > 0.1
            link = world.pose("panda", "panda_hand")
            expected = Pose(link["position"], link["orientation"]) @ Pose(view.position, view.orientation)
            assert after.T_world_camera.distance(expected) == pytest.approx((0.0, 0.0), abs=1e-6)

    def test_camera_without_a_place_is_refused(self) -> None:
        with stepped(robots=(panda(),)) as world:
            mirror = LocalMirror(world)
            draws = renderer("tiny", mirror.drawn)
            with pytest.raises(ConfigError):
                DirectSource(mirror, draws, camera(view=None), lambda: 0.0)
            nowhere = ViewSpec((0.0, 0.0, 0.0), STILL, "panda", "panda_hnad")
            with pytest.raises(ConfigError, match="panda_hand"):
                DirectSource(mirror, draws, camera(view=nowhere), lambda: 0.0)

    def test_camera_without_a_world_is_refused(self) -> None:
        with raises_code(NotSupported, "world_missing"):
            SimulatedCamera(camera()).open()


class Bench:
    """A stepped world that publishes, and a worker that draws, in one process."""

    def __init__(self, world: SimulatedWorld[Any]) -> None:
        self.world = world
        self.box = SeriesBox(memoryview(bytearray(SeriesBox.size(256))), 256)
        self.spec = camera(80, 60, view=FROM_ABOVE, rate_hz=10000.0)
        specs = [self.spec]
        buffer = memoryview(bytearray(frame_rings_size(specs)))
        shown = DrawnWorld(self.world.spec)
        self.mirror = WorldMirror(shown, self.box)
        self.worker = RenderWorker(shown, self.mirror, renderer("tiny", shown), specs, frame_rings(buffer, specs))
        self.source = SharedSource(frame_rings(buffer, specs)[self.spec.name], lambda: None)
        self.t = 0.0

    def publish(self) -> None:
        self.t += 0.01
        self.box.write(self.t, self.world.revision, self.world.snapshot())

    def drawn(self) -> RawFrame | None:
        """Let the worker draw; return its frame, if it drew one."""
        self.worker.run_once()
        return self.source.grab(0.0)

    def next_frame(self) -> RawFrame | None:
        self.publish()
        return self.drawn()

    def edit(self, method: str, **params: object) -> tuple[str, dict[str, object], int]:
        return method, params, self.world.request(method, params)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with stepped(box("floor", (2.0, 2.0, 0.05), (0.0, 0.0, -0.05)), ball("ball", 0.0)) as world:
        yield Bench(world)


class TestWorker:
    """Real time."""

    def test_worker_draws_published_snapshots(self, bench: Bench) -> None:
        bench.worker.warm_up()
        assert bench.drawn() is None  # nothing was published yet
        first = bench.next_frame()
        assert first.t == bench.t
        assert bench.drawn() is None  # the world stands still: no new picture of the same moment
        bench.world.set_pose("ball", {"position": [0.3, 0.0, 0.1], "orientation": list(STILL)})
        second = bench.next_frame()
        assert second.t == bench.t
        assert (first.segmentation == 1).any()
        rows = [np.flatnonzero((image == 1).any(axis=1)).mean() for image in (first.segmentation, second.segmentation)]
        assert rows[0] - rows[1] > 5  # +x is up in this picture

    def test_edit_is_made_before_its_snapshot_is_shown(self, bench: Bench) -> None:
        assert bench.next_frame() is not None
        add = bench.edit("add", spec=to_json(ball("second", 0.3, rgba=(1.0, 0.0, 0.0, 1.0))))
        paint = bench.edit("set_color", name="second", rgba=[0.0, 0.0, 1.0, 1.0])
        assert bench.next_frame() is None  # the snapshot overtook the edits
        bench.mirror.note_edit(*paint)  # and these overtook each other
        assert bench.drawn() is None
        bench.mirror.note_edit(*add)
        frame = bench.drawn()
        seen = frame.segmentation == 2
        assert seen.sum() > 20
        red, _, blue = frame.color[seen].mean(axis=0)
        assert blue > red + 50

    def test_an_edit_waits_for_its_snapshot(self, bench: Bench) -> None:
        bench.publish()
        remove = bench.edit("remove", name="ball")
        bench.mirror.note_edit(*remove)
        frame = bench.drawn()  # the snapshot still has the ball
        assert 1 in np.unique(frame.segmentation)
        frame = bench.next_frame()
        assert 1 not in np.unique(frame.segmentation)
        assert 0 in np.unique(frame.segmentation)


class TestChoice:
    """Which renderer is taken, and what is said of it."""

    def no_gl(self) -> object:
        raise DriverMissing("no EGL; apt install libegl1 libgl1-mesa-dri")

    def test_without_gl_the_tiny_renderer_draws_and_gives_the_reason(self, monkeypatch: pytest.MonkeyPatch) -> None:
        need_engine("pybullet")
        scene = drawn(box("wall", (1.0, 1.0, 0.1), (0.0, 0.0, 1.0)))
        monkeypatch.setattr("hal.drivers.scene.renderer.create_context", self.no_gl)
        chosen = choose_renderer(scene)
        assert "TinyRenderer" in chosen.description
        assert "apt install libegl1" in chosen.description
        images = chosen.render(camera(16, 12), camera_pose(scene, camera(16, 12)))
        assert (images.depth > 0).all()
        with pytest.raises(DriverMissing):
            choose_renderer(scene, "gl")
        assert "apt install" not in choose_renderer(scene, "tiny").description
        with pytest.raises(ConfigError):
            choose_renderer(scene, "opengl")

    def test_missing_moderngl_is_a_missing_driver(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(__import__("sys").modules, "moderngl", None)
        with pytest.raises(DriverMissing):
            create_context()

    def test_gl_is_the_first_choice(self) -> None:
        scene = drawn(box("wall", (1.0, 1.0, 0.1), (0.0, 0.0, 1.0)))
        renderer("gl", scene).close()  # or skip
        chosen = choose_renderer(scene)
        assert "OpenGL on " in chosen.description
        chosen.close()
        chosen.close()


def test_gl_draws_from_any_thread() -> None:
    import threading

    scene = drawn(box("wall", (0.2, 0.2, 0.1), (0.0, 0.0, 1.0)))
    draws = renderer("gl", scene)
    spec = camera(40, 30)
    found = []

    def draw() -> None:
        found.append(draws.render(spec, camera_pose(scene, spec)))

    for _ in range(2):
        thread = threading.Thread(target=draw)
        thread.start()
        thread.join()
    draw()
    assert len(found) == 3
    assert np.ptp(found[0].depth) > 0.5
    assert all(np.array_equal(found[0].depth, images.depth) for images in found)
    draws.close()


def newest(driver: SimulatedCamera, after: float) -> RawFrame:
    """A frame that shows the world later than ``after``."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        frame = driver.grab(0.5)
        if frame is not None and frame.t > after:
            return frame
    raise AssertionError("no frame came")


def test_renderer_process_draws_follows_edits_and_reports_its_end() -> None:
    data("plane.urdf")  # skips where PyBullet is not installed
    spec = world_spec(box("floor", (2.0, 2.0, 0.05), (0.0, 0.0, -0.05)), box("block", (0.1, 0.1, 0.1), (0.0, 0.0, 0.1)))
    cameras = [camera(64, 48, name=name, view=FROM_ABOVE) for name in ("one", "two")]
    host = RemoteHost(GroupSpec("world", "real_time", 240.0, (), spec))
    pictures = SimulatedPictures(host, cameras, "tiny")
    try:
        pictures.wait_ready()
        host.wait_ready()
        assert "TinyRenderer" in pictures.describe()
        assert "one" in pictures
        drivers = [SimulatedCamera(camera, pictures.source(camera.name)) for camera in cameras]
        start = time.monotonic()
        for driver in drivers:
            driver.open()
            frame = newest(driver, start - 1.0)
            assert frame.t <= time.monotonic()
            assert frame.color is not None
            assert 1 in np.unique(frame.segmentation)
            again = newest(driver, frame.t)
            assert again.seq > frame.seq

        paint = {"name": "block", "rgba": [0.0, 0.0, 1.0, 1.0]}
        pictures.note_edit("set_color", paint, host.request("world.set_color", paint))
        blue = newest(drivers[0], time.monotonic())
        red, _, strong = blue.color[blue.segmentation == 1].mean(axis=0)
        assert strong > red + 50

        os.kill(pictures._child.process.pid, signal.SIGKILL)
        with pytest.raises(ConnectionLost):
            newest(drivers[0], time.monotonic())
    finally:
        pictures.close()
        pictures.close()
        host.close()
