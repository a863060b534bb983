"""Depth on disk: nothing is lost, and a file may end anywhere."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

from hal.recording.codecs import DepthFile, DepthReader, copy_records, depth_unit_for, to_units, truncate_records


def pictures(count: int) -> list[NDArray[np.float32]]:
    rng = np.random.default_rng(3)
    return [rng.integers(0, 65536, (6, 9)).astype(np.float32) * np.float32(0.001) for _ in range(count)]


def written(path: Path, shown: list[NDArray[np.float32] | None], unit: float = 0.001) -> Path:
    with io.FileIO(path, "w+") as file:
        depth = DepthFile(file, 9, 6, unit)
        for picture in shown:
            depth.add(picture)
    return path


@pytest.mark.parametrize("unit", [0.001, 0.0001, 0.00025, 0.0000125])
def test_what_a_camera_measured_in_its_unit_comes_back_to_the_bit(tmp_path: Path, unit: float) -> None:
    raw = np.arange(65536, dtype=np.uint16)
    metres = raw.astype(np.float32) * np.float32(unit)
    assert np.array_equal(to_units(metres, unit), raw)
    shown = raw[: 6 * 9 * 1000].reshape(1000, 6, 9)
    path = written(tmp_path / "d", [picture.astype(np.float32) * np.float32(unit) for picture in shown], unit)
    for read, picture in zip(DepthReader(path), shown, strict=True):
        assert np.array_equal(read, picture.astype(np.float32) * np.float32(unit))


def test_what_was_not_measured_is_nought(tmp_path: Path) -> None:
    odd = np.array([0.0, np.nan, np.inf, -np.inf, -1.0, 65.5354, 65.5356, 70.0, 1e30], np.float32)
    assert to_units(odd, 0.001).tolist() == [0, 0, 0, 0, 0, 65535, 0, 0, 0]


@pytest.mark.parametrize(("reach", "unit"), [(3.0, 0.0001), (6.5, 0.0001), (10.0, 0.00025), (100.0, 0.002)])
def test_the_unit_of_a_simulated_camera_is_the_finest_that_reaches_as_far(reach: float, unit: float) -> None:
    assert depth_unit_for(reach) == unit
    depth = np.linspace(0.0, reach, 1000, dtype=np.float32)
    back = to_units(depth, unit) * np.float32(unit)
    assert np.abs(back - depth).max() <= 0.5 * unit + 1e-6 * reach


def test_the_same_picture_again_takes_a_few_bytes(tmp_path: Path) -> None:
    first, second = pictures(2)
    path = written(tmp_path / "d", [first, None, None, second])
    for read, picture in zip(DepthReader(path), [first, first, first, second], strict=True):
        assert np.array_equal(read, picture)
    assert path.stat().st_size - written(tmp_path / "e", [first, second]).stat().st_size == 2 * 8


def test_a_row_is_decoded_without_the_others(tmp_path: Path) -> None:
    shown = pictures(3)
    path = written(tmp_path / "d", [shown[0], None, shown[1], shown[2], None, None])
    expected = [shown[k] for k in (0, 0, 1, 2, 2, 2)]
    reader = DepthReader(path)
    for k in (5, 0, 3, 1, -4, 4):
        assert np.array_equal(reader[k], expected[k])
    for k in (6, -7):
        with pytest.raises(IndexError):
            reader[k]
    data = bytearray(path.read_bytes())
    place = reader.end_of(2) + 20  # in the record of row 2
    data[place] ^= 1
    path.write_bytes(data)
    damaged = DepthReader(path)
    assert np.array_equal(damaged[4], shown[2])
    with pytest.raises(ValueError, match="2 is damaged"):
        damaged[2]
    nothing = DepthReader(written(tmp_path / "n", [None, None]))
    assert not nothing[1].any()
    assert np.array_equal(nothing[1], list(nothing)[1])


def test_some_rows_become_a_file_of_their_own(tmp_path: Path) -> None:
    shown = pictures(3)
    path = written(tmp_path / "d", [shown[0], None, None, shown[1], None, shown[2]])
    whole = list(DepthReader(path))
    for first in range(6):
        for end in range(first + 1, 7):
            copy_records(path, tmp_path / "part", first, end)
            assert np.array_equal(list(DepthReader(tmp_path / "part")), whole[first:end]), (first, end)
    for wrong in ((0, 7), (3, 3), (-1, 2)):
        with pytest.raises(ValueError, match="pictures"):
            copy_records(path, tmp_path / "wrong", *wrong)


def test_a_file_may_end_anywhere(tmp_path: Path) -> None:
    shown = pictures(4)
    whole = written(tmp_path / "d", [*shown]).read_bytes()
    head = whole.index(b"\n") + 1
    counts = []
    for end in range(head, len(whole) + 1):
        (tmp_path / "cut").write_bytes(whole[:end])
        read = list(DepthReader(tmp_path / "cut"))
        assert all(np.array_equal(a, b) for a, b in zip(read, shown, strict=False))
        counts.append(len(read))
    assert counts[0] == 0
    assert counts[-1] == 4
    assert counts == sorted(counts)


def test_a_last_picture_that_was_half_written_is_noticed(tmp_path: Path) -> None:
    path = written(tmp_path / "d", [*pictures(3)])
    data = bytearray(path.read_bytes())
    data[-20:] = bytes(20)  # its length is on the disk, what it held is not
    path.write_bytes(data)
    assert len(DepthReader(path)) == 2
    truncate_records(path, 1)
    assert len(DepthReader(path)) == 1
    truncate_records(path, 0)
    assert len(DepthReader(path)) == 0
