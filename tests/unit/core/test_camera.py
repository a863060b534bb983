"""A camera of a rig: listeners, loss and reconnection, and the pose of a camera whose driver does not report it."""

from __future__ import annotations

import itertools
import logging
import queue
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

import hal
from hal.camera import Camera, find_place
from hal.clock import RealClock
from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConnectionLost, DeviceNotFound, StaleStateError
from hal.specs import CameraSpec
from hal.types import STREAMS


def test_every_stream_is_a_field_of_both_records_of_a_frame() -> None:
    for name, kind in STREAMS.items():
        assert (name in RawFrame._fields, name in hal.Frame.__dataclass_fields__) == (True, True)
        assert kind.like is None or kind.like in STREAMS
        assert kind.highest is None or np.array([kind.lowest, kind.highest], kind.dtype)[1] == kind.highest


def test_a_listener_gets_every_frame_and_one_that_fails_is_logged_and_dropped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    seen: list[int] = []
    failures = []
    enough = threading.Event()

    def note(frame: hal.Frame) -> None:
        seen.append(frame.stamp.seq)
        if len(seen) >= 5:
            enough.set()

    def fail(frame: hal.Frame) -> None:
        failures.append(frame.stamp.seq)
        raise RuntimeError("the disk is full")

    with (
        caplog.at_level(logging.ERROR, "hal.camera"),
        hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig,
    ):
        camera = rig.cameras["scene"]
        detach = camera.on_frame(note)
        camera.on_frame(fail)
        assert enough.wait(20.0)
        detach()
        count = len(seen)
        camera.read(timeout=20.0)
        camera.read(timeout=20.0)
    assert len(failures) == 1
    assert "the disk is full" in caplog.text
    assert len(seen) <= count + 1


# Loss and reconnection


def wait_until_back(camera: Camera) -> hal.Frame:
    for _ in range(200):
        try:
            return camera.read(timeout=1.0)
        except ConnectionLost:
            time.sleep(0.02)
    raise AssertionError("the camera never came back")


def test_the_same_camera_works_again(caplog: pytest.LogCaptureFixture) -> None:
    news: queue.Queue[ConnectionLost | None] = queue.Queue()
    with (
        caplog.at_level(logging.WARNING, "hal.camera"),
        hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig,
    ):
        camera, other = rig.cameras["scene"], rig.cameras["wrist"]
        camera.on_connection(news.put)
        seen = [camera.read(timeout=20.0).stamp.seq for _ in range(3)]
        assert camera.connected
        for _ in range(2):
            camera.inject(disconnect=True)
            lost = news.get(timeout=20.0)
            assert isinstance(lost, ConnectionLost)
            assert not camera.connected
            for use in (camera.read, camera.read_latest):
                with pytest.raises(ConnectionLost, match="scene"):
                    use()
            other.read(timeout=20.0)
            assert other.connected
            camera.inject(disconnect=False)
            assert news.get(timeout=20.0) is None
            seen += [wait_until_back(camera).stamp.seq, camera.read(timeout=20.0).stamp.seq]
            assert camera.connected
        assert all(after > before for before, after in itertools.pairwise(seen)), seen
        assert camera.counts().reconnects == 2
        assert news.empty()
    assert caplog.text.count("scene is back") == 2


def test_a_watcher_that_fails_is_logged_and_dropped(caplog: pytest.LogCaptureFixture) -> None:
    calls: queue.Queue[object] = queue.Queue()

    def fail(news: object) -> None:
        calls.put(news)
        raise RuntimeError("a broken callback")

    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        camera = rig.cameras["scene"]
        camera.on_connection(fail)
        camera.inject(disconnect=True)
        assert isinstance(calls.get(timeout=20.0), ConnectionLost)
        camera.inject(disconnect=False)
        wait_until_back(camera)
        assert calls.empty()
    assert "a broken callback" in caplog.text


def test_in_lock_step_every_read_tries_to_reopen_it() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        camera = rig.cameras["scene"]
        before = camera.read()
        camera.inject(disconnect=True)
        for _ in range(2):
            with pytest.raises(ConnectionLost):
                camera.read()
        assert not camera.connected
        camera.inject(disconnect=False)
        rig.clock.sleep(0.1)
        after = camera.read()
        assert after.stamp.seq > before.stamp.seq
        assert camera.connected


class Scripted(CameraDriver):
    """Follows its script, one word per grab or open; frame numbers start again with each opening."""

    def __init__(self, spec: CameraSpec, script: list[str]) -> None:
        super().__init__(spec, RealClock())
        self.script = iter(script)
        self.opened = 0
        self.seq = 0

    def open(self) -> None:
        if self.opened and next(self.script) == "away":
            raise DeviceNotFound("nothing is plugged in")
        self.opened += 1
        self.seq = 0

    def grab(self, timeout: float) -> RawFrame | None:
        word = next(self.script, "end")
        if word == "end":
            time.sleep(min(timeout, 0.02))
            return None
        if word == "lost":
            raise ConnectionLost("unplugged")
        if word == "bug":
            raise ZeroDivisionError("a driver's mistake")
        if word == "over":
            error = ConnectionLost("the recording has ended")
            error.final = True
            raise error
        self.seq += 1
        now = time.monotonic()
        return RawFrame(now, now, self.seq)

    def close(self) -> None: ...


def opened(spec: CameraSpec, *script: str) -> tuple[Camera, list[hal.Frame], queue.Queue[ConnectionLost | None]]:
    frames: list[hal.Frame] = []
    news: queue.Queue[ConnectionLost | None] = queue.Queue()
    camera = Camera(Scripted(spec, list(script)), RealClock(), threaded=True)
    camera.on_frame(frames.append)
    camera.on_connection(news.put)
    camera.open()
    return camera, frames, news


def test_it_is_back_only_with_a_frame_and_numbers_continue(camera_spec: CameraSpec) -> None:
    # Lost, away at the first attempt, there at the second but lost before a frame, back at the third.
    words = ["frame", "frame", "lost", "away", "here", "lost", "here", "frame", "frame"]
    camera, frames, news = opened(camera_spec, *words)
    try:
        assert isinstance(news.get(timeout=20.0), ConnectionLost)
        assert news.get(timeout=20.0) is None, "one call for the loss, one for the return"
        deadline = time.monotonic() + 20.0
        while len(frames) < 4 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert [frame.stamp.seq for frame in frames] == [1, 2, 3, 4]
        assert camera.counts().dropped == 0
        assert camera.counts().reconnects == 1
    finally:
        camera.close()


def test_a_mistake_of_the_driver_is_a_loss_with_its_cause(camera_spec: CameraSpec) -> None:
    camera, _, news = opened(camera_spec, "frame", "bug")
    try:
        lost = news.get(timeout=20.0)
        assert lost is not None
        assert isinstance(lost.__cause__, ZeroDivisionError)
    finally:
        camera.close()


@pytest.mark.parametrize("words", [["frame", "over"], ["frame", "lost", "here", "over"]])
def test_a_final_loss_ends_the_attempts_to_reopen(camera_spec: CameraSpec, words: list[str]) -> None:
    camera, _, news = opened(camera_spec, *words)
    try:
        assert isinstance(news.get(timeout=20.0), ConnectionLost)
        assert camera._thread is not None
        camera._thread.join(20.0)
        assert not camera._thread.is_alive(), "the thread has ended"
        with pytest.raises(ConnectionLost):
            camera.read()
    finally:
        camera.close()


def test_silence_is_not_a_loss(camera_spec: CameraSpec) -> None:
    camera, _, news = opened(camera_spec, "frame")
    try:
        camera.read(timeout=20.0)
        with pytest.raises(StaleStateError):
            camera.read(timeout=0.3)
        assert news.empty()
    finally:
        camera.close()


# Pose


def difference(a: hal.Pose, b: hal.Pose) -> tuple[float, float]:
    apart = a.inverse() @ b
    return float(np.linalg.norm(apart.position)), 2.0 * float(np.linalg.norm(apart.orientation[:3]))


@pytest.mark.parametrize("name", ["scene", "wrist"])
def test_the_pose_of_a_camera_agrees_with_the_simulation(name: str) -> None:
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        arm, camera = rig.robots["panda"], rig.cameras[name]
        place = find_place(camera.spec, rig.robots)
        assert place is not None
        poses = []
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist(linear=[0.1, 0.05, 0.05], angular=[0.0, 0.3, 0.4]))
                if tick.elapsed >= 0.2 * (len(poses) + 1):
                    frame = camera.read()
                    found = place(frame.stamp.t)
                    assert found is not None
                    assert frame.T_world_camera is not None
                    assert difference(found, frame.T_world_camera) == pytest.approx((0.0, 0.0), abs=1e-5)
                    poses.append(found)
                if tick.elapsed > 1.0:
                    break
        moved, turned = difference(poses[0], poses[-1])
        assert (moved > 0.03 and turned > 0.1) == (name == "wrist"), "only a camera on the arm moves"


def test_the_pose_is_that_of_the_time_of_the_frame() -> None:
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        arm, camera = rig.robots["panda"], rig.cameras["wrist"]
        place = find_place(camera.spec, rig.robots)
        assert place is not None
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist(linear=[0.0, 0.1, 0.0]))
                if tick.elapsed > 0.6:
                    break
            frame = camera.read()
            rig.clock.sleep(0.03)
            control.send(hal.Twist(linear=[0.0, 0.1, 0.0]))
            then, now = place(frame.stamp.t), place(rig.clock.now())
            assert then is not None
            assert now is not None
            assert frame.T_world_camera is not None
            assert difference(now, frame.T_world_camera)[0] > 2e-3, "the arm has moved since"
            assert difference(then, frame.T_world_camera)[0] < 1e-5
            assert place(rig.clock.now() - 60.0) is None, "older than the history"
            assert place(rig.clock.now() + 1.0) is None


def test_a_camera_without_a_view_has_no_place() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        spec = replace(rig.cameras["scene"].spec, view=None)
        assert find_place(spec, rig.robots) is None


class Still(CameraDriver):
    """A camera that does not know where it is, and whose depth sensor is not where its model says."""

    @property
    def info(self) -> CameraInfo:
        info = self.nominal_info()
        depth = replace(info.streams["depth"], T_color_stream=hal.Pose([0.016, 0.0, 0.0]))
        return replace(info, streams={**info.streams, "depth": depth})

    def open(self) -> None: ...

    def grab(self, timeout: float) -> RawFrame:
        return RawFrame(0.0, 0.0, 1)

    def close(self) -> None: ...


@pytest.mark.parametrize("align", ["color", "depth"])
def test_the_pose_of_a_frame_is_that_of_the_sensor_to_which_it_is_aligned(align: str) -> None:
    with hal.open("panda_table", driver="mock", overrides=[f"cameras.scene.align={align}"]) as rig:
        spec = rig.cameras["scene"].spec
        camera = Camera(Still(spec), rig.clock, threaded=False, place=find_place(spec, rig.robots))
        camera.open()
        pose = camera.read().T_world_camera
        assert pose is not None
        assert spec.view is not None
        apart = hal.Pose(spec.view.position, spec.view.orientation).inverse() @ pose
        assert apart.position == pytest.approx([0.016 if align == "depth" else 0.0, 0.0, 0.0], abs=1e-9)
