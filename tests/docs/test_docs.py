"""The documents tell the truth: their code runs, their files load, their links lead somewhere."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hal
from hal.errors import ConfigError

from .blocks import RUN, SHOWN, Block, anchors_of, blocks_of, links_of
from .running import HANG, ROOT, Reader

DOCUMENTS = [
    ROOT / "README.md",
    *(file for place in ("C*.md", "docs/**/*.md", "packages/*/README.md") for file in sorted(ROOT.glob(place))),
]


def names(paths: list[Path]) -> list[str]:
    return [f"{path.parent.name}/{path.name}" for path in paths]


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


@pytest.mark.timeout(2 * HANG)
@pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))
def test_what_a_document_shows_runs(document: Path, reader: Reader) -> None:
    blocks = [block for block in blocks_of(document) if block.language in RUN]
    if document.name == "your-own-arm.md":
        pytest.importorskip("pybullet_data", reason="its URDF comes with PyBullet")
    if document.parent.name == "import-ark":
        pytest.importorskip("hal_import_ark", reason="needs pip install -e packages/import-ark")
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


@pytest.mark.parametrize(
    ("language", "text", "error"),
    [
        ("python", "import hal\nhal.open('panda_table', driver='mock').robots['pnada']", hal.DeviceNotFound),
        ("python", "def test_it():\n    assert 1 == 2", AssertionError),
        ("yaml", "robots:\n  arm: {model: pandaa}", ConfigError),
        ("yaml", "robots: {}\nnonsense: 1", AssertionError),
        ("console", "$ hal teleop --config panda_table --dry-run\n  robot    panda  with wheels", AssertionError),
        ("console", "$ hal teleop --config nowhere --dry-run", AssertionError),
        ("bash", "make everything", AssertionError),
    ],
)
def test_what_is_wrong_is_noticed(reader: Reader, language: str, text: str, error: type[Exception]) -> None:
    """The tests above can fail."""
    with pytest.raises(error):
        reader.do(Block(Path("wrong.md"), 1, language, text, "", ""))
