"""Recordings of a RealSense: made and played by the unmodified library."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.errors import ConnectionLost, ControlTaken, NotSupported

from .realsense_bench import PATIENCE, open_error, opened, read_again, read_until_lost, recording, sent, software, spec

from hal_emulators.realsense import read_number  # isort: skip  # needs the library

FRAMES = 45


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A recording of colour and depth, with FRAMES frames."""
    return recording(tmp_path_factory.mktemp("recorded"), spec(), FRAMES)


def test_unpaced_every_frame_is_read_once_and_in_order(recorded: str) -> None:
    played = spec(play=recorded, paced=False, repeat=False)
    numbers, last = [], None
    with opened(played) as cam:
        with pytest.raises(ConnectionLost) as ended:
            while True:
                last = cam.read(timeout=PATIENCE)
                numbers.append(read_number(last.color))
                assert np.array_equal(last.color, sent(played, "color", numbers[-1]))
                if len(numbers) == 3:
                    time.sleep(0.3)  # the recording waits
        with pytest.raises(ConnectionLost) as again:
            cam.read(timeout=PATIENCE)
        assert ended.value.code == again.value.code == "recording_ended"
        assert again.value.final
        assert cam.counts().dropped == cam.counts().repeated == 0
    assert numbers == list(range(numbers[0], FRAMES + 1))
    assert numbers[0] <= 2


def test_unpaced_the_time_of_a_frame_is_when_it_was_read(recorded: str) -> None:
    with opened(spec(play=recorded, paced=False)) as cam:
        for _ in range(12):
            time.sleep(0.1)  # slower than the recording, so that frames wait
            before = cam.clock.now()
            frame = cam.read(timeout=PATIENCE)
            assert before <= frame.stamp.t <= cam.clock.now()


def test_time_and_numbers_continue_when_it_repeats(tmp_path: Path) -> None:
    file = recording(tmp_path, spec(), 20)
    with opened(spec(play=file, paced=False)) as cam:
        frames = [cam.read(timeout=PATIENCE) for _ in range(70)]
    numbers = [read_number(frame.color) for frame in frames]
    assert (np.diff(numbers) < 0).sum() == 3
    assert (np.diff([frame.stamp.t for frame in frames]) > 0.0).all()
    assert (np.diff([frame.stamp.seq for frame in frames]) > 0).all()


def test_paced_it_takes_as_long_as_the_recording(recorded: str) -> None:
    with opened(spec(play=recorded, repeat=False)) as cam:
        first = last = cam.read(timeout=PATIENCE)
        with pytest.raises(ConnectionLost) as ended:
            while True:
                last = cam.read(timeout=PATIENCE)
        assert ended.value.code == "recording_ended"
        passed = last.stamp.t - first.stamp.t
        recorded_for = last.stamp.t_device - first.stamp.t_device
        assert 0.5 < recorded_for < 1.5
        assert recorded_for - 0.3 < passed < recorded_for + 2.0
        time.sleep(0.5)
        assert not cam.connected, "a recording that has ended stays ended"


def test_a_recording_without_metadata_is_matched_by_the_driver(tmp_path: Path) -> None:
    """The library then repeats frames, and mixes those of two moments."""
    file = recording(tmp_path, spec(), 60, metadata=False)
    with opened(spec(play=file, paced=False, repeat=False)) as cam:
        pairs = []
        with pytest.raises(ConnectionLost) as ended:
            while True:
                frame = cam.read(timeout=PATIENCE)
                assert frame.skew == 0.0
                pairs.append(read_number(frame.color))
        assert ended.value.code == "recording_ended"
        counts = cam.counts()
    assert len(set(pairs)) == len(pairs) >= 20
    assert counts.repeated + counts.mismatched > 0, "else this recording shows nothing"


def test_a_mode_that_it_lacks_is_an_error_that_lists_its_modes(recorded: str) -> None:
    wrong = spec("color", "depth", size=(848, 480), play=recorded)
    error = open_error(wrong)
    assert error.code == "unknown_mode"
    assert "640x480 at 30 Hz (rgb8)" in str(error)
    assert open_error(spec("color", "infrared", play=recorded)).code == "unknown_stream"


def test_files_that_cannot_be_played(tmp_path: Path) -> None:
    assert open_error(spec(play=str(tmp_path / "no.db3"))).code == "missing_file"
    junk = tmp_path / "junk.db3"
    junk.write_bytes(b"this is not a database" * 100)
    assert isinstance(open_error(spec(play=str(junk))), (NotSupported, ConnectionLost))


def test_a_recording_plays_what_was_streamed(tmp_path: Path) -> None:
    file = tmp_path / "mine.db3"
    camera = software(record=str(file))
    with opened(camera) as cam:
        seen = {read_number(cam.read(timeout=PATIENCE).color) for _ in range(20)}
        cam.inject(disconnect=True)
        read_until_lost(cam)
        cam.inject(disconnect=False)
        read_again(cam)
        for _ in range(10):
            cam.read(timeout=PATIENCE)
    for part in (file, tmp_path / "mine-2.db3"):
        played = []
        with opened(spec(play=str(part), paced=False, repeat=False)) as cam, pytest.raises(ConnectionLost) as ended:
            while True:
                frame = cam.read(timeout=PATIENCE)
                played.append(read_number(frame.color))
                assert np.array_equal(frame.color, sent(camera, "color", played[-1]))
        assert ended.value.code == "recording_ended"
        assert len(played) >= 8
        if part == file:
            assert len(seen & set(played)) >= 15
    assert open_error(camera).code == "file_exists"
    with opened(replace(camera, options={**camera.options, "overwrite": True})) as cam:
        cam.read(timeout=PATIENCE)


def test_two_cameras_cannot_record_to_one_file(tmp_path: Path) -> None:
    """Not while the first one is unplugged either."""
    file = tmp_path / "same.db3"
    same = tmp_path / ".." / tmp_path.name / "same.db3"
    with opened(software(name="left", record=str(file))) as left:
        left.read(timeout=PATIENCE)
        written = file.stat().st_ino
        assert open_error(software(name="right", record=str(same))).code == "recording_in_use"
        left.inject(disconnect=True)
        read_until_lost(left)
        error = open_error(software(name="right", record=str(file), overwrite=True))
        assert (type(error), error.code) == (ControlTaken, "recording_in_use")
        assert file.stat().st_ino == written
    with opened(software(name="right", record=str(file), overwrite=True)) as cam:  # now it may
        cam.read(timeout=PATIENCE)
