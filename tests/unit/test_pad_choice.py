"""Which pad drives: a plugged-in one, the viewer's keyboard, or the recorded tour."""

from pathlib import Path

import pytest

from hal.errors import DeviceNotFound, NotSupported
from hal.gamepad import Plugged
from hal.pads.choice import choose_pad
from hal.specs import PadSpec

AUTO = PadSpec("pad", "auto", None)


class Window:
    """A viewer with a keyboard, or without."""

    def __init__(self, record: object | None) -> None:
        self.record = record

    def keyboard(self) -> object | None:
        return self.record


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch):
    """Say what the evdev driver finds."""
    from hal.drivers.evdev.pad import EvdevPad

    def say(*pads: str, notes: tuple[str, ...] = ()) -> None:
        monkeypatch.setattr(EvdevPad, "plugged", classmethod(lambda cls: Plugged(pads, notes)))

    return say


def choose(wanted: str | None = None, viewer: object | None = None, attended: bool = False, spec: PadSpec = AUTO):
    return choose_pad(spec, wanted, viewer, window="pybullet", attended=attended)


def test_a_plugged_in_pad_comes_first(plug) -> None:
    plug("DualShock 4")
    spec, source, _ = choose(viewer=Window("record"))
    assert (spec.driver, source) == ("evdev", None)


def test_then_the_keyboard_of_the_window(plug) -> None:
    plug()
    spec, source, _ = choose(viewer=Window("record"))
    assert (spec.driver, source) == ("pybullet", "record")


def test_then_the_recorded_tour_and_it_says_so(plug) -> None:
    plug(notes=("no permission: sudo usermod -aG input me",))
    spec, _, notes = choose(viewer=Window(None))
    assert spec.driver == "playback"
    assert Path(spec.options["file"]).name == "tour.jsonl"
    assert "usermod" in notes[0]
    assert "recorded tour" in notes[-1]


def test_a_real_arm_is_not_driven_by_a_recording(plug, tmp_path: Path) -> None:
    plug(notes=("no permission: sudo usermod -aG input me",))
    with pytest.raises(DeviceNotFound, match=r"plug one in; no permission: sudo usermod"):
        choose(attended=True)
    recording = tmp_path / "pad.jsonl"
    recording.touch()
    with pytest.raises(NotSupported, match="recording cannot hold"):
        choose(str(recording), attended=True)


def test_what_was_asked_for(plug, tmp_path: Path) -> None:
    plug("DualShock 4")
    recording = tmp_path / "pad.jsonl"
    recording.touch()
    assert choose(str(recording))[0].driver == "playback"
    assert choose("evdev")[0].driver == "evdev"
    assert choose("keyboard", Window("record"))[0].driver == "pybullet"
    with pytest.raises(DeviceNotFound, match="add --viewer gui"):
        choose("keyboard")
    with pytest.raises(DeviceNotFound, match=r"there is no pad 'nothing'"):
        choose("nothing")


def test_a_rig_that_names_its_pad_is_obeyed(plug) -> None:
    plug("DualShock 4")
    named = PadSpec("pad", "playback", None, options={"file": "x.jsonl"})
    assert choose("evdev", spec=named)[0] is named
    assert choose("auto", Window("record"), spec=PadSpec("pad", "keyboard", None))[0].driver == "pybullet"
