"""Which gamepads are plugged in, what they say at the moment, and which may guard a real arm: ``hal-check --pads``."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from hal.gamepad import Gamepad
    from hal.specs import PadSpec
    from hal.types import PadState

__all__ = ["show_pads"]

_RATE = 50.0  # Hz; a pad is looked at so often
_DRAWN = 0.1  # s between two pictures on a terminal
_LOOK = 1.0  # s between two looks at what is plugged in
_STEP = 0.05
"""Where lines are printed, an axis must have moved so far for another one."""
_LINES = 12
"""Of a terminal that says nothing of its height, less than it surely has."""
_INDENT = " " * 10
_REAL = ("auto", "evdev")


def show_pads(specs: Sequence[PadSpec], duration: float | None) -> bool:
    """Show every pad for ``duration`` s, or until Ctrl-C; False where none that may be read was there.

    ``specs`` are the pads of a rig, which choose by their options; where there are none, all that are plugged in.
    """
    with _Pads(specs) as pads:
        screen = _Screen(sys.stdout)
        end = time.monotonic() + duration if duration is not None else None
        for text in pads.start():
            screen.tell(text)
        try:
            while end is None or time.monotonic() < end:
                for text in pads.look():
                    screen.tell(text)
                screen.show(pads.open)
                time.sleep(1.0 / _RATE)
        except KeyboardInterrupt:
            pass
        screen.end()
        return pads.found


class _Pads:
    """The pads that are looked at: all that are plugged in, or a rig's. They come and go."""

    def __init__(self, specs: Sequence[PadSpec]) -> None:
        from hal import registry

        self._driver = registry.load("evdev", "gamepad")
        self._specs = [replace(spec, driver="evdev") for spec in specs if spec.driver in _REAL]
        self._skipped = [spec for spec in specs if spec.driver not in _REAL]
        self._notes: set[str] = set()
        self._described: dict[str, str] = {}
        self._next = 0.0
        self.open: dict[str, Gamepad] = {}
        """By the rig's name, or by the device."""
        self.found = False

    def __enter__(self) -> _Pads:
        return self

    def __exit__(self, *_: object) -> None:
        for pad in self.open.values():
            pad.close()

    def start(self) -> Iterator[str]:
        """Open what is there, and say what a person should know before anything else."""
        for spec in self._skipped:
            yield f"{spec.name}: driver {spec.driver}, which is no pad that is plugged in"
        for spec in self._specs:
            self._open(spec.name, spec)
        yield from self.look()
        if not any(pad.state().connected for pad in self.open.values()):
            yield "no gamepad is plugged in that may be read; plug one in at any time, Ctrl-C ends"

    def look(self) -> Iterator[str]:
        """Poll every pad; in words, what came, went or stands in the way since the last call."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _LOOK
            yield from self._plugged()
        for name, pad in list(self.open.items()):
            pad.poll_once(now)
            yield from self._news(name, pad)

    def _plugged(self) -> Iterator[str]:
        found = self._driver.plugged()
        for note in found.notes:
            if note not in self._notes:
                self._notes.add(note)
                yield note
        if self._specs or self._skipped:
            return
        for device in found.devices:
            if device not in self.open:
                self._open(device, _any_pad(device))

    def _open(self, name: str, spec: PadSpec) -> None:
        from hal.gamepad import Gamepad

        pad = self.open[name] = Gamepad(self._driver(spec))
        pad.open(time.monotonic())

    def _news(self, name: str, pad: Gamepad) -> Iterator[str]:
        before, now = self._described.get(name, ""), _about(pad)
        if now != before:
            self._described[name] = now
            yield now or f"{name} is gone"
        if now:
            self.found = True
            self._notes.update(pad.notes)
        elif not self._specs:
            pad.close()
            del self.open[name], self._described[name]
        else:
            for note in pad.notes:
                if note not in self._notes:
                    self._notes.add(note)
                    yield note


def _any_pad(device: str) -> PadSpec:
    from hal.config.files import Problems
    from hal.config.models import load_pad_models
    from hal.specs import PadSpec

    models = tuple(load_pad_models(Problems()).values())
    return PadSpec("pad", "evdev", None, models, options={"device": device})


def _about(pad: Gamepad) -> str:
    """A pad in some lines; nothing where it is not there."""
    if not pad.state().connected:
        return ""
    lines = [pad.describe()]
    lines += [f"{_INDENT}{what:14s} {text}" for what, text in pad.driver.details().items()]
    lines.append(f"{_INDENT}{'mapping':14s} {pad.mapping or 'default'}")
    lines.append(f"{_INDENT}{'real arm':14s} {pad.distrust() or 'it may be the dead-man'}")
    return "\n".join([*lines, *pad.notes])


class _Screen:
    """On a terminal one block that is drawn again and again; elsewhere a line for every change."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._live = stream.isatty()
        self._next = 0.0
        self._drawn = 0
        self._told: dict[str, _Shown] = {}

    def tell(self, text: str) -> None:
        """Print what stays."""
        self._clear()
        self._write(text + "\n")

    def show(self, pads: Mapping[str, Gamepad]) -> None:
        """The values of all pads."""
        if not self._live:
            for name, pad in pads.items():
                self._tell_changes(name, pad)
        elif time.monotonic() >= self._next:
            self._next = time.monotonic() + _DRAWN
            size = shutil.get_terminal_size((80, _LINES))
            lines = [line for name, pad in pads.items() for line in _block(name, pad)]
            self._clear()
            shown = [line[: size.columns - 1] for line in lines[: size.lines - 1]]
            self._write("".join(f"{line}\n" for line in shown))
            self._drawn = len(shown)

    def end(self) -> None:
        """Leave the last values on the screen."""
        self._drawn = 0

    def _tell_changes(self, name: str, pad: Gamepad) -> None:
        now, before = _Shown(pad.state(), pad.waiting_for), self._told.get(name)
        if before is None or now.differs(before):
            self._told[name] = now
            self._write(f"{name}: {now}\n")

    def _clear(self) -> None:
        if self._drawn:
            self._write(f"\x1b[{self._drawn}A\x1b[J")
            self._drawn = 0

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class _Shown:
    """What was last said of a pad."""

    def __init__(self, state: PadState, waiting_for: tuple[str, ...]) -> None:
        self.axes = dict(state.axes)
        self.buttons = state.buttons
        self.connected = state.connected
        self.waiting_for = waiting_for

    def differs(self, other: _Shown) -> bool:
        """Enough for another line?"""
        if (self.buttons, self.connected, self.waiting_for) != (other.buttons, other.connected, other.waiting_for):
            return True
        moved = (abs(value - other.axes.get(name, 0.0)) for name, value in self.axes.items())
        ended = any((value == 0.0) != (other.axes.get(name, 0.0) == 0.0) for name, value in self.axes.items())
        return ended or max(moved, default=0.0) >= _STEP

    def __str__(self) -> str:
        if not self.connected:
            return "not plugged in"
        parts = [f"{name} {value:+.2f}" for name, value in self.axes.items() if value]
        if self.buttons:
            parts.append(f"[{' '.join(sorted(self.buttons))}]")
        if self.waiting_for:
            parts.append(f"let go of, or move once: {', '.join(self.waiting_for)}")
        return "  ".join(parts) or "at rest"


def _block(name: str, pad: Gamepad) -> list[str]:
    """The values of one pad as lines of a picture."""
    shown = _Shown(pad.state(), pad.waiting_for)
    if not shown.connected:
        return [f"{name}: not plugged in"]
    lines = [f"{name}:"]
    reported = [(axis, value) for axis, value in shown.axes.items() if axis in pad.reported]
    bars = [f"{axis:8s} {value:+5.2f} {_bar(value)}" for axis, value in reported]
    lines += ["  " + "   ".join(bars[at : at + 2]) for at in range(0, len(bars), 2)]
    lines.append(f"  pressed  {' '.join(sorted(shown.buttons)) or '-'}")
    if shown.waiting_for:
        lines.append(f"  let go of, or move once: {', '.join(shown.waiting_for)}")
    return lines


def _bar(value: float) -> str:
    """-1..1 as a bar from the middle."""
    half = 8
    filled = round(abs(value) * half)
    left = ("#" * filled if value < 0.0 else "").rjust(half)
    right = ("#" * filled if value > 0.0 else "").ljust(half)
    return f"[{left}|{right}]"
