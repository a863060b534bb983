"""From a pad to an arm and its gripper, on the built-in rig with mock devices."""

from collections.abc import Iterator

import pytest

import hal
from hal import ConfigError, PadState, Stamp, Twist
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


def test_speed_scales_the_mapping(arm: hal.Robot) -> None:
    motion, _ = hal.Teleop(arm, speed=0.5).step(pad(dpad_y=1.0, left_x=1.0), 0.02)
    assert motion.linear == pytest.approx([0.1, 0, 0])
    assert motion.angular == pytest.approx([0, 0, -0.4])


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


TOGGLE = {"deadman": "l2", "gripper": {"toggle": "r1"}}


def test_one_button_closes_and_opens_in_turn(arm: hal.Robot) -> None:
    teleop = hal.Teleop(arm, mapping=TOGGLE)

    def press() -> float | None:
        """Return the grip of a press of some ticks."""
        sent = [teleop.step(pad("l2", "r1"), 0.02)[1] for _ in range(3)]
        assert len(set(sent)) == 1, "as long as it is held: no single command matters"
        assert teleop.step(pad("l2"), 0.02)[1] is None
        return sent[0]

    assert teleop.step(pad("l2"), 0.02)[1] is None
    for wanted in (1.0, 0.0, 1.0):
        assert press() == wanted
        arm.gripper.grip(wanted)


def test_a_toggle_depends_on_the_gripper_and_not_on_its_own_count(arm: hal.Robot) -> None:
    teleop = hal.Teleop(arm, mapping=TOGGLE)
    arm.gripper.grip(1.0)  # closed by another part of the program
    teleop.step(pad("l2"), 0.02)
    assert teleop.step(pad("l2", "r1"), 0.02)[1] == 0.0


@pytest.mark.parametrize("interruption", ["the dead-man is released", "the pad is gone", "a new session"])
def test_a_toggle_that_is_held_through_an_interruption_does_not_flip_anything(
    arm: hal.Robot, interruption: str
) -> None:
    teleop = hal.Teleop(arm, mapping=TOGGLE)
    assert teleop.step(pad("l2", "r1"), 0.02)[1] is None, "held from the start"
    teleop.step(pad("l2"), 0.02)
    assert teleop.step(pad("l2", "r1"), 0.02)[1] == 1.0
    arm.gripper.grip(1.0)
    if interruption == "the dead-man is released":
        assert teleop.step(pad("r1"), 0.02)[1] is None
    elif interruption == "the pad is gone":
        assert teleop.step(PadState(Stamp(0.0, 0.0, 2)), 0.02)[1] is None
    else:
        teleop.reset()
    assert [teleop.step(pad("l2", "r1"), 0.02)[1] for _ in range(3)] == [None] * 3
    teleop.step(pad("l2"), 0.02)
    assert teleop.step(pad("l2", "r1"), 0.02)[1] == 0.0, "a press of its own"


def test_a_toggle_is_explained(rig: hal.Rig, arm: hal.Robot) -> None:
    teleop = hal.Teleop(arm, mapping="spacemouse")
    assert teleop.labels()["controls"]["r1"] == ["open or close the gripper"]
    text = "\n".join(teleop.help(rig.gamepads["pad"]))
    assert "gripper: R1" in text
    assert "hold L1 to move" in text


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
    assert hal.Teleop(arm).pressed(pad("south")) == frozenset()


def test_an_action_counts_once_a_press_with_the_dead_man_or_without(arm: hal.Robot) -> None:
    teleop = hal.Teleop(arm)
    presses = [(), ("south",), ("south", "l2"), ("l2",), ("south", "home", "l2"), ("north",)]
    found = [teleop.pressed(pad(*buttons)) for buttons in presses]
    assert found == [set(), {"record"}, set(), set(), {"record", "finish"}, set()]


def test_a_bad_mapping_lists_every_problem(arm: hal.Robot) -> None:
    with pytest.raises(ConfigError) as caught:
        hal.Teleop(arm, mapping={"deadman": "l22", "linear": {"x": {"axis": "dpad_z", "scale": 0.1}}, "lineer": {}})
    text = str(caught.value)
    assert all(word in text for word in ("l22", "dpad_z", "lineer")), text


def test_help_names_the_controls(rig: hal.Rig, arm: hal.Robot) -> None:
    text = "\n".join(hal.Teleop(arm).help(rig.gamepads["pad"]))
    assert "hold L2 to move" in text
    assert "move: forward/back by D-pad up/down (0.2 m/s), left/right by D-pad left/right (0.2 m/s), down/up by" in text
    assert "gripper: R2" in text


def test_labels_of_each_control() -> None:
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
