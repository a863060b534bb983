"""A camera that is lost and comes back, as the program sees it."""

from __future__ import annotations

import itertools
import logging
import queue
import time

import pytest

import hal
from hal.camera import Camera
from hal.clock import RealClock
from hal.driver import CameraDriver, RawFrame
from hal.errors import ConnectionLost, DeviceNotFound, StaleStateError
from hal.specs import CameraSpec


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
            for use in (camera.read, camera.latest):
                with pytest.raises(ConnectionLost, match=r"scene is lost \(its last frame is of \d+\.\d+ s"):
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
    told: queue.Queue[object] = queue.Queue()

    def fail(news: object) -> None:
        told.put(news)
        raise RuntimeError("no more paper")

    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        camera = rig.cameras["scene"]
        camera.on_connection(fail)
        camera.inject(disconnect=True)
        assert isinstance(told.get(timeout=20.0), ConnectionLost)
        camera.inject(disconnect=False)
        wait_until_back(camera)
        assert told.empty()
    assert "no more paper" in caplog.text


def test_in_lock_step_every_use_looks_for_it() -> None:
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
    """Does what its script says, one word per grab or open; numbers start anew with each opening."""

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
        return RawFrame(now, now, self.seq, None, None, None, None, None)

    def close(self) -> None: ...


def opened(spec: CameraSpec, *script: str) -> tuple[Camera, list[hal.Frame], queue.Queue[ConnectionLost | None]]:
    frames: list[hal.Frame] = []
    news: queue.Queue[ConnectionLost | None] = queue.Queue()
    camera = Camera(Scripted(spec, list(script)), RealClock(), threaded=True)
    camera.on_frame(frames.append)
    camera.on_connection(news.put)
    camera.open()
    return camera, frames, news


def test_it_is_back_only_with_a_frame_and_numbers_go_on(camera_spec: CameraSpec) -> None:
    # Lost, away at the first attempt, there at the second but lost before a frame, back at the third.
    words = ["frame", "frame", "lost", "away", "here", "lost", "here", "frame", "frame"]
    camera, frames, news = opened(camera_spec, *words)
    try:
        assert isinstance(news.get(timeout=20.0), ConnectionLost)
        assert news.get(timeout=20.0) is None, "told once that it is gone, once that it is back"
        deadline = time.monotonic() + 20.0
        while len(frames) < 4 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert [frame.stamp.seq for frame in frames] == [1, 2, 3, 4]
        assert camera.counts().dropped == 0
        assert camera.counts().reconnects == 1
    finally:
        camera.close()


def test_a_drivers_own_mistake_is_a_loss_that_names_it(camera_spec: CameraSpec) -> None:
    camera, _, news = opened(camera_spec, "frame", "bug")
    try:
        lost = news.get(timeout=20.0)
        assert lost is not None
        assert "a driver's mistake" in str(lost)
        assert isinstance(lost.__cause__, ZeroDivisionError)
    finally:
        camera.close()


@pytest.mark.parametrize("words", [["frame", "over"], ["frame", "lost", "here", "over"]])
def test_what_nothing_brings_back_is_not_looked_for(camera_spec: CameraSpec, words: list[str]) -> None:
    camera, _, news = opened(camera_spec, *words)
    try:
        assert isinstance(news.get(timeout=20.0), ConnectionLost)
        assert camera._thread is not None
        camera._thread.join(20.0)
        assert not camera._thread.is_alive(), "nobody looks for it any more"
        with pytest.raises(ConnectionLost, match="has ended"):
            camera.read()
    finally:
        camera.close()


def test_silence_is_no_loss(camera_spec: CameraSpec) -> None:
    camera, _, news = opened(camera_spec, "frame")
    try:
        camera.read(timeout=20.0)
        with pytest.raises(StaleStateError):
            camera.read(timeout=0.3)
        assert news.empty()
    finally:
        camera.close()
