"""A rig's entries as YAML that a person can read: short things in one line, and comments beside what changed."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from .places import PACKAGE, PackageFile

__all__ = ["Commented", "Inline", "Remark", "plain", "yaml_text"]

_WIDTH = 110


@dataclass(frozen=True)
class Commented:
    """A value with a comment behind it, or above it where there is no room."""

    value: Any
    comment: str


@dataclass(frozen=True)
class Remark:
    """A comment in the place of an entry; its key is not written."""

    text: str


class Inline(dict[str, Any]):
    """Keys and values in one line."""


def plain(value: Any, folder: Path) -> Any:
    """The same without comments, as it is read back. Paths are relative to ``folder``."""
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
    """The text of a file that lies in ``folder``. What takes several lines at the top has an empty one before it."""
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
        head = [_with_comment(f"{space}{name}:", comment)]
        return head + [line for k, item in value.items() for line in _entry(str(k), item, indent + 2, folder)]
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        lines = [_with_comment(f"{space}{name}:", comment)]
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
    return [_with_comment(line, comment)]


def _bare(value: Any) -> Any:
    return value.value if isinstance(value, Commented) else value


def _with_comment(line: str, comment: str) -> str:
    return f"{line}    # {comment}" if comment else line


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_scalar(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_flow(item) for item in value) + "]"
    return _scalar(value)


def _alone(text: str) -> str:
    """A text that has the rest of its line for itself, and needs fewer quotes."""
    return yaml.safe_dump(text, width=float("inf"), allow_unicode=True).removesuffix("...\n").strip()


def _scalar(value: Any) -> str:
    """One value as YAML writes it inside a line."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value)) if value else "0"
    text = yaml.safe_dump([value], default_flow_style=True, width=float("inf"), allow_unicode=True)
    return text.strip()[1:-1]


def _relative(path: Path, folder: Path) -> str:
    """From ``folder``, unless that leads over the root of the disk."""
    top = os.path.commonpath([path, folder.resolve()])
    return str(path) if top == os.sep else os.path.relpath(path, folder.resolve())
