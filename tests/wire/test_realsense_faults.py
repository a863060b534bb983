"""Faults of a RealSense and the recovery from them: unplugged, silent, hung, in use, wrong options."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from typing import Any

import pytest
from waiting import wait_until

from hal.errors import CommandError, ConnectionLost, ControlTaken, DeviceNotFound, NotSupported, StaleStateError

from .realsense_bench import (
    PATIENCE,
    RealSenseCamera,
    open_error,
    opened,
    read_again,
    read_until_lost,
    software,
    spec,
    wait_for_code,
)

from hal.drivers.realsense.device import RealSenseDevice, find_camera, lock_camera  # isort: skip  # needs the library
from hal_emulators.realsense import SoftwareCamera, emulated_context  # isort: skip
from hal.drivers.realsense.options import apply_options, find_sensors  # isort: skip
from hal.host.ring import FrameRing  # isort: skip


def test_a_camera_works_again_after_it_was_unplugged() -> None:
    with opened(software()) as cam:
        news: list[ConnectionLost | None] = []
        cam.on_connection(news.append)
        before = cam.read(timeout=PATIENCE)
        cam.inject(disconnect=True)
        error = read_until_lost(cam)
        lost_at = time.monotonic()
        assert error.code == "unplugged"
        with pytest.raises(ConnectionLost):
            cam.read_latest()
        wait_for_code(cam, "device_not_found")
        assert not cam.connected
        cam.inject(disconnect=False)
        again = read_again(cam)
        assert again.stamp.seq > before.stamp.seq
        assert again.stamp.t > lost_at
        assert cam.counts().reconnects == 1
        wait_until(lambda: len(news) > 1)  # callbacks run after the frame is readable
        assert [type(item) for item in news] == [ConnectionLost, type(None)]


def test_another_camera_does_not_take_the_place_of_one_that_was_unplugged() -> None:
    """Without a serial number in the rig: it has another calibration than what is recorded."""
    with opened(software()) as cam:
        cam.read(timeout=PATIENCE)
        cam._driver._info = replace(cam.info, serial="12345")
        cam.inject(disconnect=True)
        read_until_lost(cam)
        cam.inject(disconnect=False)
        wait_until(lambda: "no RealSense with serial 12345; connected: Intel" in str(read_until_lost(cam)))


def test_a_silent_camera_is_lost_and_comes_back() -> None:
    with opened(software(stall_s=0.5)) as cam:
        cam.read(timeout=PATIENCE)
        cam.inject(freeze=True)
        assert read_until_lost(cam).code == "stalled"
        cam.inject(freeze=False)
        read_again(cam)


def test_one_silent_stream_is_named() -> None:
    with opened(software(stall_s=0.5)) as cam:
        cam.read(timeout=PATIENCE)
        cam.inject(drop=1, drop_stream="color")
        assert "color" in str(read_until_lost(cam))
        assert cam.counts().mismatched > 0


def process_of(cam: object) -> int:
    """Return the number of the process with the library."""
    return int(cam._driver._link._child.process.pid)


def test_a_process_that_hangs_is_killed_and_replaced() -> None:
    with opened(software(stall_s=0.3)) as cam:
        cam.read(timeout=PATIENCE)
        pid = process_of(cam)
        os.kill(pid, signal.SIGSTOP)
        assert read_until_lost(cam).code == "process_silent"
        read_again(cam)
        assert process_of(cam) != pid
        assert not os.path.exists(f"/proc/{pid}")


def test_a_process_that_dies_is_replaced() -> None:
    with opened(software()) as cam:
        cam.read(timeout=PATIENCE)
        os.kill(process_of(cam), signal.SIGKILL)
        read_until_lost(cam)
        read_again(cam)


def test_close_is_bounded_and_idempotent_even_if_the_library_hangs() -> None:
    driver = RealSenseCamera(software())
    driver.open()
    os.kill(driver._link._child.process.pid, signal.SIGSTOP)
    began = time.monotonic()
    driver.close()
    driver.close()
    assert time.monotonic() - began < 6.0
    with pytest.raises(ConnectionLost):
        driver.grab(0.0)
    driver.open()
    wait_until(lambda: driver.grab(0.1) is not None)
    driver.close()


def test_a_closed_camera_leaves_no_process() -> None:
    driver = RealSenseCamera(software())
    driver.open()
    pid = driver._link._child.process.pid
    driver.close()
    assert not os.path.exists(f"/proc/{pid}")


def test_a_lost_camera_that_is_closed_for_good_leaves_no_process() -> None:
    driver = RealSenseCamera(software())
    driver.open()
    pid = driver._link._child.process.pid
    driver.inject(disconnect=True)
    with pytest.raises(ConnectionLost):
        while True:
            driver.grab(1.0)
    driver.close()
    assert os.path.exists(f"/proc/{pid}"), "the emulated camera is in it, and may be plugged in again"
    with pytest.raises(DeviceNotFound):
        driver.open()
    driver.close()
    assert os.path.exists(f"/proc/{pid}")
    driver.close()
    assert not os.path.exists(f"/proc/{pid}")


def test_a_camera_that_is_closed_during_a_reconnect_leaves_no_process() -> None:
    with opened(software()) as cam:
        cam.read(timeout=PATIENCE)
        pid = process_of(cam)
        cam.inject(disconnect=True)
        read_until_lost(cam)
        wait_for_code(cam, "device_not_found")  # it was closed and opened without success
    wait_until(lambda: not os.path.exists(f"/proc/{pid}"))


def test_without_a_camera_open_fails_at_once() -> None:
    for options in ({}, {"serial": "0123"}):
        driver = RealSenseCamera(spec(**options))
        try:
            with pytest.raises(DeviceNotFound):
                driver.open()
            began = time.monotonic()
            with pytest.raises(DeviceNotFound):  # the process runs by now
                driver.open()
            assert time.monotonic() - began < 5.0, "the library would have waited for 15 s"
        finally:
            driver.close()


def test_the_error_lists_the_connected_cameras() -> None:
    context = emulated_context()
    cameras = [SoftwareCamera(software(name=name)) for name in ("left", "right")]
    try:
        for camera in cameras:
            camera.attach(context)
        for serial, code in (("42", "device_not_found"), (None, "several_devices")):
            with pytest.raises(DeviceNotFound) as caught:
                find_camera(context, serial)
            assert caught.value.code == code
            assert all(camera.serial in str(caught.value) for camera in cameras)
        assert find_camera(context, cameras[1].serial).serial == cameras[1].serial
        cameras[0].unplug()
        assert find_camera(context, None).serial == cameras[1].serial
    finally:
        for camera in cameras:
            camera.close()


def test_a_locked_camera_is_refused_and_its_process_named() -> None:
    lock = lock_camera("test-refused")
    with pytest.raises(ControlTaken, match=rf"process {os.getpid()}\b"):
        lock_camera("test-refused")
    lock.release()
    lock_camera("test-refused").release()


def test_an_open_camera_is_locked_against_other_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The path of a real camera except the wire: the library lists it, and the driver does not know it is emulated."""
    camera = spec(serial="900000000042", warm_up_s=0.0)
    context, plugged = emulated_context(), SoftwareCamera(camera, serial="900000000042")
    plugged.attach(context)
    monkeypatch.setattr(RealSenseDevice, "_create_context", lambda self, spec: (context, None))
    ring = FrameRing(memoryview(bytearray(FrameRing.size(camera))), camera)
    device = RealSenseDevice(camera, ring, lambda news: None)
    try:
        other = lock_camera(plugged.serial)
        with pytest.raises(ControlTaken):
            device.open()
        other.release()
        assert device.open()["serial"] == plugged.serial
        with pytest.raises(ControlTaken):
            lock_camera(plugged.serial)
        device.close()
        lock_camera(plugged.serial).release()
    finally:
        device.dispose()
        plugged.close()


class _Stubborn:
    """A sensor that accepts every value and keeps its own."""

    def __init__(self, sensor: Any) -> None:
        self._sensor = sensor

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sensor, name)

    def set_option(self, option: Any, value: float) -> None:
        """Do nothing."""


def test_an_option_that_the_camera_does_not_keep_is_an_error() -> None:
    context, plugged = emulated_context(), SoftwareCamera(software())
    plugged.attach(context)
    try:
        sensors = find_sensors(find_camera(context, plugged.serial).device)
        assert apply_options(sensors, {"laser_power": 120}) == ()
        stubborn = {name: _Stubborn(sensor) for name, sensor in sensors.items()}
        assert apply_options(stubborn, {"laser_power": 120}) == ()
        with pytest.raises(NotSupported) as caught:
            apply_options(stubborn, {"laser_power": 180})
        assert caught.value.code == "option_rejected"
    finally:
        plugged.close()


def test_options_are_set_and_read_back() -> None:
    options = {"depth": {"exposure": 4000, "gain": 32}, "laser_power": 120, "white_balance": 5000}
    with opened(software(options=options)) as cam:
        values = cam.info.options
        assert (values["depth.exposure"], values["depth.gain"]) == (4000.0, 32.0)
        assert (values["depth.laser_power"], values["color.white_balance"]) == (120.0, 5000.0)
        assert values["depth.enable_auto_exposure"] == 0.0, "a manual value switches its automatic off"
        assert values["color.enable_auto_white_balance"] == 0.0
        assert values["color.enable_auto_exposure"] == 1.0


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"exposure": 100}, "ambiguous_option"),
        ({"laser_powr": 100}, "unknown_option"),
        ({"laser_power": 1000}, "option_out_of_range"),
        ({"color": {"laser_power": 1}}, "unknown_option"),
        ({"depth_units": 0.001}, "option_read_only"),
        ({"color": {"exposure": 100, "enable_auto_exposure": True}}, "option_conflict"),
        ({"laser_power": "full"}, "unknown_option_value"),
    ],
)
def test_a_wrong_option_is_refused(options: dict[str, object], code: str) -> None:
    error = open_error(software(options=options))
    assert isinstance(error, NotSupported)
    assert error.code == code
    assert ("depth.laser_power: 0 to 360" in str(error)) == ("laser_powr" in options), "lists what there is"


def test_a_preset_has_a_name() -> None:
    with opened(software(options={"visual_preset": "high_accuracy"})) as cam:
        assert cam.info.options["depth.visual_preset"] == 3.0


def test_unknown_faults_are_refused_and_real_cameras_have_none() -> None:
    with opened(software()) as cam, pytest.raises(CommandError):
        cam.inject(freez=True)
    driver = RealSenseCamera(spec())
    with pytest.raises(ConnectionLost):
        driver.inject(freeze=True)


def test_the_app_is_not_blocked_during_a_reconnect() -> None:
    """The library holds the interpreter's lock while it starts, so it must not run in the app's process.

    A busy computer may pause the app, too, but not at each of several reconnects.
    """
    pauses: list[float] = []
    ending = threading.Event()

    def measure() -> None:
        last = time.monotonic()
        while not ending.is_set():
            time.sleep(0.001)
            pauses[-1], last = max(pauses[-1], time.monotonic() - last), time.monotonic()

    with opened(software()) as cam:
        cam.read(timeout=PATIENCE)
        measuring = threading.Thread(target=measure)
        for _ in range(5):
            pauses.append(0.0)
            if not measuring.is_alive():
                measuring.start()
            cam.inject(disconnect=True)
            read_until_lost(cam)
            wait_for_code(cam, "device_not_found")
            cam.inject(disconnect=False)
            read_again(cam)
            if pauses[-1] < 0.15:
                break
        ending.set()
        measuring.join()
    assert 0.0 < min(pauses) < 0.15, "a dead-man that is silent for so long stops the arm"


def test_a_program_that_does_not_close_leaves_no_process() -> None:
    program = textwrap.dedent(
        """
        import sys
        sys.path.insert(0, "tests/kits")
        from tests.wire.realsense_bench import RealSenseCamera, software
        from hal.camera import Camera
        from hal.clock import RealClock
        cam = Camera(RealSenseCamera(software()), RealClock(), threaded=True)
        cam.open()
        print(cam.read(timeout=15.0).stamp.seq, cam._driver._link._child.process.pid)
        """
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    pid = int(done.stdout.split()[1])
    wait_until(lambda: not os.path.exists(f"/proc/{pid}"))


def test_automatic_exposure_settles_before_the_first_frame() -> None:
    with opened(software(warm_up_s=1.5)) as cam:
        assert cam.read(timeout=PATIENCE).stamp.seq >= 10  # 45, but for frames that a busy computer loses
    with opened(software(warm_up_s=1.5, options={"color": {"exposure": 100}, "depth": {"exposure": 100}})) as cam:
        assert cam.read(timeout=PATIENCE).stamp.seq < 40, "no exposure is automatic"


def test_latest_never_waits() -> None:
    with opened(software(stall_s=60.0)) as cam:
        cam.read(timeout=PATIENCE)
        cam.inject(freeze=True)  # there is nothing to wait for
        began = time.monotonic()
        assert cam.read_latest(max_age=60.0) is not None
        assert time.monotonic() - began < 5.0
        with pytest.raises(StaleStateError):
            cam.read_latest(max_age=-1.0)
