"""What the documents state about the code is true: numbers of the safety rules, names of files."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("C*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


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


@pytest.mark.parametrize("document", DOCUMENTS, ids=[path.name for path in DOCUMENTS])
def test_the_files_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for path in set(re.findall(r"`((?:hal|tests|drivers|benchmarks|config|apps)/[\w/]+\.\w+)`", text)):
        assert (ROOT / path).is_file(), path
    for path, test in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text):
        assert f"def {test}(" in (ROOT / path).read_text(), f"{path} has no {test}"
