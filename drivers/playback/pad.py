"""A gamepad that plays a recording, and the file format of recordings.

A recording is text with one JSON object per line, a header and then events::

    {"format": "hal-pad-events", "version": 1, "model": "dualshock4", "ranges": {"ABS_X": [0, 255, 15]}}
    {"t": 0.25, "type": "abs", "code": "ABS_X", "value": 140}
    {"t": 0.30, "type": "key", "code": "BTN_SOUTH", "value": 1}

``model`` is the name of a pad model, or a whole model for a pad that has none. ``ranges`` are the minimum, the maximum
and, optionally, the flat of each axis, as the pad reported them. ``about`` (optional) tells where the recording comes
from. Events are in the order of their times, in seconds from the start.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hal.config.files import check_record
from hal.driver import GamepadDriver, PadReading
from hal.errors import ConfigError, ConnectionLost, Problem
from hal.pads.codes import ABS, ABS_NAME, EV_ABS, EV_KEY, KEY, KEY_NAME
from hal.pads.mapper import AxisRange, PadMapper
from hal.pads.model import PadModel, pad_model
from hal.specs import PadSpec

Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

_WORLD_POLL = 0.002
"""Shortest time between two polls while the recording waits for the simulated world, s."""


class PlaybackOptions(BaseModel):
    """Options of a recorded pad in a rig (``gamepads.<name>.options``). Times are in seconds from the first poll."""

    model_config = ConfigDict(extra="forbid")

    file: Path
    """The recording."""
    loop: bool = False
    """Repeat the recording, with all controls released in between."""
    freeze_at: Seconds | None = None
    """From then on the pad is silent but connected: controls stay as they are, and ``t_alive`` stops."""
    disconnect_at: Seconds | None = None
    """When the pad is unplugged."""
    reconnect_at: Seconds | None = None
    """When it is plugged in again, with the controls as recorded for that time."""


class PlaybackPad(GamepadDriver):
    """Plays ``options.file`` from the first poll on. After the end the pad is released, connected and alive.

    ``source`` returns the time of the simulated world, s; None where that is the clock's. A world that is slower than
    the clock would see a button pressed for a shorter time, so the recording waits for it: its effect on an arm is the
    same, however busy the computer is.

    A recording is never accepted as the dead-man of a real arm.
    """

    simulated: ClassVar[bool] = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        """Check the options; raises ConfigError."""
        super().__init__(spec, source)
        self._world = cast("Callable[[], float] | None", source)
        self._lead = 0.0
        """World's time minus the clock's at the first poll, s."""
        self._behind = 0.0
        """How far the world has fallen behind the clock since then, s."""
        self._options = check_record(PlaybackOptions, spec.options, f"gamepads.{spec.name}")
        self._recording = PadRecording("", {}, ())
        self._mapper: PadMapper | None = None
        self._t0: float | None = None
        self._next = 0
        self._round = 0
        self._played = 0
        self._t_event = self._t_device = 0.0
        self._last: PadReading | None = None

    def open(self) -> None:
        """Read the recording. Raises ConfigError, which names the first bad line."""
        self._recording = load_recording(self._options.file)
        self._mapper = PadMapper(self._find_model(), self._recording.ranges)
        self.flat, self.absolute = self._mapper.flat, self._mapper.model.absolute
        self._t0 = None
        self._next = self._round = 0
        self._behind = 0.0
        self._mapper.release()

    def _find_model(self) -> PadModel:
        file, wanted = str(self._options.file), self._recording.model
        if not isinstance(wanted, str):
            return pad_model(wanted, f"{file}, line 1: model")
        known: list[dict[str, Any]] = [*self.spec.models, *([self.spec.model] if self.spec.model else [])]
        for data in known:
            if data.get("name") == wanted:
                return pad_model(data, f"model {wanted}")
        names = ", ".join(str(data.get("name")) for data in known)
        message = f"unknown pad model {wanted!r}; models: {names or 'none'}"
        raise ConfigError([Problem(file, "line 1", message, code="unknown_model")])

    def poll(self, now: float, timeout: float) -> PadReading:
        mapper = self._mapper
        if mapper is None:
            raise ConnectionLost(f"the recording {self._options.file.name} is not open", code="not_open")
        if self._t0 is None:
            self._t0 = self._t_event = now
            self._lead = self._world() - now if self._world is not None else 0.0
        played = self._find_played_time(now)
        if timeout > 0.0:
            begun = time.monotonic()
            wait = timeout if self._frozen(played) else min(timeout, self._time_to_next(played))
            if wait > 0.0:
                time.sleep(wait)
            now += time.monotonic() - begun
            played = self._find_played_time(now)
        if self._frozen(played) and self._last is not None:
            return self._last
        self._feed_due_events(mapper, played)
        connected = self._is_connected(played)
        last_alive = self._last.t_alive if self._last is not None else -math.inf
        self._last = PadReading(
            t=self._t_event,
            t_alive=now if connected else last_alive,
            t_device=self._t_device,
            seq=self._played,
            axes=MappingProxyType(dict(mapper.axes if connected else dict.fromkeys(mapper.axes, 0.0))),
            buttons=mapper.buttons if connected else frozenset(),
            connected=connected,
        )
        return self._last

    def _find_played_time(self, now: float) -> float:
        """Return the time up to which the recording is due: the clock's, less the delay of the world, s."""
        if self._world is not None:
            self._behind = max(self._behind, now + self._lead - self._world())
        return now - self._behind

    def _time_to_next(self, played: float) -> float:
        rest = self._next_due() - played
        return rest if self._world is None else max(rest, _WORLD_POLL)

    def _next_due(self) -> float:
        """Return when the next event is due, on the clock less the delay of the world, s."""
        assert self._t0 is not None
        events = self._recording.events
        start = self._t0 + self._round * self._recording.duration
        return start + events[self._next].t if self._next < len(events) else math.inf

    def _feed_due_events(self, mapper: PadMapper, played: float) -> None:
        assert self._t0 is not None
        events = self._recording.events
        while (due := self._next_due()) <= played:
            event = events[self._next]
            mapper.feed(event.kind, event.code, event.value)
            self._next += 1
            self._played += 1
            self._t_event, self._t_device = due + self._behind, due - self._t0
            if self._next == len(events):
                mapper.release()
                if self._options.loop and self._recording.duration > 0.0:
                    self._round += 1
                    self._next = 0

    def _frozen(self, played: float) -> bool:
        at = self._options.freeze_at
        return at is not None and self._t0 is not None and played - self._t0 >= at

    def _is_connected(self, played: float) -> bool:
        off, on = self._options.disconnect_at, self._options.reconnect_at
        if off is None or self._t0 is None or played - self._t0 < off:
            return True
        return on is not None and played - self._t0 >= max(on, off)

    @property
    def finished(self) -> bool:
        """Whether the recording has ended; never where it loops."""
        return self._mapper is not None and not self._options.loop and self._next >= len(self._recording.events)

    @property
    def control_names(self) -> Mapping[str, str]:
        return self._mapper.model.control_names if self._mapper is not None else {}

    def describe(self) -> str:
        return f"replaying {self._options.file.name}"

    def close(self) -> None:
        """Close the recording. Idempotent."""
        self._mapper = None


def check(spec: PadSpec) -> Iterator[tuple[str, str, str]]:
    """Yield (key in the pad's entry of the rig, message, code) for each problem of a recorded pad."""
    try:
        PlaybackPad(spec).open()  # reads the recording; there is no device
    except ConfigError as error:
        for problem in error.problems:
            if problem.file == f"gamepads.{spec.name}":
                yield f"options.{problem.key}", problem.message, problem.code
            else:
                yield "file", ": ".join(filter(None, [problem.file, problem.key, problem.message])), problem.code


# The file format.

_EVENT_TYPES = {"abs": (EV_ABS, ABS), "key": (EV_KEY, KEY)}


class RecordedEvent(NamedTuple):
    """One event, in the kernel's numbers."""

    t: float
    """Seconds from the start."""
    kind: int
    code: int
    value: int


class PadRecording(NamedTuple):
    """The content of a recording."""

    model: str | Mapping[str, Any]
    """Name of a pad model, or the model itself."""
    ranges: Mapping[int, AxisRange]
    """Axis code -> range that the pad reported."""
    events: Sequence[RecordedEvent]
    about: str = ""

    @property
    def duration(self) -> float:
        """Time of the last event, s."""
        return self.events[-1].t if self.events else 0.0


def dump_recording(recording: PadRecording) -> str:
    """Return the text of a recording's file."""
    header: dict[str, Any] = {"format": "hal-pad-events", "version": 1, "model": recording.model}
    header["ranges"] = {ABS_NAME[code]: [*span] for code, span in recording.ranges.items()}
    if recording.about:
        header["about"] = recording.about
    lines = [json.dumps(header)]
    for event in recording.events:
        kind, code = ("abs", ABS_NAME[event.code]) if event.kind == EV_ABS else ("key", KEY_NAME[event.code])
        lines.append(json.dumps({"t": round(event.t, 6), "type": kind, "code": code, "value": event.value}))
    return "\n".join(lines) + "\n"


class _Header(BaseModel):
    """The first line of a file."""

    model_config = ConfigDict(strict=True)

    format: Literal["hal-pad-events"]
    version: Literal[1]
    model: str | dict[str, Any]
    ranges: dict[str, Annotated[list[int], Field(min_length=2, max_length=3)]]
    about: str = ""


class _Event(BaseModel):
    """A further line."""

    model_config = ConfigDict(strict=True)

    t: Seconds
    type: Literal["abs", "key"]
    code: str
    value: int


def load_recording(path: Path) -> PadRecording:
    """Read a recording.

    Raises:
        ConfigError: The file cannot be read, or a line of it is wrong; names the first one.
    """
    number = 1
    try:
        lines = [(k, line) for k, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1) if line.strip()]
        header = _Header.model_validate_json(lines[0][1] if lines else "")
        ranges = {_find_code("abs", name): _read_range(name, span) for name, span in header.ranges.items()}
        events: list[RecordedEvent] = []
        for number, line in lines[1:]:  # noqa: B007  # an error names it
            events.append(_read_event(line, ranges, events[-1].t if events else 0.0))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([Problem(str(path), "", f"cannot be read: {error}", code="unreadable")]) from None
    except ValueError as error:
        raise ConfigError([Problem(str(path), f"line {number}", _explain(error), "bad_recording")]) from None
    return PadRecording(header.model, ranges, events, header.about)


def _read_event(line: str, ranges: Mapping[int, AxisRange], latest: float) -> RecordedEvent:
    event = _Event.model_validate_json(line)
    code = _find_code(event.type, event.code)
    if event.t < latest:
        raise ValueError(f"goes back in time, from {latest:g} s to {event.t:g} s")
    if event.type == "abs" and ranges and code not in ranges:
        raise ValueError(f"{event.code} has no range in the header")
    return RecordedEvent(event.t, _EVENT_TYPES[event.type][0], code, event.value)


def _find_code(kind: str, name: str) -> int:
    codes = _EVENT_TYPES[kind][1]
    if name not in codes:
        raise ValueError(f"{name!r} is not an event code of type {kind}")
    return codes[name]


def _read_range(name: str, span: Sequence[int]) -> AxisRange:
    if span[0] >= span[1]:
        raise ValueError(f"ranges: {name} must be [minimum, maximum] or [minimum, maximum, flat]")
    return AxisRange(*span)


def _explain(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors(include_url=False, include_input=False)[0]
    return ": ".join([*map(str, first["loc"]), first["msg"]])
