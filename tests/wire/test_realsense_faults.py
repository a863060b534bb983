"""What goes wrong with a RealSense: unplugged, silent, hung, misspelt, taken; and how it comes back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from typing import Any

import pytest

from hal.errors import CommandError, ConnectionLost, ControlTaken, DeviceNotFound, NotSupported, StaleStateError

from .realsense_bench import RealSenseCamera, opened, read_again, read_until_lost, software, spec, wait_until

from hal.drivers.realsense.devices import claim_camera, find  # isort: skip  # needs the library
from hal.drivers.realsense.emulator import SoftwareCamera, emulated_context  # isort: skip
from hal.drivers.realsense.options import apply, sensors_of  # isort: skip
from hal.drivers.realsense.ring import PictureRing  # isort: skip
from hal.drivers.realsense.station import Station  # isort: skip


def test_unplugged_and_plugged_in_again_the_same_camera_works() -> None:
    with opened(software()) as cam:
        news: list[ConnectionLost | None] = []
        cam.on_connection(news.append)
        before = cam.read(timeout=5.0)
        cam.inject(disconnect=True)
        error = read_until_lost(cam, 2.0)
        assert "unplugged" in str(error)
        told = float(str(error).split("last frame is of ")[1].split(" s,")[0])
        assert before.stamp.t - 1e-3 <= told <= before.stamp.t + 1.0
        with pytest.raises(ConnectionLost):
            cam.latest()
        time.sleep(0.5)
        assert not cam.connected
        with pytest.raises(ConnectionLost, match="no RealSense with serial"):
            cam.read()
        cam.inject(disconnect=False)
        again = read_again(cam, 5.0)
        assert again.stamp.seq > before.stamp.seq
        assert again.stamp.t > error_time(error)
        assert cam.counts().reconnects == 1
        assert [type(item) for item in news] == [ConnectionLost, type(None)]


def error_time(error: ConnectionLost) -> float:
    """When the camera was lost, by its words."""
    return float(str(error).split("now is ")[1].split(" s)")[0])


def test_a_silent_camera_is_lost_and_comes_back() -> None:
    with opened(software(stall_s=0.5)) as cam:
        cam.read(timeout=5.0)
        cam.inject(freeze=True)
        assert "stalled: nothing came" in str(read_until_lost(cam, 3.0))
        cam.inject(freeze=False)
        read_again(cam, 15.0)


def test_one_silent_stream_is_named() -> None:
    with opened(software(stall_s=0.5)) as cam:
        cam.read(timeout=5.0)
        cam.inject(drop=1, drop_stream="color")
        assert "color sent nothing" in str(read_until_lost(cam, 3.0))
        assert cam.counts().mismatched > 0


def process_of(cam: object) -> int:
    """Of the library."""
    return int(cam._driver._link._child.process.pid)  # type: ignore[attr-defined]


def test_a_process_that_hangs_is_ended_and_another_one_takes_over() -> None:
    with opened(software(stall_s=0.3)) as cam:
        cam.read(timeout=5.0)
        pid = process_of(cam)
        os.kill(pid, signal.SIGSTOP)
        assert "hangs" in str(read_until_lost(cam, 8.0))
        read_again(cam, 15.0)
        assert process_of(cam) != pid
        assert not os.path.exists(f"/proc/{pid}")


def test_a_process_that_dies_takes_nobody_with_it() -> None:
    with opened(software()) as cam:
        cam.read(timeout=5.0)
        os.kill(process_of(cam), signal.SIGKILL)
        assert "process ended" in str(read_until_lost(cam, 5.0))
        read_again(cam, 15.0)


def test_close_is_bounded_and_idempotent_even_if_the_library_hangs() -> None:
    driver = RealSenseCamera(software())
    driver.open()
    os.kill(driver._link._child.process.pid, signal.SIGSTOP)  # type: ignore[union-attr]
    began = time.monotonic()
    driver.close()
    driver.close()
    assert time.monotonic() - began < 6.0
    with pytest.raises(ConnectionLost):
        driver.grab(0.0)
    driver.open()
    assert wait_until(lambda: driver.grab(0.1) is not None, 5.0) < 5.0
    driver.close()


def test_a_closed_camera_leaves_no_process() -> None:
    driver = RealSenseCamera(software())
    driver.open()
    pid = driver._link._child.process.pid  # type: ignore[union-attr]
    driver.close()
    assert not os.path.exists(f"/proc/{pid}")


def test_a_lost_camera_that_is_closed_for_good_leaves_no_process() -> None:
    driver = RealSenseCamera(software())
    driver.open()
    pid = driver._link._child.process.pid  # type: ignore[union-attr]
    driver.inject(disconnect=True)
    with pytest.raises(ConnectionLost):
        while True:
            driver.grab(1.0)
    driver.close()
    assert os.path.exists(f"/proc/{pid}"), "the camera in software is in it, and may be plugged in again"
    with pytest.raises(DeviceNotFound):
        driver.open()
    driver.close()
    assert os.path.exists(f"/proc/{pid}")
    driver.close()
    assert not os.path.exists(f"/proc/{pid}")


def test_a_camera_that_is_closed_while_it_is_looked_for_leaves_no_process() -> None:
    with opened(software()) as cam:
        cam.read(timeout=5.0)
        pid = process_of(cam)
        cam.inject(disconnect=True)
        read_until_lost(cam, 3.0)
        time.sleep(0.5)  # meanwhile it is closed and opened in vain
    wait_until(lambda: not os.path.exists(f"/proc/{pid}"), 2.0)


def test_without_a_camera_the_error_comes_at_once() -> None:
    for options, words in (({}, "no RealSense is plugged in"), ({"serial": "0123"}, "no RealSense with serial 0123")):
        driver = RealSenseCamera(spec(**options))
        driver.open_began = time.monotonic()  # type: ignore[attr-defined]
        try:
            with pytest.raises(DeviceNotFound, match=words):
                driver.open()
            began = time.monotonic()
            with pytest.raises(DeviceNotFound, match=words):  # the process is there by now
                driver.open()
            assert time.monotonic() - began < 1.0, "the library would have waited for 15 s"
        finally:
            driver.close()


def test_the_error_lists_what_is_plugged_in() -> None:
    context = emulated_context()
    cameras = [SoftwareCamera(software(name=name)) for name in ("left", "right")]
    try:
        for camera in cameras:
            camera.attach(context)
        with pytest.raises(DeviceNotFound, match="serial 42; plugged in: .*D435.*USB 3.2.*D435") as caught:
            find(context, "42")
        assert all(camera.serial in str(caught.value) for camera in cameras)
        with pytest.raises(DeviceNotFound, match=r'several .* say which one: real: {serial: "9\d{11}"}'):
            find(context, None)
        assert find(context, cameras[1].serial).serial == cameras[1].serial
        cameras[0].unplug()
        assert find(context, None).serial == cameras[1].serial
    finally:
        for camera in cameras:
            camera.close()


def test_a_camera_that_another_program_has_is_refused_with_its_number() -> None:
    claim = claim_camera("test-refused")
    with pytest.raises(ControlTaken, match=rf"another program on this computer \(process {os.getppid()}\)"):
        claim_camera("test-refused")
    claim.release()
    claim_camera("test-refused").release()


def test_an_open_camera_is_held_against_other_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole way of a real one, but for the wire: the library lists it, and nothing says that it is in software."""
    camera = spec(serial="900000000042", warm_up_s=0.0)
    context, plugged = emulated_context(), SoftwareCamera(camera, serial="900000000042")
    plugged.attach(context)
    monkeypatch.setattr(Station, "_plug", lambda self, spec: (context, None))
    station = Station(camera, PictureRing(memoryview(bytearray(PictureRing.size(camera))), camera), lambda news: None)
    try:
        other = claim_camera(plugged.serial)
        with pytest.raises(ControlTaken, match=f"camera {plugged.serial} is in use by another program"):
            station.open()
        other.release()
        assert station.open()["serial"] == plugged.serial
        with pytest.raises(ControlTaken):
            claim_camera(plugged.serial)
        station.close()
        claim_camera(plugged.serial).release()
    finally:
        station.end()
        plugged.close()


class _Stubborn:
    """A sensor that takes every value and keeps its own."""

    def __init__(self, sensor: Any) -> None:
        self._sensor = sensor

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sensor, name)

    def set_option(self, option: Any, value: float) -> None:
        """Nothing comes of it."""


def test_an_option_that_the_camera_does_not_keep_is_an_error() -> None:
    context, plugged = emulated_context(), SoftwareCamera(software())
    plugged.attach(context)
    try:
        sensors = sensors_of(find(context, plugged.serial).device)
        assert apply(sensors, {"laser_power": 120}) == ()
        stubborn = {name: _Stubborn(sensor) for name, sensor in sensors.items()}
        assert apply(stubborn, {"laser_power": 120}) == ()
        with pytest.raises(NotSupported, match="keeps 120 for option depth.laser_power, not 180"):
            apply(stubborn, {"laser_power": 180})
    finally:
        plugged.close()


def test_options_are_set_and_read_back() -> None:
    options = {"depth": {"exposure": 4000, "gain": 32}, "laser_power": 120, "white_balance": 5000}
    with opened(software(options=options)) as cam:
        told = cam.info.options
        assert (told["depth.exposure"], told["depth.gain"]) == (4000.0, 32.0)
        assert (told["depth.laser_power"], told["color.white_balance"]) == (120.0, 5000.0)
        assert told["depth.enable_auto_exposure"] == 0.0, "what is set by hand is not automatic"
        assert told["color.enable_auto_white_balance"] == 0.0
        assert told["color.enable_auto_exposure"] == 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"exposure": 100}, "both have 'exposure'"),
        ({"laser_powr": 100}, r"did you mean 'laser_power'.*\n(.*\n)*.*depth.laser_power: 0 to 360, now 150"),
        ({"laser_power": 1000}, "depth.laser_power must be 0 to 360, not 1000"),
        ({"color": {"laser_power": 1}}, "no option 'laser_power'"),
        ({"depth_units": 0.001}, "can only be read"),
        ({"color": {"exposure": 100, "enable_auto_exposure": True}}, "must be false"),
        ({"laser_power": "full"}, "no value 'full'"),
    ],
)
def test_a_wrong_option_is_answered_with_what_there_is(options: dict[str, object], words: str) -> None:
    driver = RealSenseCamera(software(options=options))
    try:
        with pytest.raises(NotSupported, match=words):
            driver.open()
    finally:
        driver.close()


def test_a_preset_has_a_name() -> None:
    with opened(software(options={"visual_preset": "high_accuracy"})) as cam:
        assert cam.info.options["depth.visual_preset"] == 3.0


def test_unknown_faults_are_refused_and_real_cameras_have_none() -> None:
    with opened(software()) as cam, pytest.raises(CommandError, match="freeze"):
        cam.inject(freez=True)
    driver = RealSenseCamera(spec())
    with pytest.raises(ConnectionLost, match="not open"):
        driver.inject(freeze=True)


def test_the_app_goes_on_while_a_camera_is_looked_for() -> None:
    """The library keeps the interpreter to itself while it starts: that must not be the app's."""
    turns, longest, ending = 0, 0.0, threading.Event()

    def count() -> None:
        nonlocal turns, longest
        last = time.monotonic()
        while not ending.is_set():
            time.sleep(0.001)
            turns, longest, last = turns + 1, max(longest, time.monotonic() - last), time.monotonic()

    with opened(software()) as cam:
        cam.read(timeout=5.0)
        counting = threading.Thread(target=count)
        counting.start()
        cam.inject(disconnect=True)
        read_until_lost(cam, 3.0)
        time.sleep(0.6)
        cam.inject(disconnect=False)
        read_again(cam, 5.0)
        ending.set()
        counting.join()
    assert turns > 100
    assert longest < 0.15, "a dead-man that is silent for so long stops the arm"


def test_a_program_that_forgets_to_close_ends_well() -> None:
    program = textwrap.dedent(
        """
        from tests.wire.realsense_bench import RealSenseCamera, software
        from hal.camera import Camera
        from hal.clock import RealClock
        cam = Camera(RealSenseCamera(software()), RealClock(), threaded=True)
        cam.open()
        print(cam.read(timeout=5.0).stamp.seq, cam._driver._link._child.process.pid)
        """
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30.0, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    pid = int(done.stdout.split()[1])
    wait_until(lambda: not os.path.exists(f"/proc/{pid}"), 3.0)


def test_before_the_first_picture_automatic_exposure_settles() -> None:
    with opened(software(warm_up_s=0.5)) as cam:
        frame = cam.read(timeout=5.0)
        assert frame.stamp.seq >= 10
    with opened(software(warm_up_s=0.5, options={"color": {"exposure": 100}, "depth": {"exposure": 100}})) as cam:
        assert cam.read(timeout=5.0).stamp.seq < 10, "nothing is automatic"


def test_latest_never_waits() -> None:
    with opened(software()) as cam:
        cam.read(timeout=5.0)
        began = time.monotonic()
        assert cam.latest(max_age=5.0) is not None
        assert time.monotonic() - began < 0.05
        with pytest.raises(StaleStateError):
            cam.latest(max_age=-1.0)
