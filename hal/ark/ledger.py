"""What became of every key of Ark's files: kept, changed, without a meaning here, or unknown."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..config.schema import describe
from .reading import Node

__all__ = ["Ledger", "Outcome", "Row", "summary", "table"]

Outcome = Literal["kept", "changed", "nothing", "unknown"]
_MEANING: dict[Outcome, str] = {
    "kept": "kept",
    "changed": "changed",
    "nothing": "without a meaning here",
    "unknown": "unknown",
}
_COLUMN = 62
"""Where the right half of the table begins."""
_WIDEST_VALUE = 26


@dataclass(frozen=True)
class Row:
    """One key."""

    node: Node
    outcome: Outcome
    target: str
    """The key of the rig that it went to; empty where there is none."""
    note: str
    """What changed, or why it has no meaning."""

    @property
    def here(self) -> str:
        """Where it is here, in words."""
        return "; ".join(part for part in (self.target, self.note) if part)


class Ledger:
    """Rows, as the import goes on."""

    def __init__(self) -> None:
        self._rows: list[Row] = []
        self._seen: set[int] = set()

    def kept(self, node: Node | None, target: str, note: str = "") -> None:
        """It means the same in the rig's key ``target``."""
        self._add(node, "kept", target, note)

    def changed(self, node: Node | None, target: str, note: str) -> None:
        """It went to ``target`` with another value or meaning; to none where the note says what does it here."""
        self._add(node, "changed", target, note)

    def nothing(self, node: Node | None, why: str) -> None:
        """It has no meaning here."""
        self._add(node, "nothing", "", why)

    def _add(self, node: Node | None, outcome: Outcome, target: str, note: str) -> None:
        if node is not None and id(node) not in self._seen:
            self._seen.add(id(node))
            self._rows.append(Row(node, outcome, target, note))

    def close(self, files: Iterable[Node]) -> tuple[Row, ...]:
        """All rows in the order of the files, those of the keys that nobody asked for among them."""
        order: dict[Path, int] = {}
        for root in files:
            order[root.file] = len(order)
            for node in self._unseen(root):
                if node.data in (None, {}, []):
                    self.nothing(node, "is empty")
                else:
                    self._add(node, "unknown", "", "nothing here reads it")
        return tuple(sorted(self._rows, key=lambda row: (order.get(row.node.file, 0), row.node.line)))

    def _unseen(self, node: Node) -> Iterator[Node]:
        if id(node) in self._seen:
            return
        if not node.children:
            if node.key:
                yield node
            return
        for child in node.children.values():
            yield from self._unseen(child)

    def origin(self, key: str) -> Node | None:
        """Whose value stands in a key of the rig, or decided what does; else the first below that key."""
        above = [row for row in self._rows if row.target and f"{key}.".startswith(f"{row.target}.")]
        if above:
            return max(above, key=lambda row: len(row.target)).node
        return next((row.node for row in self._rows if row.target.startswith(f"{key}.")), None)


def table(rows: Iterable[Row], folder: Path, width: int = 120) -> list[str]:
    """Rows as text, file by file: line, what became of the key, key and value, and where it is here.

    ``folder`` is what the files' names are shown relative to.
    """
    lines: list[str] = []
    file: Path | None = None
    for row in rows:
        if row.node.file != file:
            file = row.node.file
            lines += ["", str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)]
        head = f"{row.node.line:5d}  {row.outcome:7s}  {row.node.key}: {_value(row.node.data)}".rstrip(": ")
        wrapped = textwrap.wrap(row.here, width - _COLUMN, break_on_hyphens=False, break_long_words=False) or [""]
        if len(head) > _COLUMN - 2:  # a line of its own
            lines.append(head)
            head = ""
        lines.append(f"{head:{_COLUMN}s}{wrapped[0]}".rstrip())
        lines += [" " * _COLUMN + line for line in wrapped[1:]]
    return lines[1:]


def summary(rows: Iterable[Row]) -> str:
    """How many of each."""
    counts = Counter(row.outcome for row in rows)
    parts = [f"{counts[outcome]} {meaning}" for outcome, meaning in _MEANING.items() if counts[outcome]]
    return f"{sum(counts.values())} keys: {', '.join(parts)}"


def _value(data: Any) -> str:
    if isinstance(data, dict):
        return "..."
    if isinstance(data, list):
        whole = "[" + ", ".join(str(item) for item in data) + "]"
        return whole if len(whole) <= _WIDEST_VALUE else describe(data)
    text = "true" if data is True else "false" if data is False else "" if data is None else str(data)
    return text if len(text) <= _WIDEST_VALUE else f"...{text[3 - _WIDEST_VALUE :]}"
