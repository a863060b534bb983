"""Which pad drives: a plugged-in one, the console, or a recording."""

from dataclasses import replace
from pathlib import Path

import pytest
from errors_kit import raises_code

from hal.driver import Plugged
from hal.errors import DeviceNotFound, NotSupported
from hal.pads.choice import Chosen, choose_pad
from hal.specs import PadSpec

AUTO = PadSpec("pad", "auto", None)


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch):
    """Say what the evdev driver finds."""
    from hal.drivers.evdev.pad import EvdevPad

    def say(*pads: str, notes: tuple[str, ...] = ()) -> None:
        monkeypatch.setattr(EvdevPad, "list_plugged", classmethod(lambda cls: Plugged(pads, notes)))

    return say


def choose(
    wanted: str | None = None,
    attended: bool = False,
    lock_step: bool = False,
    emulated: bool = False,
    spec: PadSpec = AUTO,
) -> Chosen:
    return choose_pad(spec, wanted, attended=attended, lock_step=lock_step, emulated=emulated)


@pytest.mark.parametrize("lock_step", [False, True])
def test_a_plugged_in_pad_comes_first(plug, lock_step: bool) -> None:
    plug("DualShock 4")
    assert choose(lock_step=lock_step).spec.driver == "evdev"


@pytest.mark.parametrize("attended", [False, True])
def test_then_the_console_in_simulation_and_for_real(plug, attended: bool) -> None:
    plug(notes=("no permission: sudo usermod -aG input me",))
    chosen = choose(attended=attended)
    assert chosen.spec.driver == "web"
    assert "usermod" in chosen.notes[0]


def test_in_lock_step_the_recorded_tour_drives(plug) -> None:
    plug()
    chosen = choose(lock_step=True)
    assert chosen.spec.driver == "playback"
    assert Path(chosen.spec.options["file"]).name == "tour.jsonl"
    assert "recorded tour" in chosen.notes[-1]


def test_a_real_arm_is_not_driven_by_a_recording(plug, tmp_path: Path) -> None:
    plug(notes=("no permission: sudo usermod -aG input me",))
    with pytest.raises(DeviceNotFound, match=r"plug one in; no permission: sudo usermod"):
        choose(attended=True, lock_step=True)
    recording = tmp_path / "pad.jsonl"
    recording.touch()
    for wanted in (str(recording), "demo"):
        with pytest.raises(NotSupported, match="recording cannot hold"):
            choose(wanted, attended=True)


def test_an_emulated_arm_may_be_driven_by_a_recording_and_that_is_told(plug, tmp_path: Path) -> None:
    plug()
    assert choose(attended=True, emulated=True, lock_step=True).spec.driver == "playback"
    chosen = choose("demo", attended=True, emulated=True)
    assert Path(chosen.spec.options["file"]).name == "tour.jsonl"
    assert chosen.notes
    assert choose("demo").notes == ()
    assert choose(attended=True, emulated=True).spec.driver == "web"


def test_what_was_asked_for(plug, tmp_path: Path) -> None:
    plug("DualShock 4")
    recording = tmp_path / "pad.jsonl"
    recording.touch()
    assert choose(str(recording)).spec.options["file"] == str(recording)
    for kind in ("evdev", "web", "terminal"):
        assert choose(kind).spec.driver == kind
    assert Path(choose("demo").spec.options["file"]).name == "tour.jsonl"
    with pytest.raises(DeviceNotFound, match=r"there is no pad 'nothing': auto, evdev, web"):
        choose("nothing")


def test_no_recording_takes_the_place_of_a_real_pad(plug) -> None:
    real = replace(AUTO, real=True)
    plug()
    with raises_code(DeviceNotFound, "no_gamepad"):
        choose(lock_step=True, spec=real)
    with raises_code(NotSupported, "recording_of_real_pad"):
        choose("demo", spec=real)
    assert choose(spec=real).spec.driver == "web"
    plug("DualShock 4")
    assert choose(lock_step=True, spec=real).spec.driver == "evdev"


def test_a_pad_that_may_come_later_is_told(plug) -> None:
    plug()
    chosen = choose("evdev")
    assert chosen.spec.driver == "evdev"
    assert "plug one in at any time" in chosen.notes[-1]


def test_a_rig_that_names_its_pad_is_obeyed(plug) -> None:
    plug("DualShock 4")
    named = PadSpec("pad", "playback", None, options={"file": "x.jsonl"})
    assert choose("evdev", spec=named).spec is named
