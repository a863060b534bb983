"""Pad models: the data in sensors/gamepads, choosing one, guessing one, and mapping events with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from hal.errors import ConfigError
from hal.pads.codes import ABS, BUS_BLUETOOTH, BUS_USB, EV_ABS, EV_KEY, EV_MSC, EV_REL, KEY, REL
from hal.pads.mapper import REL_SILENCE, AxisRange, PadMapper
from hal.pads.model import Identity, choose_model, guess_model, guess_warning, pad_model
from hal.types import BUTTONS, CAP_AXES, STICK_AXES

FOLDER = Path(__file__).parents[3] / "sensors" / "gamepads"
FILES = sorted(FOLDER.glob("*.yaml"))
MODELS = {path.stem: pad_model(yaml.safe_load(path.read_text(encoding="utf-8")), str(path)) for path in FILES}

BYTE, SHORT, HAT = AxisRange(0, 255, 15), AxisRange(-32768, 32767, 128), AxisRange(-1, 1)
STICKS, TRIGGERS, HATS = ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY"), ("ABS_Z", "ABS_RZ"), ("ABS_HAT0X", "ABS_HAT0Y")


def ranges(sticks: AxisRange, triggers: AxisRange) -> dict[int, AxisRange]:
    return {
        **{ABS[name]: sticks for name in STICKS},
        **{ABS[name]: triggers for name in TRIGGERS},
        **{ABS[name]: HAT for name in HATS},
    }


def dualshock() -> PadMapper:
    return PadMapper(MODELS["dualshock4"], ranges(BYTE, BYTE))


def xbox() -> PadMapper:
    return PadMapper(MODELS["xbox_one"], ranges(SHORT, AxisRange(0, 1023)))


@pytest.mark.parametrize("name", sorted(MODELS))
def test_every_model_is_named_like_its_file_and_has_every_control(name: str) -> None:
    model = MODELS[name]
    axes = {text.removeprefix("-") for text in model.axes.values()}
    buttons = set(model.buttons.values())
    assert model.name == name
    if name == "spacemouse":
        assert (axes, buttons) == (set(CAP_AXES), {"l1", "r1"})
        return
    if name == "pedal":
        assert (axes, buttons) == (set(), {"l2", "south", "home"})
        return
    assert axes | buttons >= set(STICK_AXES), "a trigger may be an axis or a button"
    assert set(BUTTONS) - {"touchpad", "l2", "r2"} <= buttons | ({"home"} if name.startswith("logitech") else set())


@pytest.mark.parametrize(
    ("pad", "expected"),
    [
        (Identity("Sony Computer Entertainment Wireless Controller", 0x054C, 0x05C4, BUS_USB, "sony"), "dualshock4"),
        (Identity("Wireless Controller", 0x054C, 0x09CC, BUS_BLUETOOTH, "playstation"), "dualshock4"),
        (Identity("DualSense Wireless Controller", 0x054C, 0x0CE6, BUS_USB, "playstation"), "dualsense"),
        (Identity("Microsoft X-Box 360 pad", 0x045E, 0x028E, BUS_USB, "xpad"), "xbox360"),
        (Identity("Microsoft X-Box One S pad", 0x045E, 0x02EA, BUS_USB, "xpad"), "xbox_one"),
        (Identity("Some pad", 0x1234, 0x5678, BUS_USB, "xpad"), "xbox360"),
        # The same pad over Bluetooth goes through another driver, which sends other codes.
        (Identity("Xbox Wireless Controller", 0x045E, 0x02FD, BUS_BLUETOOTH, "microsoft"), "xbox_bluetooth"),
        (Identity("Xbox Wireless Controller", 0x045E, 0x02EA, BUS_BLUETOOTH, "microsoft"), None),
        (Identity("Some pad", 0x1234, 0x5678, BUS_USB, "hid-generic"), None),
    ],
)
def test_the_model_that_knows_the_pad_best_is_chosen(pad: Identity, expected: str | None) -> None:
    found = choose_model(MODELS.values(), pad)
    assert (found[0].name if found else None) == expected


def test_a_receiver_on_usb_is_known_to_be_wireless() -> None:
    def wireless(vendor: int, product: int, driver: str) -> bool:
        found = choose_model(MODELS.values(), Identity("", vendor, product, BUS_USB, driver))
        assert found is not None
        return found[1].wireless

    assert wireless(0x045E, 0x0719, "xpad")
    assert wireless(0x054C, 0x0BA0, "sony")
    assert wireless(0x1234, 0x5678, "xpad")  # nobody knows, so the worse is assumed
    assert not wireless(0x045E, 0x028E, "xpad")
    assert not wireless(0x054C, 0x05C4, "sony")


def test_every_mistake_in_a_model_is_reported_at_once() -> None:
    data: dict[str, Any] = {
        "name": "wrong",
        "title": "Wrong",
        "axes": {"ABS_X": "left", "ABS_QX": "left_x"},
        "buttons": {"BTN_SOUTH": "cross"},
        "absolute": ["l2", "push_z"],
        "motoin_node": "x",
        "match": [{"vendor": 0x10000, "bus": "pci"}],
    }
    with pytest.raises(ConfigError) as caught:
        pad_model(data, "wrong.yaml")
    assert {(problem.key, problem.code) for problem in caught.value.problems} == {
        ("axes.ABS_X", "unknown_control"),
        ("axes.ABS_QX", "unknown_control"),
        ("buttons.BTN_SOUTH", "unknown_control"),
        ("absolute.0", "unknown_control"),
        ("motoin_node", "unknown_key"),
        ("match.0.vendor", "out_of_range"),
        ("match.0.bus", "unknown_control"),
    }
    assert {problem.file for problem in caught.value.problems} == {"wrong.yaml"}


@pytest.mark.parametrize(
    ("code", "value", "control", "expected"),
    [
        ("ABS_X", 255, "left_x", 1.0),
        ("ABS_X", 0, "left_x", -1.0),
        ("ABS_Y", 0, "left_y", 1.0),  # up
        ("ABS_Y", 255, "left_y", -1.0),
        ("ABS_RX", 255, "right_x", 1.0),
        ("ABS_RY", 0, "right_y", 1.0),
        ("ABS_Z", 255, "l2", 1.0),
        ("ABS_RZ", 51, "r2", 0.2),
        ("ABS_HAT0X", 1, "dpad_x", 1.0),
        ("ABS_HAT0Y", -1, "dpad_y", 1.0),  # up
        ("ABS_X", 300, "left_x", 1.0),  # beyond what it said
    ],
)
def test_axes_are_right_and_up_positive_and_normalised(code: str, value: int, control: str, expected: float) -> None:
    mapper = dualshock()
    assert mapper.feed(EV_ABS, ABS[code], value)
    assert mapper.axes.pop(control) == pytest.approx(expected)
    assert not any(mapper.axes.values())


def test_a_reversed_one_sided_axis_is_from_0_to_1() -> None:
    model = MODELS["dualshock4"].model_copy(update={"axes": {"ABS_Z": "-l2"}, "absolute": ("push_z",)})
    mapper = PadMapper(model, ranges(BYTE, BYTE))
    for raw, expected in ((0, 1.0), (51, 0.8), (255, 0.0)):
        mapper.feed(EV_ABS, ABS["ABS_Z"], raw)
        assert mapper.axes["l2"] == pytest.approx(expected)


def test_sticks_at_rest_are_near_zero_whatever_the_range() -> None:
    for mapper, rest in ((dualshock(), 128), (dualshock(), 127), (xbox(), 0), (xbox(), -1)):
        mapper.feed(EV_ABS, ABS["ABS_Y"], rest)
        assert abs(mapper.axes["left_y"]) < 0.005


def test_flat_is_a_share_of_the_travel() -> None:
    assert dualshock().flat["left_x"] == pytest.approx(15 / 127.5)
    assert dualshock().flat["l2"] == pytest.approx(15 / 255)
    assert xbox().flat["left_x"] == pytest.approx(128 / 32767.5)


def test_the_left_face_button_is_west_on_sony_pads_and_through_xpad() -> None:
    """xpad sends BTN_X for the left button, and that is the code of BTN_NORTH."""
    sony, microsoft = dualshock(), xbox()
    sony.feed(EV_KEY, KEY["BTN_WEST"], 1)
    microsoft.feed(EV_KEY, KEY["BTN_NORTH"], 1)
    assert sony.buttons == microsoft.buttons == {"west"}
    sony.feed(EV_KEY, KEY["BTN_NORTH"], 1)
    microsoft.feed(EV_KEY, KEY["BTN_WEST"], 1)
    assert sony.buttons == microsoft.buttons == {"west", "north"}
    microsoft.feed(EV_KEY, KEY["BTN_NORTH"], 0)
    assert microsoft.buttons == {"north"}


def test_events_that_the_model_does_not_know_change_nothing() -> None:
    mapper = dualshock()
    assert not mapper.feed(EV_MSC, 4, 589825)
    assert not mapper.feed(EV_KEY, 0x100, 1)
    assert not mapper.feed(EV_ABS, ABS["ABS_GAS"], 255)
    assert mapper.buttons == frozenset()


def test_a_trigger_without_a_button_gets_one_with_hysteresis() -> None:
    mapper = xbox()
    pressed = []
    for value in (0, 400, 600, 400, 200):
        mapper.feed(EV_ABS, ABS["ABS_Z"], value)
        pressed.append("l2" in mapper.buttons)
    assert pressed == [False, False, True, True, False]


def test_a_trigger_that_is_only_a_button_gets_an_axis() -> None:
    model = pad_model({"name": "d", "title": "D", "axes": {"ABS_X": "left_x"}, "buttons": {"BTN_TL2": "l2"}})
    mapper = PadMapper(model, {ABS["ABS_X"]: BYTE})
    mapper.feed(EV_KEY, KEY["BTN_TL2"], 1)
    assert (mapper.axes["l2"], mapper.buttons) == (1.0, {"l2"})
    mapper.feed(EV_KEY, KEY["BTN_TL2"], 0)
    assert (mapper.axes["l2"], mapper.buttons) == (0.0, frozenset())


def test_a_d_pad_of_buttons_is_an_axis() -> None:
    mapper = PadMapper(MODELS["xbox360"], {ABS["ABS_X"]: SHORT})
    mapper.feed(EV_KEY, KEY["BTN_TRIGGER_HAPPY3"], 1)
    mapper.feed(EV_KEY, KEY["BTN_TRIGGER_HAPPY1"], 1)
    assert (mapper.axes["dpad_x"], mapper.axes["dpad_y"]) == (-1.0, 1.0)
    mapper.feed(EV_KEY, KEY["BTN_TRIGGER_HAPPY2"], 1)
    mapper.feed(EV_KEY, KEY["BTN_TRIGGER_HAPPY1"], 0)
    assert mapper.axes["dpad_x"] == 1.0
    assert mapper.buttons == frozenset()


def test_an_axis_is_unknown_until_it_is_heard_of() -> None:
    mapper = dualshock()
    everything = {"left_x", "left_y", "right_x", "right_y", "l2", "r2", "dpad_x", "dpad_y"}
    assert mapper.unknown == everything
    assert not any(mapper.axes.values())
    mapper.feed(EV_ABS, ABS["ABS_X"], 128)
    assert mapper.unknown == everything - {"left_x"}
    resting = xbox()
    resting.sync({ABS["ABS_X"]: 0, ABS["ABS_Y"]: -1, ABS["ABS_RX"]: 200, ABS["ABS_RY"]: 0}, ())
    assert resting.unknown == {"l2", "r2", "dpad_x", "dpad_y"}


def test_after_lost_events_the_shown_state_is_taken_as_it_is() -> None:
    mapper = dualshock()
    mapper.feed(EV_KEY, KEY["BTN_SOUTH"], 1)
    mapper.feed(EV_ABS, ABS["ABS_X"], 255)
    mapper.sync({ABS["ABS_X"]: 128, ABS["ABS_Y"]: 255}, [KEY["BTN_EAST"]])
    assert mapper.buttons == {"east"}
    assert abs(mapper.axes["left_x"]) < 0.01
    assert mapper.axes["left_y"] == -1.0


def test_an_axis_without_a_range_does_not_exist() -> None:
    mapper = PadMapper(MODELS["dualshock4"], {ABS["ABS_X"]: BYTE, ABS["ABS_Y"]: AxisRange(0, 0)})
    assert set(mapper.axes) == {"left_x", "l2", "r2"}  # triggers from their buttons
    assert not mapper.feed(EV_ABS, ABS["ABS_Y"], 12)


STRANGER = Identity("ACME Pad 3000", 0x1234, 0xABCD, BUS_USB, "hid-generic")


@pytest.mark.parametrize(
    ("axes", "right", "triggers"),
    [
        (("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY", "ABS_Z", "ABS_RZ"), "ABS_RX", "ABS_Z"),
        (("ABS_X", "ABS_Y", "ABS_Z", "ABS_RZ", "ABS_GAS", "ABS_BRAKE"), "ABS_Z", "ABS_BRAKE"),
        (("ABS_X", "ABS_Y", "ABS_Z", "ABS_RZ"), "ABS_Z", None),
        (("ABS_X", "ABS_Y"), None, None),
    ],
)
def test_an_unknown_pad_is_guessed_from_what_it_can_send(
    axes: tuple[str, ...], right: str | None, triggers: str | None
) -> None:
    keys = [KEY["BTN_SOUTH"], KEY["BTN_TL2"], KEY["BTN_DPAD_UP"]]
    model = guess_model(STRANGER, [ABS[name] for name in axes], keys)
    by_control = {control: code for code, control in model.axes.items()}
    assert by_control["left_x"] == "ABS_X"
    assert by_control.get("right_x") == right
    assert by_control.get("l2") == triggers
    assert model.buttons == {"BTN_SOUTH": "south", "BTN_TL2": "l2", "BTN_DPAD_UP": "+dpad_y"}


def test_a_guess_warns_and_prints_a_file_that_can_be_kept() -> None:
    model = guess_model(STRANGER, [ABS["ABS_X"], ABS["ABS_Y"], ABS["ABS_HAT0X"], ABS["ABS_HAT0Y"]], [KEY["BTN_SOUTH"]])
    warning = guess_warning(model)
    assert "ACME Pad 3000" in warning
    assert "acme_pad_3000.yaml" in warning
    text = model.to_yaml()
    assert text in warning
    assert "product: 0xabcd" in text
    again = pad_model(yaml.safe_load(text))
    assert again == model
    found = choose_model([again], STRANGER)
    assert found is not None
    assert found[1].wireless  # on USB it may be a receiver


def test_a_second_code_for_a_button_does_not_let_go_of_it() -> None:
    """Pads differ in the code of some buttons, so a model may have two for one; a pad sends one of them."""
    codes = {"BTN_SELECT": "select", "KEY_BACK": "select", "BTN_TRIGGER_HAPPY1": "-dpad_x"}
    axes = {"ABS_HAT0X": "dpad_x"}
    mapper = PadMapper(pad_model({"name": "t", "title": "T", "axes": axes, "buttons": codes}), {ABS["ABS_HAT0X"]: HAT})
    for code in ("BTN_SELECT", "KEY_BACK"):
        mapper.sync({ABS["ABS_HAT0X"]: -1}, [KEY[code]])
        assert mapper.buttons == {"select"}
        assert mapper.axes["dpad_x"] == -1.0, "what the d-pad's axis says is not undone by its buttons"
    mapper.sync({ABS["ABS_HAT0X"]: 0}, [KEY["BTN_TRIGGER_HAPPY1"]])
    assert (mapper.buttons, mapper.axes["dpad_x"]) == (frozenset(), -1.0)


def test_an_axis_that_only_says_how_far_needs_a_range() -> None:
    data: dict[str, Any] = {"name": "cap", "title": "Cap", "axes": {"REL_X": "push_y"}, "buttons": {"BTN_0": "l1"}}
    with pytest.raises(ConfigError, match="needs ranges of REL_X"):
        pad_model(data)
    mapper = PadMapper(pad_model(data | {"ranges": {"REL_X": [-100, 100]}}), {}, [REL["REL_X"]])
    assert mapper.unknown == {"push_y"}
    assert mapper.feed(EV_REL, REL["REL_X"], 50, 1.0)
    assert (mapper.axes["push_y"], mapper.unknown) == (0.5, frozenset())
    assert not mapper.expire(1.0 + 0.9 * REL_SILENCE)
    assert mapper.expire(1.0 + REL_SILENCE)
    assert mapper.axes["push_y"] == 0.0
    assert not mapper.expire(2.0), "it was told once"


def test_a_rule_may_call_a_pad_by_its_own_name() -> None:
    found = choose_model(MODELS.values(), Identity("x", 0x046D, 0xC21D, BUS_USB, "xpad"))
    assert found is not None
    assert (found[0].title, found[1].title) == ("Xbox 360 pad", "Logitech F310 (X mode)")
