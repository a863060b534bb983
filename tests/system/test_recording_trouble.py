"""What can go wrong while recording: it is said, the episode is usable up to that moment, and the arm goes on."""

from __future__ import annotations

import gc
import os
import resource
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from recording_kit import check_layout, mock_rig
from waiting import wait_until

import hal
from hal.errors import CommandError, ConnectionLost, StaleStateError
from hal.recording import Dataset, Recorder, recover
from hal.rig import Rig
from hal.types import Frame, RobotStatus, Trip

pytestmark = [pytest.mark.slow, pytest.mark.pair]


class Driver:
    """Somebody who drives all the time, and would notice."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.error: Exception | None = None
        self._end = threading.Event()
        gc.collect()
        gc.freeze()  # looking through what thousands of tests left takes longer than a command may be late
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        arm = self.rig.robots["panda"]
        try:
            with arm.control(rate_hz=50, unattended=True) as control:
                for tick in self.rig.clock.rate(50):
                    if self._end.is_set():
                        return
                    control.send(hal.Twist([0.0, 0.0, 0.02 if tick.elapsed % 2 < 1 else -0.02]))
        except Exception as error:
            self.error = error

    def close(self) -> None:
        state = self.rig.robots["panda"].state()
        self._end.set()
        self._thread.join()
        gc.unfreeze()
        assert self.error is None
        assert (state.status, state.trip) == (RobotStatus.FOLLOWING, Trip.NONE)


@pytest.fixture
def rig() -> Iterator[Rig]:
    with mock_rig("real_time") as opened:
        driver = Driver(opened)
        yield opened
        driver.close()


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def begin(recorder: Recorder, rows: int = 15) -> None:
    recorder.start()
    wait_until(lambda: recorder.status().frames >= rows)
    assert recorder.status().trouble == ""


def usable(out: Path, rows: int) -> None:
    check_layout(out)
    episode = Dataset(out).episodes[-1]
    assert rows <= episode.length
    assert sum(1 for _ in episode.frames("wrist")) == episode.length
    assert (episode.stamps["grid"][1:] > episode.stamps["grid"][:-1]).all()


def limit(recorder: Recorder, size: int) -> None:
    """The writer's files may not become larger: what a full disk is like, for one process."""
    pid = recorder._child.process.pid
    hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, hard))


def test_a_disk_that_is_full(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        begin(recorder)
        largest = max(path.stat().st_size for path in out.glob("episodes/*.partial/*"))
        limit(recorder, largest + 2000)
        wait_until(lambda: "cannot be written" in recorder.status().trouble)
        rows = recorder.status().frames
        time.sleep(0.3)
        assert recorder.status().frames - rows <= 1, "no further rows"
        with pytest.raises(hal.HalError):  # there is no room to finish it either
            limit(recorder, 100)
            recorder.save(True, wait=True)
        assert "File too large" in recorder.status().trouble
        limit(recorder, resource.RLIM_INFINITY)
        begin(recorder, 5)  # recovers what is there
        recorder.save(wait=True)
        assert "recovered as episode 0" in recorder.notes[-1]
        limit(recorder, 100)
        with pytest.raises(CommandError, match="cannot record into .*File too large"):
            recorder.start()
        limit(recorder, resource.RLIM_INFINITY)
        begin(recorder, 5)
        recorder.discard()
    usable(out, 5)
    first = Dataset(out).episodes[0]
    assert first.length >= 13
    assert first.success is None, "it ended before it was saved"


def test_a_disk_that_gets_full_is_noticed_before(rig: Rig, out: Path, tmp_path: Path) -> None:
    found = os.statvfs(tmp_path)
    free = found.f_bavail * found.f_frsize
    with Recorder(rig, out, stop_free=free - 500_000_000, warn_free=1) as recorder:
        begin(recorder)
        with (tmp_path / "large").open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, 1_000_000_000)
        wait_until(lambda: "GB are free on the disk" in recorder.status().trouble)
        recorder.save(True, wait=True)
        with pytest.raises(CommandError, match="GB are free"):
            recorder.start()
    usable(out, 15)
    with Recorder(rig, out, warn_free=1 << 60) as recorder:
        assert "GB are free" in recorder.status().trouble, "a warning, and nothing more"
        recorder.start()
        wait_until(lambda: recorder.status().frames > 5)
        recorder.save(wait=True)


def test_a_folder_that_is_moved_can_be_recovered_where_it_is(rig: Rig, out: Path, tmp_path: Path) -> None:
    with Recorder(rig, out) as recorder:
        begin(recorder)
        out.rename(tmp_path / "elsewhere")
        wait_until(lambda: "is gone" in recorder.status().trouble)
        with pytest.raises(hal.HalError):
            recorder.save(True, wait=True)
    assert len(recover(tmp_path / "elsewhere")) == 1
    usable(tmp_path / "elsewhere", 13)


def test_a_camera_that_is_lost(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        begin(recorder)
        rig.cameras["wrist"].inject(disconnect=True)
        wait_until(lambda: "camera wrist is lost" in recorder.status().trouble)
        with pytest.raises(CommandError, match="save or discard"):
            recorder.start()
        recorder.save(True, wait=True)
        with pytest.raises(ConnectionLost, match="camera wrist is lost"):
            recorder.start()
        rig.cameras["wrist"].inject(disconnect=False)
        wait_until(lambda: rig.cameras["wrist"].connected)
        begin(recorder)
        recorder.save(wait=True)
    usable(out, 15)
    first = Dataset(out).episodes[0]
    assert first.length >= 15
    assert first.success is None, "not every picture of the task is there"
    assert "camera wrist is lost" in first.info["trouble"]
    assert first.info["gaps"][-1]["why"] == first.info["trouble"]


def test_a_camera_that_is_lost_while_an_episode_begins(rig: Rig, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = rig.cameras["wrist"]
    latest = camera.read_latest

    def last(**more: float) -> Frame:
        frame = latest(**more)
        camera.inject(disconnect=True)
        wait_until(lambda: not camera.connected)
        return frame

    with Recorder(rig, out) as recorder:
        with monkeypatch.context() as patched:
            patched.setattr(camera, "read_latest", last)
            recorder.start()
        wait_until(lambda: recorder.status().trouble)
        assert "camera wrist is lost" in recorder.status().trouble, "and not only silent, a second later"
        recorder.discard()
        camera.inject(disconnect=False)
        wait_until(lambda: camera.connected)
        begin(recorder)
        recorder.save(wait=True)
    usable(out, 15)


def test_a_camera_that_falls_silent(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        begin(recorder)
        rig.cameras["scene"].inject(freeze=True)
        wait_until(lambda: "camera scene has sent no picture" in recorder.status().trouble)
        recorder.save(wait=True)
    usable(out, 15)
    assert Dataset(out).episodes[0].info["repeated"]["scene"] > 10, "rows that show an old picture are counted"


def test_a_late_camera_is_waited_for(rig: Rig, out: Path) -> None:
    camera = rig.cameras["scene"]

    def silent() -> bool:
        try:
            camera.read_latest(max_age=1.0)
        except StaleStateError:
            return True
        return False

    with Recorder(rig, out) as recorder:
        camera.inject(freeze=True)
        wait_until(silent)
        threading.Timer(0.3, lambda: camera.inject(freeze=False)).start()
        begin(recorder)
        recorder.save(wait=True)
        camera.inject(freeze=True)
        wait_until(silent)
        with pytest.raises(StaleStateError):
            recorder.start()
    usable(out, 15)


def test_a_writer_that_is_killed(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        begin(recorder)
        os.kill(recorder._child.process.pid, signal.SIGKILL)
        wait_until(lambda: "the recorder process ended" in recorder.status().trouble)
        with pytest.raises(ConnectionLost):
            recorder.save(True, wait=True)
        begin(recorder)
        assert "recovered as episode 0" in recorder.notes[-1]
        recorder.save(True, wait=True)
    usable(out, 15)
    assert [episode.success for episode in Dataset(out).episodes] == [None, True], "the first ended by itself"


def test_a_writer_that_cannot_keep_up_is_said(rig: Rig, out: Path) -> None:
    with Recorder(rig, out) as recorder:
        begin(recorder)
        pid = recorder._child.process.pid
        os.kill(pid, signal.SIGSTOP)
        try:
            wait_until(lambda: recorder.status().dropped >= 3)
        finally:
            os.kill(pid, signal.SIGCONT)
        rows = recorder.status().frames
        wait_until(lambda: recorder.status().frames >= rows + 10)
        dropped = recorder.status().dropped
        recorder.save(wait=True)
    usable(out, 30)
    (gap,) = Dataset(out).episodes[0].info["gaps"]
    assert gap["rows"] == dropped
    assert "cannot keep up" in gap["why"]


def test_a_rig_that_is_closed_first(out: Path) -> None:
    with mock_rig("real_time") as rig:
        recorder = Recorder(rig, out)
        begin(recorder)
    wait_until(lambda: recorder.status().trouble)
    assert any(word in recorder.status().trouble for word in ("closed", "ended")), recorder.status().trouble
    recorder.close()
    usable(out, 15)
