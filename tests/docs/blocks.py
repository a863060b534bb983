"""The fenced blocks of a Markdown file, and what the comment before each says about running it.

A block is run by its language: ``python``, ``yaml``, ``jsonl``, and commands in ``bash`` or ``console``. Blocks without
a language, and ``text``, are pictures and output. A comment on the line before changes that:

    <!-- file: NAME -->          written to that file, for the blocks after it; YAML, JSON are checked, Python compiled
    <!-- file: NAME, broken -->  the same, and the check must fail
    <!-- copy: PATH -->          the text of that file of the repository, written as its name with all files beside it
    <!-- not run: WHY -->
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

RUN = ("python", "yaml", "jsonl", "bash", "console")
SHOWN = ("", "text", "toml")
"""Never run: pictures, output, and parts of other people's files."""

_FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```\s*?$", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"<!--\s*(file|copy|not run):\s*(.*?)\s*-->\n\Z")


class Block(NamedTuple):
    document: Path
    line: int
    """Of its first line of text, counted from 1."""
    language: str
    text: str
    mark: str
    """``file``, ``copy``, ``not run``, or nothing."""
    value: str
    """What the mark says."""

    def __str__(self) -> str:
        return f"{self.document.name}:{self.line}"


def blocks_of(document: Path) -> list[Block]:
    """All of them, in order."""
    whole = document.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(whole):
        comment = _COMMENT.search(whole[: match.start()])
        mark, value = comment.groups() if comment else ("", "")
        line = whole.count("\n", 0, match.start(2)) + 1
        found.append(Block(document, line, match.group(1), match.group(2), mark, value))
    return found


def links_of(document: Path) -> list[str]:
    """Targets of its links, outside blocks and code."""
    prose = re.sub(r"`[^`\n]*`", "", _FENCE.sub("", document.read_text(encoding="utf-8")))
    return re.findall(r"\]\(([^)\s]+)\)", prose)


def anchors_of(document: Path) -> set[str]:
    """What a link to one of its headings may say after the #, as GitHub makes it."""
    prose = _FENCE.sub("", document.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
