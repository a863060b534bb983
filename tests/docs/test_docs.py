"""The documents tell the truth: their code runs, their files load, their links lead somewhere."""

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hal
from hal import _moved
from hal.errors import ConfigError

from .blocks import RUN, SHOWN, Block, anchors_of, blocks_of, links_of
from .running import ROOT, Reader

DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("C*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def names(paths: list[Path]) -> list[str]:
    return [path.name for path in paths]


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Reader]:
    reader = Reader(tmp_path)
    monkeypatch.setattr(hal, "open", reader.open)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = set(sys.modules)
    yield reader
    reader.close()
    for name in set(sys.modules) - modules:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]  # the next document may have a file of the same name


@pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))
def test_what_a_document_shows_runs(document: Path, reader: Reader) -> None:
    blocks = [block for block in blocks_of(document) if block.language in RUN]
    for block in blocks:
        reader.do(block)
    assert reader.ran == sum(block.mark != "not run" for block in blocks)


@pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))
def test_every_block_is_run_or_marked(document: Path) -> None:
    fences = re.findall(r"^\s*```", document.read_text(encoding="utf-8"), re.MULTILINE)
    blocks = blocks_of(document)
    assert len(fences) == 2 * len(blocks), "every fence stands at the start of its line, and is closed"
    for block in blocks:
        assert block.language in (*RUN, *SHOWN), f"{block}: nobody knows how to run {block.language!r}"
        assert block.mark != "not run" or len(block.value) > 5, f"{block} must say why it is not run"


@pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))
def test_links_lead_somewhere(document: Path) -> None:
    for link in links_of(document):
        if re.match(r"[a-z]+:", link):
            continue  # the network is not asked
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        assert target.exists(), f"{document.name}: {link} is not there"
        assert not anchor or anchor in anchors_of(target), f"{document.name}: {target.name} has no heading #{anchor}"


def test_the_numbers_of_the_safety_rules_are_those_of_the_code() -> None:
    text = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    number_and_place = r"^\|.*?\*\*([\d.]+) ?(ms|s|rad|m/s|m)?\*\*.*`(hal/[\w/]+)\.py` `([\w.]+)`.*\|$"
    rows = re.findall(number_and_place, text, re.MULTILINE)
    assert len(rows) >= 12
    for number, unit, module, name in rows:
        value = importlib.import_module(module.replace("/", "."))
        for part in name.split("."):
            fields = getattr(value, "model_fields", {})
            value = fields[part].default if part in fields else getattr(value, part)
        told = float(number) / (1000.0 if unit == "ms" else 1.0)
        assert value == pytest.approx(told), f"{module}.py {name} is {value}, the document says {number} {unit}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))
def test_the_files_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for path in set(re.findall(r"`((?:hal|tests|drivers|benchmarks|config|apps)/[\w/]+\.\w+)`", text)):
        assert (ROOT / path).is_file(), path
    for path, test in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text):
        assert f"def {test}(" in (ROOT / path).read_text(), f"{path} has no {test}"


def test_the_changelog_has_every_moved_name() -> None:
    rows = re.findall(r"^\| (`.*) \| (`.*) \|$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    shown = [(set(re.findall(r"`(.*?)`", old)), set(re.findall(r"`(.*?)`", new))) for old, new in rows]
    moved = [({old}, {new}) for old, new in _moved.MODULES.items()]
    for module, names in _moved.NAMES.items():
        for old, (home, _, new) in ((old, path.rpartition(".")) for old, path in names.items()):
            moved.append(({module, old}, {home} if new == old else {home, new}))
    missing = [(old, new) for old, new in moved if not any(old <= left and new <= right for left, right in shown)]
    assert not missing


@pytest.mark.parametrize(
    ("language", "text", "error"),
    [
        ("python", "import hal\nhal.open('panda_table', driver='mock').robots['pnada']", hal.DeviceNotFound),
        ("python", "def test_it():\n    assert 1 == 2", AssertionError),
        ("yaml", "robots:\n  arm: {model: pandaa}", ConfigError),
        ("yaml", "robots: {}\nnonsense: 1", AssertionError),
        ("console", "$ hal-teleop --config panda_table --dry-run\n  robot    panda  with wheels", AssertionError),
        ("console", "$ hal-teleop --config nowhere --dry-run", AssertionError),
        ("bash", "make everything", AssertionError),
    ],
)
def test_what_is_wrong_is_noticed(reader: Reader, language: str, text: str, error: type[Exception]) -> None:
    """The tests above can fail."""
    with pytest.raises(error):
        reader.do(Block(Path("wrong.md"), 1, language, text, "", ""))
