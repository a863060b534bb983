"""Pre-flight check of this computer, the arm and the network between them; or a list of pads, cameras, CAN adapters; or
the physics of the simulation beside theory.

hal check --real --config my_rig.yaml
hal check --pads
hal check --at arm-pc
hal check --physics --engine mujoco
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING

from hal import registry
from hal.apps._common import ACTION_NEEDED, add_config_options, config_options, program
from hal.apps._display import StatusLine
from hal.errors import CommandError, HalError

if TYPE_CHECKING:
    from hal.gamepad import Gamepad
    from hal.preflight import CheckResult
    from hal.specs import PadSpec, Plan
    from hal.types import PadState

# --cameras: the cameras that are plugged in, with the keys that select each of them in a rig file.


def show_cameras() -> bool:
    """Print the cameras that every driver finds; return whether there are any."""
    found = False
    for name in registry.names():
        try:
            spec = registry.driver(name)
            if spec.camera is None or spec.world is not None:
                continue
            missing = registry.find_missing(name)
            if missing:
                print(f"{name:12s} its library is not installed: {', '.join(missing.values())}")
                continue
            driver = registry.load(name, "camera")
            if driver.simulated:
                continue
            plugged = driver.list_plugged()
        except (HalError, OSError) as error:
            print(f"{name:12s} {type(error).__name__}: {error}")
            continue
        for camera in plugged or ("no camera",):
            print(f"{name:12s} {camera}")
        found = found or bool(plugged)
    return found


# --can: the CAN interfaces and adapters, as a rig file names them.


def show_can() -> bool:
    """Print the CAN interfaces and adapters that the drivers find; return whether there are any."""
    found = failed = False
    drivers: dict[str, list[str]] = {}
    for name in registry.BUILT_IN:
        if (place := registry.driver(name).buses) is not None:
            drivers.setdefault(place, []).append(name)
    for place, names in drivers.items():
        missing = registry.find_missing(names[0])
        if missing:
            print(f"the library of {' and '.join(names)} is not installed: {', '.join(missing.values())}")
            failed = True
            continue
        try:
            lines = registry.function(names[0], place)
            for line in lines() if lines is not None else ():
                print(line)
                found = True
        except (HalError, OSError) as error:
            print(f"{type(error).__name__}: {error}")
            failed = True
    if not found and not failed:
        print("no CAN interface and no adapter; plug one in, and load its driver: sudo modprobe gs_usb")
    return found


# --pads: the gamepads that are plugged in, their present values, and whether each may be the dead-man of a real arm.

_RATE = 50.0
"""Rate at which pads are polled, Hz."""
_SCAN_PERIOD = 1.0
"""s between two searches for plugged-in pads."""
_STEP = 0.05
"""Change of an axis that is printed as a new line when there is no terminal."""
_INDENT = " " * 10
_REAL = ("auto", "evdev")


def show_pads(specs: Sequence[PadSpec], duration: float | None) -> bool:
    """Show these pads, or all that are plugged in, as they come and go; for ``duration`` s, or until Ctrl-C.

    On a terminal one live line has their values, elsewhere each change is a line.

    Returns:
        Whether there was a pad that can be read.
    """
    live, line = sys.stdout.isatty(), StatusLine()
    say = line.event if live else partial(print, flush=True)  # which ends with a pipe that is closed
    printed: dict[str, tuple[PadState, tuple[str, ...]]] = {}
    with _PadMonitor(specs) as pads:
        end = time.monotonic() + duration if duration is not None else None
        for text in pads.start():
            say(text)
        with suppress(KeyboardInterrupt):
            while end is None or time.monotonic() < end:
                for text in pads.poll():
                    say(text)
                line.update(lambda: "   ".join(_describe_values(name, pad) for name, pad in pads.open.items()))
                for name, pad in () if live else pads.open.items():
                    now = pad.state(), pad.waiting_for
                    if name not in printed or now[1] != printed[name][1] or _differ(now[0], printed[name][0]):
                        printed[name] = now
                        say(_describe_values(name, pad))
                time.sleep(1.0 / _RATE)
        line.clear()
        return pads.found


class _PadMonitor:
    """The pads that are shown: all that are plugged in, or those of a rig."""

    def __init__(self, specs: Sequence[PadSpec]) -> None:
        self._driver = registry.load("evdev", "gamepad")
        self._specs = [replace(spec, driver="evdev") for spec in specs if spec.driver in _REAL]
        self._skipped = [spec for spec in specs if spec.driver not in _REAL]
        self._notes: set[str] = set()
        self._described: dict[str, str] = {}
        self._next = 0.0
        self.open: dict[str, Gamepad] = {}
        """Name in the rig, or device -> pad."""
        self.found = False

    def __enter__(self) -> _PadMonitor:
        return self

    def __exit__(self, *_: object) -> None:
        for pad in self.open.values():
            pad.close()

    def start(self) -> Iterator[str]:
        """Open the pads that are plugged in; yield messages for the user."""
        for spec in self._skipped:
            yield f"{spec.name}: driver {spec.driver} is not a plugged-in gamepad"
        for spec in self._specs:
            self._open(spec.name, spec)
        yield from self.poll()
        if not any(pad.state().connected for pad in self.open.values()):
            yield "no gamepad detected; plug one in at any time, Ctrl-C ends"

    def poll(self) -> Iterator[str]:
        """Poll every pad; yield messages about pads that came, went or cannot be read since the last call."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _SCAN_PERIOD
            yield from self._list_plugged()
        for name, pad in list(self.open.items()):
            pad.poll_once(now)
            yield from self._news(name, pad)

    def _list_plugged(self) -> Iterator[str]:
        found = self._driver.list_plugged()
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
            yield now or f"{name}: unplugged"
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
    """Return the description of a pad in some lines; empty if it is not plugged in."""
    if not pad.state().connected:
        return ""
    lines = [pad.describe()]
    lines += [f"{_INDENT}{what:14s} {text}" for what, text in pad.driver.details().items()]
    lines.append(f"{_INDENT}{'mapping':14s} {pad.mapping or 'default'}")
    lines.append(f"{_INDENT}{'real arm':14s} {pad.distrust() or 'may be the dead-man'}")
    return "\n".join([*lines, *pad.notes])


def _differ(now: PadState, before: PadState) -> bool:
    """Whether the difference of two states deserves another line."""
    if (now.buttons, now.connected) != (before.buttons, before.connected):
        return True
    pairs = [(value, before.axes.get(name, 0.0)) for name, value in now.axes.items()]
    return any(abs(new - old) >= _STEP or (new == 0.0) != (old == 0.0) for new, old in pairs)


def _describe_values(name: str, pad: Gamepad) -> str:
    """Return the values of a pad in one line."""
    state = pad.state()
    if not state.connected:
        return f"{name}: not plugged in"
    parts = [f"{name} {value:+.2f}" for name, value in state.axes.items() if value]
    if state.buttons:
        parts.append(f"[{' '.join(sorted(state.buttons))}]")
    if pad.waiting_for:
        parts.append(f"release, or move once: {', '.join(pad.waiting_for)}")
    return f"{name}: {'  '.join(parts) or 'at rest'}"


# --physics: experiments in the simulated world, beside theory.


def check_physics(engine: str, as_json: bool) -> bool:
    """Run the experiments of :mod:`._physics` on an engine and print them; return whether all agree with theory."""
    from ._physics import ALLOWED, run_experiments

    engine = registry.choose_engine(engine)
    registry.check_engine(engine)
    rows, fit = [], True
    if not as_json:
        print(f"{' '.join([engine, *registry.versions(engine).values()])}; at most {100 * ALLOWED:g} % from theory\n")
        print(f"{'':10s}{'':44s}{'theory':>10s}{'measured':>10s}")
    for row in run_experiments(engine):
        good = bool(abs(row.difference) <= ALLOWED)
        fit = fit and good
        rows.append(row._asdict() | {"difference": row.difference, "fit": good})
        if not as_json:
            numbers = f"{row.theory:10.4f}{row.measured:10.4f} {row.unit:7s}{100 * row.difference:+6.2f} %"
            print(f"{_SHOWN['ok' if good else 'fail']:10s}{row.name:44s}{numbers}", flush=True)
    if as_json:
        print(json.dumps({"engine": engine, "fit": fit, "rows": rows}, indent=2))
    return fit


_BRIEF_DURATION = 0.5
"""Duration of the measurements before a program opens a rig, s."""
_DURATION = 2.0
"""Duration of the measurements otherwise, s."""
_SHOWN = {"ok": "ok", "warn": "WARN", "fail": "FAIL", "unknown": "unknown"}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal check",
        description="Pre-flight check of this computer, the arm and the network between them.",
        epilog="Nothing moves. The exit status is 2 if a check fails, else 0.",
    )
    add_config_options(made)
    how_long = f"duration of the measurements ({_DURATION:g}; --pads: until Ctrl-C)"
    made.add_argument("--duration", type=float, metavar="S", help=how_long)
    made.add_argument("--json", action="store_true", help="print the results as one JSON object")
    made.add_argument(
        "--pads",
        action="store_true",
        help="instead, show the plugged-in gamepads, their values, and whether each may be the dead-man of a real arm; "
        "with --config or --set, the pads of that rig. The exit status is 2 if there is none",
    )
    made.add_argument(
        "--cameras",
        action="store_true",
        help="instead, list the plugged-in cameras with their serial numbers. The exit status is 2 if there is none",
    )
    made.add_argument(
        "--can",
        action="store_true",
        help="instead, list the CAN interfaces and adapters, with the command that brings one up. The exit status is 2 "
        "if there is none",
    )
    made.add_argument(
        "--at",
        metavar="ADDRESS[:PORT]",
        help="instead, measure the link to a rig that `hal serve` has: round trips, clocks, and what they allow",
    )
    made.add_argument(
        "--physics",
        action="store_true",
        help="instead, run experiments whose results are known from theory in the simulation (--engine), and print the "
        "differences; it takes some seconds. The exit status is 2 if one is above 3 %%",
    )
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.config import load
    from hal.preflight import list_checked_cameras, list_leaders, list_real_arms, preflight

    if args.pads:
        return _pads(args)
    if args.cameras:
        return 0 if show_cameras() else ACTION_NEEDED
    if args.can:
        return 0 if show_can() else ACTION_NEEDED
    if args.physics:
        return _physics(args)
    duration = _DURATION if args.duration is None else args.duration
    if not 0.0 < duration <= 60.0:
        raise CommandError(f"--duration must be above 0 and at most 60, not {duration:g}")
    if args.at is not None:
        return _link(args.at, duration, args.json)
    plan = load(**config_options(args)).resolve()
    verdicts = preflight(plan, duration)
    if args.json:
        found = list(verdicts)
        print(json.dumps({"rig": plan.source, "fit": _fit(found), "verdicts": [asdict(v) for v in found]}, indent=2))
    else:
        found = _print_results(verdicts)
        if not list_real_arms(plan) and not list_checked_cameras(plan) and not list_leaders(plan):
            print("no device checks for this rig; checked this computer only")
        _name_links(plan)
    return 0 if _fit(found) else ACTION_NEEDED


def _name_links(plan: Plan) -> None:
    """Print how to check the other computers that a rig has devices at."""
    places = [device.at for devices in (plan.robots, plan.cameras, plan.pads) for device in devices]
    for at in dict.fromkeys(place for place in places if place is not None):
        print(f"for the link to {at}: hal check --at {at}; for its devices: hal check on that computer")


def _link(at: str, duration: float, as_json: bool) -> int:
    from hal.remote.client import split_address
    from hal.remote.measure import judge_link, measure_link, plot

    try:
        split_address(at)
    except ValueError:
        raise CommandError(f"--at takes ADDRESS[:PORT], not {at!r}", code="bad_address") from None
    link = measure_link(at, duration)
    if as_json:
        found = list(judge_link(link))
        print(json.dumps({"link": link._asdict(), "verdicts": [asdict(verdict) for verdict in found]}, indent=2))
    else:
        found = _print_results(judge_link(link))
        for line in plot(link.round_trips):
            print(f"{_INDENT}{line}")
    return 0 if _fit(found) else ACTION_NEEDED


def _physics(args: argparse.Namespace) -> int:
    others = [args.overrides, args.sim is False, args.config != parser().get_default("config"), args.duration]
    if any(others):
        raise CommandError("--physics has rigs of its own: it takes --engine and --json, and no other option")
    return 0 if check_physics(args.engine or "auto", args.json) else ACTION_NEEDED


def _pads(args: argparse.Namespace) -> int:
    from hal.config import load

    if args.json:
        raise CommandError("--json cannot be used with --pads, which runs until Ctrl-C")
    if args.duration is not None and not args.duration > 0.0:
        raise CommandError(f"--duration must be positive, not {args.duration:g}")
    of_a_rig = args.overrides or args.config != parser().get_default("config")
    known = load(**config_options(args)).resolve().pads if of_a_rig else ()
    pads = [pad for pad in known if pad.leader is None]
    return 0 if show_pads(pads, args.duration) else ACTION_NEEDED


def may_open(plan: Plan) -> bool:
    """Check a rig briefly before a program opens it, and print the results.

    Returns:
        Whether no check failed; True at once without a real arm.
    """
    from hal.preflight import list_real_arms, preflight

    arms = list_real_arms(plan)
    emulated = all(robot.emulated for robot in arms)  # an emulator does not depend on this computer's timing
    return not arms or _fit(_print_results(preflight(plan, _BRIEF_DURATION, machine=not emulated, cameras=False)))


def _fit(verdicts: Sequence[CheckResult]) -> bool:
    return all(verdict.level != "fail" for verdict in verdicts)


def _print_results(verdicts: Iterable[CheckResult]) -> list[CheckResult]:
    """Print each result as soon as it is known, with its remedy below, which is printed once if several share it."""
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
