"""A pad that plays a recording on the time of what it drives, with faults on request."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, cast

from pydantic import BaseModel, ConfigDict, Field

from hal.driver import GamepadDriver, PadReading
from hal.errors import ConfigError, ConnectionLost, Problem
from hal.pads.mapper import PadMapper
from hal.pads.model import PadModel, pad_model, validated
from hal.specs import PadSpec

from .recording import Recording, load

__all__ = ["PlaybackPad"]

Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

_LOOK = 0.002
"""Shortest time between two looks at a world that the recording waits for, s."""


class Options(BaseModel):
    """What a rig may say under ``options:`` of a recorded pad. Times are seconds from the first poll."""

    model_config = ConfigDict(extra="forbid")

    file: Path
    """The recording; :mod:`.recording` describes the format."""
    loop: bool = False
    """Begin again at the end, with everything released in between."""
    freeze_at: Seconds | None = None
    """From then on the pad says nothing more and stays connected: what is held stays held, ``t_alive`` stops."""
    disconnect_at: Seconds | None = None
    """Then it is unplugged,"""
    reconnect_at: Seconds | None = None
    """and then plugged in again, with whatever the recording holds at that time."""


class PlaybackPad(GamepadDriver):
    """Plays ``options.file`` from the first poll on. After the end the pad is released, connected and alive.

    ``source`` says how far the simulated world has come, s; None where that is what the clock shows. A world that
    cannot keep up with the clock skips steps, and whoever looks at it presses a button for longer. So the recording
    waits for it: what it does to an arm is the same, however busy the computer is.

    Nobody holds a recording, so it never counts as the dead-man of a real arm.
    """

    simulated: ClassVar[bool] = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        """Raises ConfigError for wrong options."""
        super().__init__(spec, source)
        self._world = cast("Callable[[], float] | None", source)
        self._lead = 0.0
        """World's time less the clock's at the first poll, s."""
        self._behind = 0.0
        """By how much the world fell behind the clock since then, s."""
        self._options = validated(Options, spec.options, f"gamepads.{spec.name}")
        self._recording = Recording("", {}, ())
        self._mapper: PadMapper | None = None
        self._t0: float | None = None
        self._next = 0
        self._round = 0
        self._played = 0
        self._t_event = self._t_device = 0.0
        self._last: PadReading | None = None

    def open(self) -> None:
        """Raises ConfigError, which lists every bad line of the file."""
        self._recording = load(self._options.file)
        self._mapper = PadMapper(self._model(), self._recording.ranges)
        self.flat = self._mapper.flat
        self._t0 = None
        self._next = self._round = 0
        self._behind = 0.0
        self._begin()

    def _model(self) -> PadModel:
        file, wanted = str(self._options.file), self._recording.model
        if not isinstance(wanted, str):
            return pad_model(wanted, f"{file}, line 1: model")
        known: list[dict[str, Any]] = [*self.spec.models, *([self.spec.model] if self.spec.model else [])]
        for data in known:
            if data.get("name") == wanted:
                return pad_model(data, f"model {wanted}")
        names = ", ".join(str(data.get("name")) for data in known)
        raise ConfigError([Problem(file, "line 1", f"there is no pad model {wanted!r}; models: {names or 'none'}")])

    def poll(self, now: float, timeout: float) -> PadReading:
        if self._mapper is None:
            raise ConnectionLost(f"the recording {self._options.file.name} is not open")
        if self._t0 is None:
            self._t0 = self._t_event = now
            self._lead = self._world() - now if self._world is not None else 0.0
        played = self._played_by(now)
        if timeout > 0.0:
            now += self._wait(timeout if self._frozen(played) else min(timeout, self._rest(played)))
            played = self._played_by(now)
        if self._frozen(played) and self._last is not None:
            return self._last
        self._play(played)
        connected = self._connected(played)
        last_alive = self._last.t_alive if self._last is not None else -math.inf
        self._last = PadReading(
            t=self._t_event,
            t_alive=now if connected else last_alive,
            t_device=self._t_device,
            seq=self._played,
            axes=MappingProxyType(dict(self._mapper.axes if connected else dict.fromkeys(self._mapper.axes, 0.0))),
            buttons=self._mapper.buttons if connected else frozenset(),
            connected=connected,
        )
        return self._last

    @staticmethod
    def _wait(seconds: float) -> float:
        """Sleep, and say how long it took, s."""
        start = time.monotonic()
        if seconds > 0.0:
            time.sleep(seconds)
        return time.monotonic() - start

    def _played_by(self, now: float) -> float:
        """The time up to which the recording is due: on the rig's clock, less what the world fell behind, s."""
        if self._world is not None:
            self._behind = max(self._behind, now + self._lead - self._world())
        return now - self._behind

    def _rest(self, played: float) -> float:
        """Time to the next event, s."""
        rest = self._due() - played
        return rest if self._world is None else max(rest, _LOOK)

    def _start(self) -> float:
        """When the present round began, on the rig's clock as far as the world has kept up, s."""
        assert self._t0 is not None
        return self._t0 + self._round * self._recording.duration

    def _due(self) -> float:
        """When the next event is due, likewise, s."""
        events = self._recording.events
        return self._start() + events[self._next].t if self._next < len(events) else math.inf

    def _play(self, now: float) -> None:
        """Feed every event that is due."""
        assert self._mapper is not None
        assert self._t0 is not None
        events = self._recording.events
        while (due := self._due()) <= now:
            event = events[self._next]
            self._mapper.feed(event.kind, event.code, event.value)
            self._next += 1
            self._played += 1
            self._t_event, self._t_device = due + self._behind, due - self._t0
            if self._next == len(events):
                self._begin()
                if self._options.loop and self._recording.duration > 0.0:
                    self._round += 1
                    self._next = 0

    def _begin(self) -> None:
        """Everything released, as at the start and after the end."""
        assert self._mapper is not None
        self._mapper.release()

    def _frozen(self, now: float) -> bool:
        at = self._options.freeze_at
        return at is not None and self._t0 is not None and now - self._t0 >= at

    def _connected(self, now: float) -> bool:
        off, on = self._options.disconnect_at, self._options.reconnect_at
        if off is None or self._t0 is None or now - self._t0 < off:
            return True
        return on is not None and now - self._t0 >= max(on, off)

    @property
    def finished(self) -> bool:
        return self._mapper is not None and not self._options.loop and self._next >= len(self._recording.events)

    def describe(self) -> str:
        return f"the recording {self._options.file.name}"

    def close(self) -> None:
        self._mapper = None


def check(spec: PadSpec) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with a recorded pad: (key in the pad's entry of the rig, sentence)."""
    try:
        PlaybackPad(spec).open()  # reads the recording; there is no device
    except ConfigError as error:
        for problem in error.problems:
            if problem.file == f"gamepads.{spec.name}":
                yield f"options.{problem.key}", problem.message
            else:
                yield "file", ": ".join(filter(None, [problem.file, problem.key, problem.message]))
