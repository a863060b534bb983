"""Uploaded episodes: what is at an address is the worker's dataset, and nothing is left in temporary folders."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from errors_kit import raises_code

from hal.errors import CommandError, ConnectionLost, DriverMissing
from hal.learning.uploads import EpisodeUploader, UploadedEpisodes

pytest.importorskip("fsspec", reason="pip install 'robot-hal[ray]'")


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder of a worker's computer."""
    folder = tmp_path / "node"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def write(folder: Path, **files: str) -> None:
    """Write files into a dataset; like a recorder's, each takes the place of the one before."""
    for name, text in files.items():
        path = folder / "meta" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".new").write_text(text)
        path.with_suffix(".new").replace(path)


def test_the_files_of_each_worker_come_back_as_they_were(node: Path, tmp_path: Path) -> None:
    address = (tmp_path / "bucket" / "run").as_uri()
    uploaded = UploadedEpisodes(address, {"seed": 5})
    assert uploaded.marks() == {}
    one, other = EpisodeUploader(address), EpisodeUploader(address)
    write(one.folder, info="1", rows_0="a" * 5000)
    one.upload(7, True)
    write(one.folder, info="2", rows_1="b")
    one.upload(3, None)
    write(other.folder, info="1 of the other", rows_0="c")
    other.upload(4, False)
    sizes = [path.stat().st_size for path in sorted((tmp_path / "bucket").rglob("000001.3.none.zip"))]
    assert max(sizes) < 2000, "files that are there already are not sent again"
    (tmp_path / "bucket/run/0a/").mkdir()
    (tmp_path / "bucket/run/0a/000000.9.true.zip.part").write_text("half of an episode")

    again = UploadedEpisodes(address, {"seed": 6})
    assert again.recipe == {"seed": 5}, "as it was begun"
    assert again.marks() == {7: True, 3: None, 4: False}
    found = {
        frozenset((path.name, path.read_text()) for path in part.rglob("*") if path.is_file())
        for part in again.download(tmp_path / "parts")
    }
    assert found == {
        frozenset({("info", "2"), ("rows_0", "a" * 5000), ("rows_1", "b")}),
        frozenset({("info", "1 of the other"), ("rows_0", "c")}),
    }
    again.remove()
    assert again.marks() == {}
    one.close(), other.close()
    assert list(node.iterdir()) == []


def test_a_new_part_begins_before_the_temporary_folder_grows(
    node: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hal.learning.uploads.GROUP", 2)
    uploader = EpisodeUploader((tmp_path / "bucket").as_uri())
    for number in range(3):
        assert uploader.is_full == (number == 2)
        if uploader.is_full:
            uploader.begin()
            assert not any(path.is_file() for path in node.rglob("*")), "those are uploaded"
        write(uploader.folder, info=str(number))
        uploader.upload(number, True)
    uploader.close()
    assert len(list((tmp_path / "bucket").iterdir())) == 2


def test_what_killed_workers_left_is_removed_and_what_living_ones_use_is_not(node: Path, tmp_path: Path) -> None:
    living = EpisodeUploader((tmp_path / "bucket").as_uri())
    write(living.folder, info="1")
    (node / "hal-generate-killed").mkdir()
    (node / "hal-generate-killed" / "rows").touch()
    (node / "other").mkdir()
    EpisodeUploader((tmp_path / "bucket").as_uri()).close()
    assert {path.name for path in node.iterdir()} == {"other", living.folder.parent.name}
    living.close()


def test_an_address_that_cannot_be_used_is_an_error_with_its_name(node: Path, tmp_path: Path) -> None:
    with raises_code(CommandError, "bad_address"):
        EpisodeUploader("bucket3://run")
    with pytest.raises(DriverMissing, match="s3://bucket/run"):
        UploadedEpisodes("s3://bucket/run", {})
    (tmp_path / "bucket").write_text("a file, and no folder")
    with raises_code(ConnectionLost, "upload_failed"):
        UploadedEpisodes((tmp_path / "bucket").as_uri(), {})
    uploader = EpisodeUploader((tmp_path / "bucket").as_uri())
    write(uploader.folder, info="1")
    with raises_code(ConnectionLost, "upload_failed"):
        uploader.upload(0, True)
    uploader.close()
    os.unlink(tmp_path / "bucket")
