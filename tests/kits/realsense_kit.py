"""Recordings of a RealSense without hardware: the frames of an emulated one, written by the vendor's library."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from contextlib import closing
from pathlib import Path

from hal.specs import CameraSpec
from hal_emulators.realsense.device import EmulatedDevice, load_realsense
from hal_emulators.realsense.pictures import EmulatedImages, make_serial, make_streams, make_title


def write_recording(
    path: Path,
    spec: CameraSpec,
    frames: int,
    *,
    metadata: bool = True,
    pattern: str = "test",
    seed: int = 0,
    lost: Collection[int] = (),
) -> None:
    """Write a recording (``.db3``) of an emulated camera, at once, with the times of a live one.

    The frame numbers are 1 to ``frames`` without those that are ``lost``; the images are those of
    :meth:`.SoftwareCamera.expected`. Without ``metadata``, the library plays frames badly matched.
    """
    numbers = [number for number in range(1, frames + 1) if number not in lost]
    _record(path, spec, numbers, metadata, EmulatedImages(make_streams(spec), pattern, seed))
    _set_times(path, numbers, spec.rate_hz)


def _record(path: Path, spec: CameraSpec, numbers: list[int], metadata: bool, images: EmulatedImages) -> None:
    """Record frames. The library writes in a thread of its own, and finishes when the last reference to recorder and
    sensors goes: at the end of this function.
    """
    rs = load_realsense()
    device = EmulatedDevice(
        make_streams(spec),
        title=make_title(spec),
        serial=make_serial(spec),
        usb="3.2",
        port="recorded",
        global_time=False,
    )
    recorder = rs.recorder(str(path), device.native)
    sensors = list(recorder.query_sensors())
    modes = {name: stream.mode for name, stream in make_streams(spec).items() if name in spec.streams}
    running = []
    for sensor in sensors:
        profiles = [profile for profile in sensor.get_stream_profiles() if device.identify(profile) in modes.items()]
        if profiles:
            sensor.open(profiles)
            sensor.start(rs.frame_queue(1))
            running.append(sensor)
    for number in numbers:
        stamp = 1e3 * (1000.0 + number / spec.rate_hz)
        for name, mode in modes.items():
            if metadata:
                values = {
                    "frame_counter": number,
                    "actual_fps": 1000 * mode.rate,
                    "frame_timestamp": round(1e3 * stamp),
                }
                device.set_metadata(name, values)
            device.push(name, mode, images.expected(name, mode, number), number, stamp, "hardware_clock")
    for sensor in running:
        sensor.stop()
        sensor.close()


def _set_times(path: Path, numbers: list[int], rate_hz: float) -> None:
    """Set the arrival times of frames that were pushed at once: the file is a database of messages."""
    with closing(sqlite3.connect(path)) as database, database:
        topics = [key for (key,) in database.execute("SELECT id FROM topics WHERE name LIKE '%/image/%' ORDER BY id")]
        for place, topic in enumerate(topics):
            rows = [
                key for (key,) in database.execute("SELECT id FROM messages WHERE topic_id=? ORDER BY id", (topic,))
            ]
            if len(rows) != len(numbers):
                raise OSError(f"{path}: {len(rows)} frames were written, not {len(numbers)}")
            times = [round(1e9 * (number - numbers[0]) / rate_hz) + place for number in numbers]
            database.executemany("UPDATE messages SET timestamp=? WHERE id=?", zip(times, rows, strict=True))
