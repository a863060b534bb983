"""From a pad to an arm and its gripper, on the built-in rig with mock devices."""

from collections.abc import Iterator

import pytest

import hal
from hal import CommandError, ConfigError, PadState, Stamp, Twist
from hal.types import AXES


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock") as opened:
        yield opened


@pytest.fixture
def arm(rig: hal.Rig) -> hal.Robot:
    return rig.robots["panda"]


def pad(*buttons: str, **axes: float) -> PadState:
    return PadState(Stamp(0.0, 0.0, 1), dict.fromkeys(AXES, 0.0) | axes, frozenset(buttons), connected=True)


def test_the_default_mapping_is_the_tutorials(arm: hal.Robot) -> None:
    """Base frame: x forwards, y to the left, z up; roll, pitch and yaw turn the same way as the tutorial's."""
    teleop = hal.Teleop(arm)

    def twist(*buttons: str, **axes: float) -> Twist:
        return teleop.step(pad(*buttons, **axes), 0.02)[0]

    assert twist(dpad_y=1.0).linear == pytest.approx([0.2, 0, 0])
    assert twist(dpad_x=1.0).linear == pytest.approx([0, -0.2, 0])
    assert twist("l1").linear == pytest.approx([0, 0, 0.2])
    assert twist("r1").linear == pytest.approx([0, 0, -0.2])
    assert twist(left_x=0.5).angular == pytest.approx([0, 0, -0.4])
    assert twist().linear == pytest.approx([0, 0, 0])
    assert twist().frame == "base"


def test_speed_scales_the_mapping_and_is_checked(arm: hal.Robot) -> None:
    motion, _ = hal.Teleop(arm, speed=0.5).step(pad(dpad_y=1.0, left_x=1.0), 0.02)
    assert motion.linear == pytest.approx([0.1, 0, 0])
    assert motion.angular == pytest.approx([0, 0, -0.4])
    for bad in (0.0, 1.5, float("nan")):
        with pytest.raises(CommandError, match="speed must be above 0"):
            hal.Teleop(arm, speed=bad)


def test_a_trigger_moves_the_gripper_only_after_it_crossed_the_present_grip(arm: hal.Robot) -> None:
    teleop = hal.Teleop(arm)
    arm.gripper.grip(0.6)
    assert teleop.step(pad("l2", r2=0.0), 0.02)[1] is None, "an open trigger must not drop what is held"
    assert teleop.step(pad("l2", r2=0.4), 0.02)[1] is None
    assert teleop.step(pad("l2", r2=0.8), 0.02)[1] == 0.8, "crossed"
    assert teleop.step(pad("l2", r2=0.2), 0.02)[1] == 0.2, "and now it is the trigger's"


@pytest.mark.parametrize("interruption", ["the dead-man is released", "the pad is gone", "a new session"])
def test_the_grip_survives(arm: hal.Robot, interruption: str) -> None:
    teleop = hal.Teleop(arm)
    assert teleop.step(pad("l2", r2=0.0), 0.02)[1] == 0.0, "the open gripper is where the trigger is"
    assert teleop.step(pad("l2", r2=0.7), 0.02)[1] == 0.7
    arm.gripper.grip(0.7)
    if interruption == "the dead-man is released":
        assert teleop.step(pad(r2=0.0), 0.02)[1] is None
    elif interruption == "the pad is gone":
        assert teleop.step(PadState(Stamp(0.0, 0.0, 2)), 0.02)[1] is None
    else:
        teleop.reset()
    assert teleop.step(pad("l2", r2=0.0), 0.02)[1] is None
    assert arm.gripper.state().width_target == pytest.approx(0.3 * arm.gripper.width_max)


def test_buttons_open_and_close(arm: hal.Robot) -> None:
    mapping = {"deadman": "l2", "gripper": {"open": "east", "close": "south"}}
    teleop = hal.Teleop(arm, mapping=mapping)
    assert teleop.step(pad("l2", "south"), 0.02)[1] == 1.0
    assert teleop.step(pad("l2", "east"), 0.02)[1] == 0.0
    assert teleop.step(pad("l2"), 0.02)[1] is None
    assert teleop.step(pad("south"), 0.02)[1] is None, "not without the dead-man"


def test_home_counts_once_a_press(arm: hal.Robot) -> None:
    teleop = hal.Teleop(arm)
    assert [teleop.home_pressed(pad(*b)) for b in ((), ("north",), ("north",), (), ("north",))] == [
        False,
        True,
        False,
        False,
        True,
    ]


def test_a_button_held_from_the_start_is_no_press(arm: hal.Robot) -> None:
    assert hal.Teleop(arm).home_pressed(pad("north")) is False


def test_a_bad_mapping_lists_every_problem(arm: hal.Robot) -> None:
    with pytest.raises(ConfigError) as caught:
        hal.Teleop(arm, mapping={"deadman": "l22", "linear": {"x": {"axis": "dpad_z", "scale": 0.1}}, "lineer": {}})
    text = str(caught.value)
    assert all(word in text for word in ("l22", "dpad_z", "lineer")), text


def test_help_names_the_controls(rig: hal.Rig, arm: hal.Robot) -> None:
    text = "\n".join(hal.Teleop(arm).help(rig.gamepads["pad"]))
    assert "hold l2 to move" in text
    assert "dpad_y (0.2 m/s)" in text
    assert "gripper: r2" in text


def test_labels_say_what_each_control_does() -> None:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        labels = hal.Teleop(rig.robots["panda"]).labels(actions=("record", "home"))
    assert (labels["deadman"], labels["home"], labels["robot"]) == ("l2", "north", "panda")
    controls = labels["controls"]
    assert controls["dpad_y"] == ["back", "forward"]
    assert controls["dpad_x"] == ["left", "right"], "the mapping inverts y, which points to the left"
    assert (controls["l1"], controls["r1"]) == (["up"], ["down"])
    assert controls["left_x"] == ["turn left", "turn right"]
    assert controls["r2"] == ["gripper: open", "gripper: closed"]
    assert controls["south"] == ["record"]
    assert controls["north"] == ["home"]
    assert "home" not in controls, "of the mapping's actions only those that the app knows"
