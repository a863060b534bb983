"""Recordings (``.db3``) of an emulated camera, for drivers to play: written at once, paced as if they had been live."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from contextlib import closing
from pathlib import Path

from hal.errors import CommandError
from hal.specs import CameraSpec

from .device import Device
from .figures import Mode, serial_of, streams_of, title_of
from .library import load_realsense
from .pictures import Pictures

__all__ = ["write_recording"]


def write_recording(
    path: str | Path,
    spec: CameraSpec,
    frames: int,
    *,
    metadata: bool = True,
    pattern: str = "test",
    seed: int = 0,
    lost: Collection[int] = (),
) -> None:
    """Write the pictures 1 to ``frames`` of the streams that the spec wants, without those whose numbers are ``lost``.

    They are those that :meth:`~.camera.SoftwareCamera.expected` gives. Without ``metadata`` the library plays them
    badly matched. Raises CommandError where the file exists or has another suffix, DriverMissing.
    """
    path = Path(path)
    if path.suffix != ".db3" or path.exists():
        raise CommandError(f"a recording needs the name of a new file that ends in .db3, not {path}")
    numbers = [number for number in range(1, frames + 1) if number not in lost]
    _record(path, spec, numbers, metadata, Pictures(streams_of(spec), pattern, seed))
    _pace(path, numbers, spec.rate_hz)


def _record(path: Path, spec: CameraSpec, numbers: list[int], metadata: bool, pictures: Pictures) -> None:
    """The library writes in a thread of its own, and is done when the last reference to recorder and sensors is gone:
    at the end of this function."""
    rs = load_realsense()
    device = Device(
        streams_of(spec),
        title=title_of(spec),
        serial=serial_of(spec),
        usb="3.2",
        port="recorded",
        global_time=False,
    )
    recorder = rs.recorder(str(path), device.native)
    sensors = list(recorder.query_sensors())
    wanted = {name: stream.mode for name, stream in streams_of(spec).items() if name in spec.streams}
    running = []
    for sensor in sensors:
        profiles = [profile for profile in sensor.get_stream_profiles() if device.identify(profile) in wanted.items()]
        if profiles:
            sensor.open(profiles)
            sensor.start(rs.frame_queue(1))
            running.append(sensor)
    for number in numbers:
        stamp = 1e3 * (1000.0 + number / spec.rate_hz)
        for name, mode in wanted.items():
            if metadata:
                device.note(name, _metadata(mode, number, stamp))
            device.push(name, mode, pictures.expected(name, mode, number), number, stamp, "hardware_clock")
    for sensor in running:
        sensor.stop()
        sensor.close()


def _metadata(mode: Mode, number: int, stamp: float) -> dict[str, int]:
    return {"frame_counter": number, "actual_fps": 1000 * mode.rate, "frame_timestamp": round(1e3 * stamp)}


def _pace(path: Path, numbers: list[int], rate_hz: float) -> None:
    """Set when each picture arrived, for it was pushed at once: the file is a database of messages."""
    with closing(sqlite3.connect(path)) as database, database:
        topics = [key for (key,) in database.execute("SELECT id FROM topics WHERE name LIKE '%/image/%' ORDER BY id")]
        for place, topic in enumerate(topics):
            rows = [
                key for (key,) in database.execute("SELECT id FROM messages WHERE topic_id=? ORDER BY id", (topic,))
            ]
            if len(rows) != len(numbers):
                raise OSError(f"{path}: {len(rows)} pictures were written, not {len(numbers)}")
            times = [round(1e9 * (number - numbers[0]) / rate_hz) + place for number in numbers]
            database.executemany("UPDATE messages SET timestamp=? WHERE id=?", zip(times, rows, strict=True))
