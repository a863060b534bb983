"""The frames of a simulated depth camera: each picture from where its sensor is, at its rate, with its own matrix."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pictures_kit import box, drawn, look_at, renderer, stepped

from hal.camera import Camera
from hal.clock import LockStepClock
from hal.config import load
from hal.drivers.scene.camera import DirectSource, RenderWorker, SharedSource, SimulatedCamera
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.exposure import Exposure
from hal.drivers.scene.mirror import LocalMirror, WorldMirror
from hal.drivers.scene.renderer import RenderedImages, Renderer
from hal.drivers.scene.world import SimulatedWorld
from hal.geometry import Pose
from hal.host.memory import SeriesBox
from hal.host.ring import FrameRing, frame_rings
from hal.specs import CameraSpec
from hal.types import Frame

EYE = look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # straight down: x is right, y up in the picture
SMALL = {"width": 160, "height": 120}
EVERYTHING = ["color", "depth", "infrared", "infrared_right", "segmentation"]


def camera(model: str = "realsense_d435", **keys: Any) -> CameraSpec:
    pose = {"position": EYE.position.tolist(), "orientation": EYE.orientation.tolist()}
    eye = {"model": model, "pose": pose, "output": SMALL, "streams": EVERYTHING, **keys}
    (spec,) = load({"cameras": {"eye": eye}}).resolve().cameras
    return spec


FLOOR = box("floor", (3.0, 3.0, 0.05), (0.0, 0.0, -0.05), rgba=(0.3, 0.3, 0.3, 1.0))
BRICK = box("brick", (0.05, 0.05, 0.05), (0.0, 0.0, 0.05), rgba=(1.0, 1.0, 1.0, 1.0))


@pytest.fixture
def scene() -> DrawnWorld:
    return drawn(FLOOR, BRICK)


@pytest.fixture
def moving() -> Iterator[SimulatedWorld[Any]]:
    with stepped(FLOOR, BRICK) as world:
        yield world


def middle_of(bright: np.ndarray) -> tuple[float, float]:
    """Column and row of the middle of a bright thing, pixels."""
    rows, columns = np.nonzero(bright)
    return float(columns.min() + columns.max()) / 2, float(rows.min() + rows.max()) / 2


def face(spec: CameraSpec, K: Any, x: float) -> tuple[float, float]:
    """Where the middle of the brick's upper face, 0.9 m away, is seen from ``x`` m right of the colour sensor."""
    u, v, w = np.array(K) @ (-x, 0.0, 0.9)
    return u / w, v / w


@pytest.mark.parametrize("draws", ["tiny", "gl"])
@pytest.mark.parametrize("model", ["realsense_d435", "realsense_d455", "realsense_d405"])
@pytest.mark.parametrize("align", ["color", "depth"])
def test_each_picture_is_taken_from_where_its_sensor_is(scene, draws, model, align):
    spec = camera(model, align=align)
    drawing = renderer(draws, scene)
    frame = Exposure(spec).capture(scene, drawing, 1.0, 2.0, 3)
    places = {name: sensor.position[0] for name, sensor in spec.sensors.items()}
    assert frame.segmentation is not None
    K_infrared = spec.K_infrared or spec.K
    top = np.abs(frame.depth - 0.9) < 0.01
    assert middle_of(top) == pytest.approx(face(spec, spec.K, places[align]), abs=1.0)
    for name in ("infrared", "infrared_right"):
        image = getattr(frame, name)
        # The upper face is the brightest thing: the light comes from above.
        assert middle_of(image > image.max() * 0.97) == pytest.approx(face(spec, K_infrared, places[name]), abs=1.5)
    here = EYE @ Pose((places[align], 0.0, 0.0))
    assert frame.T_world_camera.distance(here)[0] < 1e-9
    assert (frame.t, frame.t_device, frame.seq, frame.skew) == (1.0, 2.0, 3, 0.0)
    # A point of the picture is where the world has it, by the frame's own matrix and pose.
    v, u = np.argwhere(top)[0]
    ray = np.linalg.inv(np.array(spec.K)) @ (u, v, 1.0)
    point = frame.T_world_camera.transform(ray * frame.depth[v, u])
    assert point[2] == pytest.approx(0.1, abs=0.002)
    assert np.abs(point[:2]).max() < 0.055
    drawing.close()


class Counting(Renderer):
    """Notes what it was asked to draw."""

    description = "counts"

    def __init__(self) -> None:
        self.asked: list[tuple[str, ...]] = []

    def render(self, camera: CameraSpec, T_world_camera: Pose) -> RenderedImages:
        self.asked.append(camera.streams)
        flat = (camera.height, camera.width)
        return RenderedImages(
            np.zeros((*flat, 3), np.uint8) if "color" in camera.streams else None,
            np.ones(flat, np.float32) if "depth" in camera.streams else None,
            np.zeros(flat, np.uint8) if "infrared" in camera.streams else None,
            np.zeros(flat, np.int32) if "segmentation" in camera.streams else None,
        )


@pytest.mark.parametrize(
    ("model", "keys", "asked"),
    [
        ("realsense_d435", {"streams": ["color", "depth"]}, [("color", "depth")]),
        ("realsense_d435", {"streams": ["color", "infrared"]}, [("color",), ("infrared",)]),
        ("realsense_d435", {"streams": ["infrared_right"]}, [("infrared",)]),
        (
            "realsense_d435",
            {"streams": ["color", "depth", "infrared"], "align": "depth"},
            [("color", "depth", "infrared")],
        ),
        ("pinhole", {"streams": ["color", "infrared"]}, [("color", "infrared")]),
    ],
)
def test_only_the_streams_of_the_spec_are_drawn(scene, model, keys, asked):
    drawing, spec = Counting(), camera(model, **keys)
    frame = Exposure(spec).capture(scene, drawing, 0.0, 0.0, 1)
    assert drawing.asked == asked
    for stream in EVERYTHING:
        assert (getattr(frame, stream) is not None) == (stream in spec.streams)
    assert (frame.skew is None) == (not {"color", "depth"} <= set(spec.streams))


def test_without_noise_depth_is_as_it_is_drawn(scene: DrawnWorld) -> None:
    drawing = renderer("tiny", scene)
    spec = camera(streams=["color", "depth"])
    plain = drawing.render(spec, EYE).depth
    frame = Exposure(spec).capture(scene, drawing, 0.0, 0.0, 1)
    assert np.array_equal(frame.depth, plain)
    assert frame.T_world_camera == Pose(spec.view.position, spec.view.orientation)
    noisy = camera(streams=["color", "depth"], simulated={"depth_noise": {"subpixel": 0.08}})
    captured = [Exposure(noisy).capture(scene, drawing, 0.0, 0.0, number).depth for number in (1, 1, 2)]
    assert np.array_equal(captured[0], captured[1])
    assert not np.array_equal(captured[0], captured[2])
    both = (plain > 0) & (captured[0] > 0)
    assert both.mean() > 0.8
    assert 0.0005 < np.abs(captured[0] - plain)[both].mean() < 0.01
    assert np.array_equal(drawing.render(spec, EYE).depth, plain), "the picture that was drawn is not written to"


def test_in_lock_step_a_picture_of_one_state_of_the_world_is_drawn_once(moving: SimulatedWorld[Any]) -> None:
    drawing, spec = Counting(), camera(streams=["color", "depth"])
    clock = LockStepClock(lambda: moving.t, lambda t: None)
    source = DirectSource(LocalMirror(moving), drawing, spec, clock.now)
    public = Camera(SimulatedCamera(spec, source), clock, threaded=False)
    public.open()
    heard: list[Frame] = []
    public.on_frame(heard.append)
    elsewhere = {"position": (1.0, 0.0, 0.5), "orientation": (0.0, 0.0, 0.0, 1.0)}
    changes: list[Callable[[], object]] = [
        lambda: None,
        moving.step,
        lambda: moving.set_pose("brick", elsewhere),
        lambda: moving.set_color("brick", (1.0, 0.0, 0.0, 1.0)),
        lambda: moving.reset("brick"),
        moving.reset,
        lambda: moving.remove("brick"),
    ]
    for number, change in enumerate(changes, start=1):
        change()
        frame = public.read()
        assert public.read() is frame
        assert public.read_latest() is frame
        assert len(drawing.asked) == len(heard) == public.counts().frames == number


class FakeTime:
    """The worker's clock, which the test moves."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.mark.parametrize("rate", [6.0, 15.0, 60.0, 90.0])
def test_frames_come_at_the_configured_rate(moving, rate, monkeypatch):
    clock = FakeTime()
    monkeypatch.setattr("hal.drivers.scene.camera.time", clock)
    streams = ["color", "depth", "infrared_right"] if rate <= 60 else ["depth", "infrared_right"]
    spec = replace(
        camera(
            capture={"width": 640, "height": 480, "rate_hz": rate}, streams=streams, simulated={"depth_noise": True}
        ),
        width=32,
        height=24,
    )
    assert spec.rate_hz == rate
    snapshots = SeriesBox(memoryview(bytearray(SeriesBox.size(256))), 256)
    buffer = memoryview(bytearray(FrameRing.size(spec)))
    shown = DrawnWorld(moving.spec)
    worker = RenderWorker(shown, WorldMirror(shown, snapshots), Counting(), [spec], frame_rings(buffer, [spec]))
    driver = SimulatedCamera(spec, SharedSource(FrameRing(buffer, spec), lambda: None))
    driver.open()
    frames = []
    for k in range(960):  # 4 s of a world at 240 Hz
        clock.now = 1000.0 + k / 240
        snapshots.write(k / 240 + 0.001, moving.revision, moving.snapshot())
        worker.run_once()
        frame = driver.grab(0.0)
        if frame is not None:
            frames.append(frame)
    stamps = np.array([frame.t for frame in frames])
    assert len(frames) == pytest.approx(4 * rate, abs=1.5)
    assert np.abs(np.diff(stamps) - 1 / rate).max() <= 1 / 240 + 1e-9, "no earlier and no later than the world's steps"
    assert [frame.seq for frame in frames] == list(range(1, len(frames) + 1))
    assert frames[0].infrared_right is not None
    assert frames[0].skew == (0.0 if "color" in streams else None)
    assert not np.array_equal(frames[0].depth, frames[1].depth), "each frame has noise of its own"
