"""The answer, in the rig's file: one entry is replaced, every other byte of the file stays what it is."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import yaml

from ..config.files import parse_yaml
from ..errors import CommandError

__all__ = ["PLACES", "backup", "replaced", "write"]

PLACES = ("look_at", "pose", "attached")
"""Where a camera of a rig may be said to be; it has at most one of them."""


def replaced(text: str, camera: str, key: str, value: str) -> str:
    """The text of a rig's file in which ``camera`` has ``key: value`` in the place of whichever of :data:`PLACES`.

    Comments beside the old entry stay, those inside of it go with it. CommandError, with what to write by hand, where
    the file is written in a way that cannot be changed at one place (anchors, merged keys).
    """
    entry = f"{key}: {value}"
    by_hand = f"write this into cameras.{camera} yourself, in the place of {', '.join(PLACES)}:\n  {entry}"
    try:
        changed = _edited(text, camera, entry)
        fits = parse_yaml(changed) == _expected(parse_yaml(text), camera, key, value)
    except (yaml.YAMLError, LookupError, TypeError) as error:
        raise CommandError(f"the file cannot be changed ({error}); {by_hand}") from None
    if not fits:
        raise CommandError(f"this file shares keys between entries (& * <<), so it is not changed; {by_hand}")
    return changed


def write(path: Path, text: str) -> None:
    """Put ``text`` into the file at ``path``, whole or not at all; whose file it was, and its rights, stay."""
    path = path.resolve()  # of a link, the file behind it
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, temporary)
        else:
            os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def backup(path: Path) -> Path:
    """A copy of the file beside it, under a name that was free: ``rig.yaml.bak``, ``rig.yaml.bak2``, ..."""
    number = 1
    while True:
        copy = path.with_name(f"{path.name}.bak{number if number > 1 else ''}")
        try:
            with copy.open("xb") as file:
                file.write(path.read_bytes())
        except FileExistsError:
            number += 1
            continue
        return copy


def _expected(data: Any, camera: str, key: str, value: str) -> Any:
    """The file's data after the change."""
    entries = {name: item for name, item in data["cameras"][camera].items() if name not in PLACES}
    entries[key] = parse_yaml(value)
    return {**data, "cameras": {**data["cameras"], camera: entries}}


def _edited(text: str, camera: str, entry: str) -> str:
    """Raises LookupError and TypeError where the file has another shape than expected."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)  # the one in Python: it counts characters
    settings = _value(_value(root, "cameras"), camera)
    if not isinstance(settings, yaml.MappingNode) or not settings.value:
        raise LookupError(f"cameras.{camera} holds no keys")
    places = [name.value for name, _ in settings.value if name.value in PLACES]
    if len(places) > 1:
        raise LookupError(f"cameras.{camera} says {len(places)} times where the camera is: {', '.join(places)}")
    for name, value in settings.value:
        if name.value in PLACES:
            start, end = name.start_mark.index, _end(value)
            if not start < end:
                raise LookupError(f"cameras.{camera}.{name.value} is written elsewhere")
            return text[:start] + entry + text[end:]
    name, value = settings.value[-1]
    end = _end(value)
    if settings.flow_style:
        return f"{text[:end]}, {entry}{text[end:]}"
    line_end = text.find("\n", end)
    rest = len(text) if line_end < 0 else line_end
    newline = "\r\n" if text[:rest].endswith("\r") else "\n"
    rest -= len(newline) - 1
    return f"{text[:rest]}{newline}{' ' * name.start_mark.column}{entry}{text[rest:]}"


def _value(node: Any, key: str) -> Any:
    if not isinstance(node, yaml.MappingNode):
        raise LookupError(f"there are no keys where {key!r} should be")
    found = [value for name, value in node.value if name.value == key]
    if len(found) != 1:
        raise LookupError(f"the key {key!r} is there {len(found)} times" if found else f"there is no key {key!r}")
    return found[0]


def _end(node: Any) -> int:
    """Behind a value's last character. A block's own mark lies behind the comments that follow it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)
