"""Choose the gamepad that drives: what ``model: auto`` resolves to, and the values of a program's ``--pad``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from .. import registry
from ..config.data_files import find_data
from ..errors import DeviceNotFound, DriverMissing, NotSupported
from ..registry import PadInput
from ..specs import PadSpec

TOUR = ("config", "teleop/tour.jsonl")
"""The recorded tour, among the data files."""
_AUTO, _DEMO, _NONE = "auto", "demo", "none"
_LIVE: tuple[PadInput, ...] = ("plugged", "console", "keys")
_NO_RECORDING = "a recording cannot hold the dead-man of a real arm; plug a gamepad in, or use --pad {console}"


class Chosen(NamedTuple):
    """A gamepad that is going to be opened."""

    spec: PadSpec
    notes: tuple[str, ...] = ()
    """Messages for the user."""

    @property
    def input(self) -> PadInput | None:
        """Where its input comes from; None for a driver that declares none."""
        return registry.driver(self.spec.driver).pad_input

    @property
    def title(self) -> str:
        """A few words for status messages, for example ``a recording``."""
        return registry.driver(self.spec.driver).pad_title or f"the pad of driver {self.spec.driver}"


def pad_choices() -> tuple[str, ...]:
    """Return the values of ``--pad``, besides the path of a recording."""
    return (_AUTO, *(registry.pad_driver(source) for source in _LIVE), _DEMO, _NONE)


def choose_pad(spec: PadSpec, wanted: str | None, *, attended: bool, lock_step: bool, emulated: bool = False) -> Chosen:
    """Choose the driver of a gamepad whose driver is ``auto``; any other gamepad stays as it is.

    ``auto`` is a gamepad that is plugged in, else the console, which any browser can drive. In lock-step, where nothing
    can be driven by hand, it is the recorded tour, unless the rig wants a real pad (:attr:`.PadSpec.real`).

    Args:
        spec: The gamepad of the rig file.
        wanted: One of :func:`pad_choices`, the path of a recording, or None for ``auto``.
        attended: Whether a real device moves.
        lock_step: Whether the rig runs in lock-step.
        emulated: Whether every real device is an emulator, so that a recording may drive it.

    Raises:
        DeviceNotFound: No such choice or recording, or no gamepad for a real arm, or a real pad, in lock-step.
        NotSupported: A recording for a real arm, or in the place of a real pad.
    """
    if spec.driver != _AUTO:
        return Chosen(spec)
    check_wanted(wanted)
    if wanted in (None, _AUTO):
        return _choose_auto(spec, attended and not emulated, lock_step)
    if wanted == registry.pad_driver("plugged"):
        pads, notes = _list_plugged()
        missing = () if pads else ("no gamepad is plugged in yet: plug one in at any time",)
        return Chosen(replace(spec, driver=wanted), (*notes, *missing))
    if wanted in pad_choices() and wanted != _DEMO:
        return Chosen(replace(spec, driver=wanted))
    if spec.real:
        text = f"gamepads.{spec.name}.sim is false: a recording is no real pad; leave that key out, or the recording"
        raise NotSupported(text, code="recording_of_real_pad")
    if attended and not emulated:
        text = _NO_RECORDING.format(console=registry.pad_driver("console"))
        raise NotSupported(text, code="recording_on_real_arm")
    notes = ("a recording holds the dead-man: every real device here is emulated",) if attended else ()
    return Chosen(play_tour(spec) if wanted == _DEMO else _play_file(spec, Path(str(wanted))), notes)


def check_wanted(wanted: str | None) -> None:
    """Check a value of ``--pad``.

    Raises:
        DeviceNotFound: It is neither one of :func:`pad_choices` nor an existing recording.
    """
    if wanted is not None and wanted not in pad_choices() and not Path(wanted).is_file():
        choices = ", ".join(pad_choices())
        raise DeviceNotFound(f"there is no pad {wanted!r}: {choices}, or the path of a recording (.jsonl)")


def play_tour(spec: PadSpec) -> PadSpec:
    """Return ``spec`` with the recorded tour as its driver."""
    return _play_file(spec, find_data(*TOUR))


def _choose_auto(spec: PadSpec, attended: bool, lock_step: bool) -> Chosen:
    pads, notes = _list_plugged()
    if pads:
        return Chosen(replace(spec, driver=registry.pad_driver("plugged")), notes)
    if not lock_step:
        return Chosen(replace(spec, driver=registry.pad_driver("console")), notes)
    if attended or spec.real:
        why = "a real arm does not move without one" if attended else f"gamepads.{spec.name}.sim is false"
        text = f"no gamepad is plugged in, and {why}: plug one in"
        raise DeviceNotFound("; ".join([text, *notes]), code="no_gamepad")
    return Chosen(play_tour(spec), (*notes, "lock-step cannot be driven by hand: playing the recorded tour"))


def _list_plugged() -> tuple[tuple[str, ...], tuple[str, ...]]:
    try:
        found = registry.load(registry.pad_driver("plugged"), "gamepad").list_plugged()
    except (DriverMissing, NotSupported) as error:
        return (), (str(error),)
    return found.pads, found.notes


def _play_file(spec: PadSpec, path: Path) -> PadSpec:
    return replace(spec, driver=registry.pad_driver("recording"), options={"file": str(path)})
