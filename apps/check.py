"""Look before a real arm moves: at this computer, at the arm, and at the network between them. Or at gamepads.

python apps/check.py --real --config my_rig.yaml
python apps/check.py --pads
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, TextIO

from hal.apps._common import ACTION_NEEDED, add_config_options, run_app

if TYPE_CHECKING:
    from hal.gamepad import Gamepad
    from hal.preflight import CheckResult
    from hal.specs import PadSpec, Plan
    from hal.types import PadState

__all__ = [
    "main",
    "may_open",
    "parser",
    "show_cameras",
    "show_pads",
]

# [check_cameras.py] Which cameras are plugged in, with what a rig needs to name each of them: ``hal-check
# --cameras``.


def show_cameras() -> bool:
    """Print what every driver finds. False where no camera is plugged in."""
    from hal import registry
    from hal.errors import HalError

    found = False
    for name in registry.names():
        try:
            if registry.driver(name).camera is None:
                continue
            missing = registry.missing(name)
            if missing:
                print(f"{name:12s} its library is not installed: {', '.join(missing.values())}")
                continue
            driver = registry.load(name, "camera")
            if driver.simulated:
                continue
            plugged = driver.plugged()
        except (HalError, OSError) as error:
            print(f"{name:12s} {type(error).__name__}: {error}")
            continue
        for camera in plugged or ("no camera",):
            print(f"{name:12s} {camera}")
        found = found or bool(plugged)
    return found


# [check_pads.py] Which gamepads are plugged in, what they say at the moment, and which may guard a real arm:
# ``hal-check --pads``.

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


BRIEFLY = 0.5
"""s of measuring before a program opens a rig."""
MEASURED = 2.0
"""s of measuring otherwise."""
_SHOWN = {"ok": "ok", "warn": "WARN", "fail": "FAIL", "unknown": "unknown"}


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="check",
        description="Look before a real arm moves: at this computer, at the arm, and at the network between them.",
        epilog="Nothing moves. The exit status is 2 when something fails, else 0.",
    )
    add_config_options(made)
    how_long = f"measure so long ({MEASURED:g}; --pads: until Ctrl-C)"
    made.add_argument("--duration", type=float, metavar="S", help=how_long)
    made.add_argument("--json", action="store_true", help="print the findings as one JSON object")
    made.add_argument(
        "--pads",
        action="store_true",
        help="instead, show every gamepad that is plugged in, what it says, and whether it may guard a real arm; with "
        "--config or --set, the pads of that rig. The exit status is 2 when there was none",
    )
    made.add_argument(
        "--cameras",
        action="store_true",
        help="instead, list the cameras that are plugged in, with their serial numbers. The exit status is 2 when "
        "there is none",
    )
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    from hal.config import load
    from hal.errors import CommandError
    from hal.preflight import checked_cameras, preflight, real_arms

    if args.pads:
        return _pads(args)
    if args.cameras:
        # FOLD: import dropped

        return 0 if show_cameras() else ACTION_NEEDED
    duration = MEASURED if args.duration is None else args.duration
    if not 0.0 < duration <= 60.0:
        raise CommandError(f"--duration must be above 0 and at most 60, not {duration:g}")
    plan = load(args.config, sim=args.sim, overrides=args.overrides).resolve()
    verdicts = preflight(plan, duration)
    if args.json:
        found = list(verdicts)
        print(json.dumps({"rig": plan.source, "fit": _fit(found), "verdicts": [asdict(v) for v in found]}, indent=2))
    else:
        found = _shown(verdicts)
        if not real_arms(plan) and not checked_cameras(plan):
            print(f"nothing in {plan.source} has a check of its own: only this computer was looked at")
    return 0 if _fit(found) else ACTION_NEEDED


def _pads(args: argparse.Namespace) -> int:
    # FOLD: import dropped
    from hal.config import load
    from hal.errors import CommandError

    if args.json:
        raise CommandError("--json is not for --pads, which goes on until Ctrl-C")
    if args.duration is not None and not args.duration > 0.0:
        raise CommandError(f"--duration must be positive, not {args.duration:g}")
    of_a_rig = args.overrides or args.config != parser().get_default("config")
    pads = load(args.config, sim=args.sim, overrides=args.overrides).resolve().pads if of_a_rig else ()
    return 0 if show_pads(pads, args.duration) else ACTION_NEEDED


def may_open(plan: Plan) -> bool:
    """The same, briefly and in print, for a program that is about to open a rig. True at once without a real arm."""
    from hal.preflight import preflight, real_arms

    arms = real_arms(plan)
    emulated = all(robot.emulated for robot in arms)  # a rehearsal does not depend on how fit this computer is
    return not arms or _fit(_shown(preflight(plan, BRIEFLY, machine=not emulated, cameras=False)))


def _fit(verdicts: Sequence[CheckResult]) -> bool:
    return all(verdict.level != "fail" for verdict in verdicts)


def _shown(verdicts: Iterable[CheckResult]) -> list[CheckResult]:
    """Print each as soon as it is known, and below it what to do, once where it is the same for several."""
    found = []
    remedies = set()
    for verdict in verdicts:
        found.append(verdict)
        print(f"{_SHOWN[verdict.level]:10s}{verdict.name:16s} {verdict.found}")
        if verdict.level != "ok" and verdict.remedy and verdict.remedy not in remedies:
            remedies.add(verdict.remedy)
            print(f"{_INDENT}-> {verdict.remedy}")
        sys.stdout.flush()
    return found


if __name__ == "__main__":
    sys.exit(main())
