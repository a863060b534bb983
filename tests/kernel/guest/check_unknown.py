"""Pads that no model names, and what is no pad."""

from __future__ import annotations

from functools import partial

import pytest
from bench import Bench
from kit import Measured, eventually, settle, shows

from hal.drivers.evdev.pad import EvdevPad
from hal.errors import NotSupported
from hal.gamepad import Gamepad

_AXES = ("left_x", "left_y", "right_x", "right_y", "l2", "r2")
_BUTTONS = ("south", "east", "north", "west", "select", "start")


def check_unknown_pad(bench: Bench, pad: Gamepad, measured: Measured) -> None:
    """It is guessed by what it can send, with a note; nobody vouches for it as a dead-man."""
    bench.plug("unknown")
    settle(bench, pad)
    assert pad.describe().startswith("Nobody's Pad (USB, ")
    (note,) = pad.notes
    assert "guessed" in note
    assert "vendor: 0x1234" in note
    with pytest.raises(NotSupported, match="accept_silent_pad"):
        pad.hold("l2").check_trust()
    gestures = [({name: 1.0}, ()) for name in _AXES] + [({name: -1.0}, ()) for name in _AXES[:4]]
    for axes, buttons in (*gestures, *(({}, (name,)) for name in _BUTTONS)):
        bench.show(axes, buttons)
        eventually(partial(shows, pad, axes, buttons), f"{axes} {buttons}", 2.0)
    measured(f"{len(gestures) + len(_BUTTONS)} positions of controls")


def check_no_pad(bench: Bench, pad: Gamepad) -> None:
    """The machine's keyboard is no pad."""
    assert not pad.state().connected
    assert pad.describe() == "no gamepad"
    assert not EvdevPad.list_plugged().pads
