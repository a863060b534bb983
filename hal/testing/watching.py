"""A camera's driver as a program sees it, behind the public Camera: part of :class:`~hal.testing.CameraContract`."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from ..camera import Camera
from ..errors import ConnectionLost, HalError, StaleStateError
from ..types import Frame
from .benches import CameraBench
from .contract import needs

__all__ = ["WatchChecks"]

_LIMIT = 15.0
"""s within which a frame must come, on a busy machine."""
_WAIT = 0.3
"""s; a time-out that is tried."""
_SLACK = 2.0
"""s that a call may take longer than it was told to."""


class Watched:
    """The public camera in front of a bench's driver, and what it tells of its connection."""

    def __init__(self, bench: CameraBench) -> None:
        self.bench = bench
        self.camera = Camera(bench.driver, bench.clock, threaded=bench.real_time)
        self.told: list[ConnectionLost | None] = []
        self.camera.on_connection(self.told.append)

    def read(self, limit: float = _LIMIT) -> Frame:
        """The next frame, however long it takes."""
        if not self.bench.real_time:
            self.bench.pass_time()
        return self.camera.read(limit)

    def wait_lost(self) -> ConnectionLost:
        """Read until the camera is lost."""
        deadline = time.monotonic() + self.bench.patience + _SLACK
        while time.monotonic() < deadline:
            try:
                self.read(_WAIT)
            except ConnectionLost as error:
                return error
            except StaleStateError:
                continue
        raise AssertionError("the link is lost, and read() does not raise ConnectionLost")

    def wait_back(self) -> Frame:
        """Read until the camera works again."""
        deadline = time.monotonic() + self.bench.patience + _LIMIT
        while True:
            try:
                return self.read(_WAIT)
            except HalError as error:
                if time.monotonic() > deadline:
                    raise AssertionError(f"the link is mended, and read() still says: {error}") from error
                time.sleep(0.02)

    def wait_told(self, times: int) -> ConnectionLost | None:
        """What a callback was told, which may be a moment after ``read`` knew it."""
        deadline = time.monotonic() + _SLACK
        while len(self.told) < times:
            assert time.monotonic() < deadline, f"on_connection was called {len(self.told)} times, not {times}"
            time.sleep(0.005)
        return self.told[times - 1]


class WatchChecks:
    """What a program gets, and what it is told when frames stop coming."""

    @pytest.fixture
    def watched(self, bench: CameraBench) -> Iterator[Watched]:
        """Open."""
        watched = Watched(bench)
        watched.camera.open()
        yield watched
        watched.camera.close()

    def test_a_program_reads_frames(self, bench: CameraBench, watched: Watched) -> None:
        first, second = watched.read(), watched.read()
        assert second.stamp.seq > first.stamp.seq
        for name in bench.driver.spec.streams:
            assert not getattr(second, name).flags.writeable
        assert watched.camera.connected
        assert watched.camera.latest(_LIMIT).stamp.seq >= second.stamp.seq
        began = time.monotonic()
        watched.camera.close()
        watched.camera.close()
        assert time.monotonic() - began < 10.0, "close is bounded in time"

    @needs("freeze")
    def test_a_program_is_told_that_frames_are_old(self, bench: CameraBench, watched: Watched) -> None:
        watched.read()
        bench.freeze()
        began = time.monotonic()
        with pytest.raises((StaleStateError, ConnectionLost)):
            for _ in range(20):  # what was on its way
                watched.read(_WAIT)
        assert time.monotonic() - began < 20 * _WAIT + _SLACK
        with pytest.raises((StaleStateError, ConnectionLost)):
            watched.camera.latest(_WAIT / 2)

    @needs("lose")
    def test_a_program_is_told_that_the_camera_is_lost(self, bench: CameraBench, watched: Watched) -> None:
        watched.read()
        bench.lose()
        error = watched.wait_lost()
        assert str(error)
        assert not watched.camera.connected
        with pytest.raises(ConnectionLost):
            watched.camera.latest(_LIMIT)
        assert isinstance(watched.wait_told(1), ConnectionLost), "who asked is told that it is gone"

    @needs("lose", "restore")
    def test_the_same_camera_works_again_when_it_is_back(self, bench: CameraBench, watched: Watched) -> None:
        before = watched.read()
        bench.lose()
        watched.wait_lost()
        bench.restore()
        after = watched.wait_back()
        assert after.stamp.seq > before.stamp.seq, "numbers go on where they were"
        assert after.stamp.t > before.stamp.t
        assert watched.camera.connected
        assert watched.camera.counts().reconnects == 1
        assert watched.wait_told(2) is None, "who asked is told that it is back"
        assert watched.read().stamp.seq > after.stamp.seq
