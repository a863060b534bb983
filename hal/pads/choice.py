"""Which pad drives: what ``model: auto`` comes to, and what a program's ``--pad`` may say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from .. import registry
from ..config.data_files import find_data
from ..config.resolve import NO_WINDOW_KEYBOARD
from ..errors import DeviceNotFound, DriverMissing, NotSupported
from ..specs import PadSpec

__all__ = ["KINDS", "TOUR", "Chosen", "check_wanted", "choose_pad", "in_words", "tour"]

TOUR = ("config", "teleop/tour.jsonl")
"""The recorded tour, among the data files."""
KINDS = ("auto", "evdev", "web", "terminal", "demo", "none")
"""Values of ``--pad``, besides the path of a recording."""
_AUTO = "auto"
_WORDS = {
    "evdev": "a gamepad at the program's computer",
    "terminal": "the terminal of the program",
    "playback": "a recording",
}


class Chosen(NamedTuple):
    """A pad that is going to be opened."""

    spec: PadSpec
    notes: tuple[str, ...] = ()
    """What a person should know."""


def choose_pad(spec: PadSpec, wanted: str | None, *, attended: bool, lock_step: bool, emulated: bool = False) -> Chosen:
    """The pad to open. ``wanted`` is one of :data:`KINDS`, the path of a recording, or None, which means ``auto``.

    It only matters for a pad whose driver is ``auto`` in the rig. ``auto`` is a pad that is plugged in, else the
    console, which anybody with a browser can drive from. In lock-step, where nobody could, it is the recorded tour.
    ``attended``: something real moves; ``emulated``: a program stands in for all of that, so that a recording may drive
    it.

    Raises DeviceNotFound and NotSupported, with what to do instead.
    """
    if spec.driver != _AUTO:
        return Chosen(spec)
    check_wanted(wanted)
    if wanted in (None, _AUTO):
        return _first(spec, attended and not emulated, lock_step)
    if wanted == "evdev":
        pads, notes = _plugged()
        missing = () if pads else ("no gamepad is plugged in yet: plug one in at any time",)
        return Chosen(replace(spec, driver="evdev"), (*notes, *missing))
    if wanted in ("web", "terminal"):
        return Chosen(replace(spec, driver=wanted))
    if attended and not emulated:
        raise NotSupported("a recording cannot hold the dead-man of a real arm; plug a pad in, or use --pad web")
    notes = ("a recording holds the dead-man: what counts as real here is emulated",) if attended else ()
    return Chosen(tour(spec) if wanted == "demo" else _recording(spec, Path(str(wanted))), notes)


def check_wanted(wanted: str | None) -> None:
    """Raise DeviceNotFound or NotSupported when ``wanted`` is neither a kind of pad nor an existing recording."""
    if wanted == "keyboard":
        raise NotSupported(f"--pad keyboard: {NO_WINDOW_KEYBOARD}", code="no_window_keyboard")
    if wanted is not None and wanted not in KINDS and not Path(wanted).is_file():
        kinds = ", ".join(KINDS)
        raise DeviceNotFound(f"there is no pad {wanted!r}: {kinds}, or the path of a recording (.jsonl)")


def in_words(driver: str) -> str:
    """What drives, for people who look on."""
    return _WORDS.get(driver, f"the pad of driver {driver}")


def tour(spec: PadSpec) -> PadSpec:
    """The recorded tour in the place of this pad."""
    return _recording(spec, find_data(*TOUR))


def _first(spec: PadSpec, attended: bool, lock_step: bool) -> Chosen:
    pads, notes = _plugged()
    if pads:
        return Chosen(replace(spec, driver="evdev"), notes)
    if not lock_step:
        return Chosen(replace(spec, driver="web"), notes)
    if attended:
        text = "no gamepad is plugged in, and a real arm does not move without one: plug one in"
        raise DeviceNotFound("; ".join([text, *notes]))
    return Chosen(tour(spec), (*notes, "in lock-step nobody can drive by hand: playing the recorded tour"))


def _plugged() -> tuple[tuple[str, ...], tuple[str, ...]]:
    try:
        found = registry.load("evdev", "gamepad").plugged()
    except (DriverMissing, NotSupported) as error:
        return (), (str(error),)
    return found.pads, found.notes


def _recording(spec: PadSpec, path: Path) -> PadSpec:
    return replace(spec, driver="playback", options={"file": str(path)})
