"""Which pad drives: what ``model: auto`` comes to, and what a program's ``--pad`` may say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from .. import registry
from ..config.data_files import find_data
from ..errors import DeviceNotFound, DriverMissing, NotSupported
from ..specs import PadSpec

if TYPE_CHECKING:
    from ..pictures import Viewer

__all__ = ["TOUR", "check_wanted", "choose_pad"]

TOUR = ("config", "teleop/tour.jsonl")
"""The recorded tour, among the data files."""
_AUTO = "auto"


def choose_pad(
    spec: PadSpec, wanted: str | None, viewer: Viewer | None, *, window: str | None, attended: bool
) -> tuple[PadSpec, object | None, tuple[str, ...]]:
    """The pad to open, where it gets its record from, and what a person should know.

    ``wanted`` is what the program asked for: ``evdev``, ``keyboard``, the path of a recording, or ``auto`` (None means
    the same). It only matters for a pad whose driver is ``auto`` in the rig. ``window`` names the viewer's driver.
    ``auto`` is a pad that is plugged in, else the viewer's keyboard, else, where nothing real moves, the recorded
    tour.

    Raises DeviceNotFound, with what to do, where there is nothing to drive with.
    """
    if spec.driver == "keyboard":
        return _keyboard(spec, viewer, window)
    if spec.driver != _AUTO:
        return spec, None, ()
    if wanted in (None, _AUTO):
        return _first(spec, viewer, window, attended)
    if wanted == "evdev":
        pads, notes = _plugged()
        missing = () if pads else ("no gamepad is plugged in yet: plug one in at any time",)
        return replace(spec, driver="evdev"), None, (*notes, *missing)
    if wanted == "keyboard":
        return _keyboard(spec, viewer, window)
    assert wanted is not None
    check_wanted(wanted)
    path = Path(wanted)
    if attended:
        raise NotSupported("a recording cannot hold the dead-man of a real arm; plug in a pad")
    return _recording(spec, path), None, ()


def check_wanted(wanted: str | None) -> None:
    """Raise DeviceNotFound when ``wanted`` is neither a kind of pad nor a recording that is there."""
    if wanted not in (None, _AUTO, "evdev", "keyboard", "none") and not Path(str(wanted)).is_file():
        raise DeviceNotFound(f"there is no pad {wanted!r}: auto, evdev, keyboard, or the path of a recording (.jsonl)")


def _first(
    spec: PadSpec, viewer: Viewer | None, window: str | None, attended: bool
) -> tuple[PadSpec, object | None, tuple[str, ...]]:
    pads, notes = _plugged()
    if pads:
        return replace(spec, driver="evdev"), None, notes
    if viewer is not None and viewer.keyboard() is not None:
        return _keyboard(spec, viewer, window)
    if attended:
        raise DeviceNotFound(
            "; ".join(["no gamepad is plugged in, and a real arm does not move without one: plug one in", *notes])
        )
    note = "no gamepad is plugged in: playing the recorded tour (plug one in, or use --viewer gui and its keyboard)"
    return _recording(spec, find_data(*TOUR)), None, (*notes, note)


def _plugged() -> tuple[tuple[str, ...], tuple[str, ...]]:
    try:
        found = registry.load("evdev", "gamepad").plugged()
    except (DriverMissing, NotSupported) as error:
        return (), (str(error),)
    return found.pads, found.notes


def _keyboard(
    spec: PadSpec, viewer: Viewer | None, window: str | None
) -> tuple[PadSpec, object | None, tuple[str, ...]]:
    keyboard = viewer.keyboard() if viewer is not None else None
    if keyboard is None or window is None:
        raise DeviceNotFound("the keyboard is that of the viewer's window: add --viewer gui")
    return replace(spec, driver=window), keyboard, ()


def _recording(spec: PadSpec, path: Path) -> PadSpec:
    return replace(spec, driver="playback", options={"file": str(path)})
