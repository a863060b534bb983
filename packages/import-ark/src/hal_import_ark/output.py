"""Output of an import: the rig's YAML with comments, and the report of every key of Ark's files."""

from __future__ import annotations

import os
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from hal.config.schema import describe

from .reading import PACKAGE, ArkNode, PackageFile

_WIDTH = 110


@dataclass(frozen=True)
class Commented:
    """A value with a comment behind it, or above it if the line is too long."""

    value: Any
    comment: str


@dataclass(frozen=True)
class Remark:
    """A comment instead of an entry; its key is not written."""

    text: str


class Inline(dict[str, Any]):
    """A mapping that is written in one line."""


def plain(value: Any, folder: Path) -> Any:
    """Return the value without comments, as it is read back; paths become relative to ``folder``."""
    if isinstance(value, Commented):
        return plain(value.value, folder)
    if isinstance(value, PackageFile):
        return {"package": PACKAGE, "path": str(value)}
    if isinstance(value, Path):
        return _relative(value, folder)
    if isinstance(value, Mapping):
        return {key: plain(item, folder) for key, item in value.items() if not isinstance(item, Remark)}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(item, folder) for item in value]
    return value


def yaml_text(entries: Mapping[str, Any], folder: Path) -> str:
    """Return the text of a file in ``folder``, with an empty line before every top-level block."""
    lines: list[str] = []
    for key, value in entries.items():
        block = _entry(key, value, 0, folder)
        if lines and len(block) > 1:
            lines.append("")
        lines += block
    return "\n".join(lines) + "\n"


def _entry(key: str, value: Any, indent: int, folder: Path) -> list[str]:
    space = " " * indent
    if isinstance(value, Remark):
        return [f"{space}# {line}" for line in value.text.splitlines()]
    comment = value.comment if isinstance(value, Commented) else ""
    value = _bare(value)
    name = _scalar(key)
    if isinstance(value, Mapping) and value and not isinstance(value, Inline):
        head = [_add_comment(f"{space}{name}:", comment)]
        return head + [line for k, item in value.items() for line in _entry(str(k), item, indent + 2, folder)]
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        lines = [_add_comment(f"{space}{name}:", comment)]
        for item in value:
            inner = [line for k, part in item.items() for line in _entry(str(k), part, indent + 4, folder)]
            first = next(k for k, line in enumerate(inner) if not line.lstrip().startswith("#"))
            inner[first] = f"{space}  - {inner[first].lstrip()}"
            lines += inner
        return lines
    written = plain(value, folder)
    line = f"{space}{name}: {_alone(written) if isinstance(written, str) else _flow(written)}"
    if comment and len(line) + len(comment) + 4 > _WIDTH:
        return [f"{space}# {comment}", line]
    return [_add_comment(line, comment)]


def _bare(value: Any) -> Any:
    return value.value if isinstance(value, Commented) else value


def _add_comment(line: str, comment: str) -> str:
    return f"{line}    # {comment}" if comment else line


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_scalar(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_flow(item) for item in value) + "]"
    return _scalar(value)


def _alone(text: str) -> str:
    """A text that ends its line and so needs fewer quotes."""
    return yaml.safe_dump(text, width=float("inf"), allow_unicode=True).removesuffix("...\n").strip()


def _scalar(value: Any) -> str:
    """A value inside a line."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value)) if value else "0"
    text = yaml.safe_dump([value], default_flow_style=True, width=float("inf"), allow_unicode=True)
    return text.strip()[1:-1]


def _relative(path: Path, folder: Path) -> str:
    """Path relative to ``folder``, or absolute if they share only the root."""
    top = os.path.commonpath([path, folder.resolve()])
    return str(path) if top == os.sep else os.path.relpath(path, folder.resolve())


Outcome = Literal["kept", "changed", "ignored", "unknown"]
_COLUMN = 62
"""Column of the right half of the table."""
_WIDEST_VALUE = 26


@dataclass(frozen=True)
class KeyRow:
    """One key of Ark's files and what became of it."""

    node: ArkNode
    outcome: Outcome
    target: str
    """The rig's key that it became; empty if there is none."""
    note: str
    """What changed, or why it is ignored."""

    @property
    def here(self) -> str:
        """Target and note, for the table."""
        return "; ".join(part for part in (self.target, self.note) if part)


class KeyReport:
    """Collects a row for every key during an import."""

    def __init__(self) -> None:
        self._rows: list[KeyRow] = []
        self._seen: set[int] = set()

    def kept(self, node: ArkNode | None, target: str, note: str = "") -> None:
        """Note that the rig's key ``target`` has the same meaning and value."""
        self._add(node, "kept", target, note)

    def changed(self, node: ArkNode | None, target: str, note: str) -> None:
        """Note that the value changed, in ``target`` or in what the note describes."""
        self._add(node, "changed", target, note)

    def ignored(self, node: ArkNode | None, why: str) -> None:
        """Note that the key has no meaning here, and why."""
        self._add(node, "ignored", "", why)

    def _add(self, node: ArkNode | None, outcome: Outcome, target: str, note: str) -> None:
        if node is not None and id(node) not in self._seen:
            self._seen.add(id(node))
            self._rows.append(KeyRow(node, outcome, target, note))

    def close(self, files: Iterable[ArkNode]) -> tuple[KeyRow, ...]:
        """Return all rows in the order of ``files``, including those of unknown and empty keys."""
        order: dict[Path, int] = {}
        for root in files:
            order[root.file] = len(order)
            for node in self._find_unseen(root):
                if node.data in (None, {}, []):
                    self.ignored(node, "is empty")
                else:
                    self._add(node, "unknown", "", "nothing here reads it")
        return tuple(sorted(self._rows, key=lambda row: (order.get(row.node.file, 0), row.node.line)))

    def _find_unseen(self, node: ArkNode) -> Iterator[ArkNode]:
        if id(node) in self._seen:
            return
        if not node.children:
            if node.key:
                yield node
            return
        for child in node.children.values():
            yield from self._find_unseen(child)

    def origin(self, key: str) -> ArkNode | None:
        """Return Ark's key that a key of the rig came from; else the first one that a key below it came from."""
        above = [row for row in self._rows if row.target and f"{key}.".startswith(f"{row.target}.")]
        if above:
            return max(above, key=lambda row: len(row.target)).node
        return next((row.node for row in self._rows if row.target.startswith(f"{key}.")), None)


def table(rows: Iterable[KeyRow], folder: Path, width: int = 120) -> list[str]:
    """Return the rows as a table, file by file: line, outcome, key and value, and target with note.

    Args:
        rows: From :meth:`KeyReport.close`.
        folder: File names are shown relative to it.
        width: Characters per line.
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


def summary(rows: Iterable[KeyRow]) -> str:
    """Return the number of keys of each outcome, as text."""
    counts = Counter(row.outcome for row in rows)
    parts = [f"{counts[outcome]} {outcome}" for outcome in get_args(Outcome) if counts[outcome]]
    return f"{sum(counts.values())} keys: {', '.join(parts)}"


def _value(data: Any) -> str:
    if isinstance(data, dict):
        return "..."
    if isinstance(data, list):
        whole = "[" + ", ".join(str(item) for item in data) + "]"
        return whole if len(whole) <= _WIDEST_VALUE else describe(data)
    text = "true" if data is True else "false" if data is False else "" if data is None else str(data)
    return text if len(text) <= _WIDEST_VALUE else f"...{text[3 - _WIDEST_VALUE :]}"
