"""The files that the console serves, and how much its process logs."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path

from errors_kit import raises_code

from hal.drivers.web.process import LogLimit
from hal.drivers.web.server import read_page_files
from hal.errors import DriverMissing
from hal.pads.keyboard import keyboard_table


def test_the_page_names_the_keys_of_the_table() -> None:
    """The buttons' shortcuts are static text in index.html; the keys themselves come from sensors/keyboard.yaml."""
    page = read_page_files()["index.html"][0].decode()
    found = dict(re.findall(r'data-button="(\w+)" aria-keyshortcuts="([^"]+)"', page))
    wanted: dict[str, list[str]] = {}
    for key, control in keyboard_table("browser").buttons.items():
        wanted.setdefault(control, []).append(key.removeprefix("Key").removeprefix("Digit"))
    assert {control: sorted(keys.split()) for control, keys in found.items()} == {
        control: sorted(keys) for control, keys in wanted.items()
    }


def test_only_files_of_a_page_are_read(tmp_path: Path) -> None:
    for name in ("index.html", "pad.js", "page.css", "icon.svg", "icon.png", "__init__.py", "notes.txt", ".hidden"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder.js").mkdir()
    files = read_page_files(tmp_path)
    assert sorted(files) == ["index.html", "pad.js", "page.css"]
    assert files["pad.js"] == (b"pad.js", "text/javascript; charset=utf-8")


def test_without_its_page_it_does_not_start(tmp_path: Path) -> None:
    (tmp_path / "pad.js").write_text("")
    for folder in (tmp_path, tmp_path / "nowhere"):
        with raises_code(DriverMissing, "page_missing"):
            read_page_files(folder)


def test_the_log_of_libraries_is_limited() -> None:
    written = io.StringIO()
    handler = logging.StreamHandler(written)
    handler.addFilter(LogLimit(3))
    for k in range(1000):
        try:
            raise OSError(f"no more files, {k}")
        except OSError as error:
            record = logging.LogRecord("asyncio", logging.ERROR, "", 0, "said %d", (k,), (OSError, error, None))
        handler.handle(record)
    lines = written.getvalue().splitlines()
    assert lines[0] == "said 0"
    assert "OSError: no more files, 2" in lines
    assert lines[-1] == "further records of this kind are not shown"
    assert not any("3" in line for line in lines)
