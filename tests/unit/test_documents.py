"""What the documents state about the code is true: numbers of the safety rules, names of files."""

import importlib
import re
from functools import cache
from pathlib import Path
from unittest import mock

import pytest
from app_kit import run_here

from hal.apps.main import PROGRAMS, main

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    ROOT / "README.md",
    *(file for place in ("C*.md", "docs/**/*.md", "packages/*/README.md") for file in sorted(ROOT.glob(place))),
]


def test_numbers_in_safety_md_are_those_of_the_code() -> None:
    text = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    number_and_place = r"^\|.*?\*\*([\d.]+) ?(ms|s|rad|m/s|m)?\*\*.*`(hal/[\w/]+)\.py` `([\w.]+)`.*\|$"
    rows = re.findall(number_and_place, text, re.MULTILINE)
    assert len(rows) >= 12
    for number, unit, module, name in rows:
        value = importlib.import_module(module.replace("/", "."))
        for part in name.split("."):
            fields = getattr(value, "model_fields", {})
            value = fields[part].default if part in fields else getattr(value, part)
        stated = float(number) / (1000.0 if unit == "ms" else 1.0)
        assert value == pytest.approx(stated), f"{module}.py {name} is {value}, docs/safety.md has {number} {unit}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=[f"{path.parent.name}/{path.name}" for path in DOCUMENTS])
def test_the_files_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for path in set(re.findall(r"`((?:hal|tests|drivers|benchmarks|config|apps)/[\w/]+\.\w+)`", text)):
        assert (ROOT / path).is_file(), path
    for path, test in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text):
        assert f"def {test}(" in (ROOT / path).read_text(), f"{path} has no {test}"


FOLDERS = ("apps", "config", "drivers", "examples", "hal", "packages/emulators/src", "sensors")
SOURCES = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.*") if path.suffix in (".py", ".yaml")]
COMMAND = re.compile(
    r"""(?:^[ #$]*|(?<!name=)(?<!name=f)[`"'(:,;] ?|\b(?:or|run|with|see|and) )"""
    r"""(hal|python -m [\w.]+) ([^`"'\n;|>#)]*)""",
    re.MULTILINE,
)
"""A command in a page, a help text or a message, and its words; threads (``name="hal pad"``) are none."""
SUBCOMMANDS = ("dataset", "calibrate")


@cache
def help_text(*words: str) -> str:
    """Return what a command shows with ``--help``."""
    if words[0] == "hal":
        done = run_here(main, *words[1:], "--help")
    else:
        name = f"{words[0]}.__main__" if hasattr(importlib.import_module(words[0]), "__path__") else words[0]
        program = importlib.import_module(name)
        with mock.patch("sys.argv", [*words, "--help"]):
            done = run_here(lambda _: program.main() or 0)
    assert done.returncode == 0, f"{words}: {done.stderr}"
    return done.stdout


@pytest.mark.parametrize("paths", [DOCUMENTS, SOURCES], ids=["documents", "sources"])
def test_commands_that_are_named_exist_and_have_the_options_beside_them(paths: list[Path]) -> None:
    checked = 0
    for path in paths:
        text = re.sub(r"\\\n\s*", "", path.read_text(encoding="utf-8"))
        for command, rest in COMMAND.findall(text):
            words = [word.rstrip(".,") for word in re.match(r"(?:[a-z][a-z-]*[.,]?(?: |$)){0,2}", rest)[0].split()]
            where = f"{path.name}: {command} {rest}"
            if command == "hal":
                if not words or words[0] == "import-ark":  # alone, or in a package that need not be installed
                    continue
                if words[0] == "emulate":
                    known = help_text("hal_emulators.program", *words[1:])
                else:
                    assert words[0] in (*PROGRAMS, "list", "schema"), where
                    known = help_text("hal", words[0])
                if words[0] in SUBCOMMANDS and len(words) > 1:
                    known += help_text("hal", *words)
            elif command.startswith("python -m hal."):
                known = help_text(command.removeprefix("python -m "))
            else:
                continue
            checked += 1
            for option in re.findall(r"(?<!\S)--[a-z][a-z-]*", rest):
                assert option in known, f"{where}: there is no {option}"
    assert checked > 30
