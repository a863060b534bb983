"""The file format of a pad's recording: one JSON object per line.

    {"format": "hal-pad-events", "version": 1, "model": "dualshock4", "ranges": {"ABS_X": [0, 255, 15]}}
    {"t": 0.25, "type": "abs", "code": "ABS_X", "value": 140}
    {"t": 0.30, "type": "key", "code": "BTN_SOUTH", "value": 1}

The header names the pad's model (or holds one, for a pad that no model knows) and, per axis, what the pad said of it:
minimum, maximum and, where it says so, flat. ``about`` says where the recording comes from. Events are in the order of
their times, in seconds from the start.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hal.errors import ConfigError, Problem
from hal.pads.codes import ABS, ABS_NAME, EV_ABS, EV_KEY, KEY, KEY_NAME
from hal.pads.mapper import AxisRange

__all__ = ["RecordedEvent", "Recording", "dump", "load"]

FORMAT, VERSION = "hal-pad-events", 1
_KINDS = {"abs": (EV_ABS, ABS), "key": (EV_KEY, KEY)}


class RecordedEvent(NamedTuple):
    """One event, in the kernel's numbers."""

    t: float
    """Seconds from the start."""
    kind: int
    code: int
    value: int


class Recording(NamedTuple):
    """A whole file."""

    model: str | Mapping[str, Any]
    """Name of a pad model, or the model itself."""
    ranges: Mapping[int, AxisRange]
    """Axis code -> what the pad said about it."""
    events: Sequence[RecordedEvent]
    about: str = ""

    @property
    def duration(self) -> float:
        """Time of the last event, s."""
        return self.events[-1].t if self.events else 0.0


def dump(recording: Recording) -> str:
    """The file's text."""
    header: dict[str, Any] = {"format": FORMAT, "version": VERSION, "model": recording.model}
    header["ranges"] = {ABS_NAME[code]: [*span] for code, span in recording.ranges.items()}
    if recording.about:
        header["about"] = recording.about
    lines = [json.dumps(header)]
    for event in recording.events:
        kind, code = ("abs", ABS_NAME[event.code]) if event.kind == EV_ABS else ("key", KEY_NAME[event.code])
        lines.append(json.dumps({"t": round(event.t, 6), "type": kind, "code": code, "value": event.value}))
    return "\n".join(lines) + "\n"


def load(path: Path) -> Recording:
    """Read a file. Raises ConfigError, which lists every bad line with its number."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError([Problem(str(path), "", f"cannot be read: {error.strerror}")]) from None
    except UnicodeDecodeError:
        raise ConfigError([Problem(str(path), "", "is no text file; a pad's recording is JSON lines")]) from None
    reader = _Reader(str(path))
    recording = reader.read(text.splitlines())
    if reader.problems:
        raise ConfigError(reader.problems)
    return recording


class _Reader:
    """Collects every problem instead of stopping at the first."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.problems: list[Problem] = []

    def complain(self, line: int, message: str) -> None:
        self.problems.append(Problem(self.file, f"line {line}", message))

    def read(self, lines: Sequence[str]) -> Recording:
        objects = [
            (number, found)
            for number, line in enumerate(lines, 1)
            if line.strip() and (found := self._parse(number, line)) is not None
        ]
        if not objects:
            if not self.problems:
                self.complain(1, "the file is empty; its first line is a header")
            return Recording("", {}, ())
        if objects[0][0] != 1 and any(problem.key == "line 1" for problem in self.problems):
            return Recording("", {}, ())  # the header itself does not parse: what follows has no meaning
        model, ranges, about = self._header(*objects[0])
        return Recording(model, ranges, tuple(self._events(objects[1:], ranges)), about)

    def _parse(self, number: int, line: str) -> dict[str, Any] | None:
        try:
            found = json.loads(line)
        except json.JSONDecodeError as error:
            self.complain(number, f"is not JSON: {error.msg} at column {error.colno}")
            return None
        if not isinstance(found, dict):
            self.complain(number, "must be an object in braces")
            return None
        return found

    def _header(self, number: int, header: dict[str, Any]) -> tuple[str | dict[str, Any], dict[int, AxisRange], str]:
        if header.get("format") != FORMAT:
            self.complain(number, f'the first line must be a header with "format": "{FORMAT}"')
        elif header.get("version") != VERSION:
            self.complain(number, f"version {header.get('version')!r} is unknown; this program reads version {VERSION}")
        model = header.get("model")
        if not isinstance(model, (str, dict)):
            self.complain(number, '"model" must be the name of a pad model, or a model')
            model = ""
        ranges: dict[int, AxisRange] = {}
        given = header.get("ranges")
        for name, span in given.items() if isinstance(given, dict) else ():
            whole = isinstance(span, list) and len(span) in (2, 3) and all(type(item) is int for item in span)
            if name not in ABS:
                self.complain(number, f"ranges: {name!r} is no axis' event code")
            elif not whole or span[0] >= span[1]:
                self.complain(number, f"ranges: {name} must be [minimum, maximum] or [minimum, maximum, flat]")
            else:
                ranges[ABS[name]] = AxisRange(*span)
        if not isinstance(given, dict):
            self.complain(number, '"ranges" must say what the axes\' numbers mean: {"ABS_X": [0, 255], ...}')
        return model, ranges, str(header.get("about", ""))

    def _events(
        self, objects: Iterable[tuple[int, dict[str, Any]]], ranges: Mapping[int, AxisRange]
    ) -> Iterable[RecordedEvent]:
        latest = 0.0
        for number, found in objects:
            t, value = found.get("t"), found.get("value")
            kind, name = str(found.get("type")), str(found.get("code"))
            if not isinstance(t, (int, float)) or isinstance(t, bool) or not math.isfinite(t) or t < 0.0:
                self.complain(number, f'"t" must be seconds from the start, not {t!r}')
            elif kind not in _KINDS:
                self.complain(number, f'"type" must be "abs" or "key", not {kind!r}')
            elif name not in _KINDS[kind][1]:
                self.complain(number, f'"code" {name!r} is no event code of type {kind}')
            elif type(value) is not int:
                self.complain(number, f'"value" must be a whole number, not {value!r}')
            elif t < latest:
                self.complain(number, f"goes back in time, from {latest:g} s to {t:g} s")
            elif kind == "abs" and ranges and ABS[name] not in ranges:
                self.complain(number, f"{name} has no range in the header")
            else:
                latest = t
                event_type, codes = _KINDS[kind]
                yield RecordedEvent(float(t), event_type, codes[name], value)
