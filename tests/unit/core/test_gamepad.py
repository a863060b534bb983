"""The public gamepad, around a driver that a test plays."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from errors_kit import raises_code

import hal
from hal.driver import GamepadDriver, PadReading
from hal.errors import DeviceNotFound, NotSupported
from hal.gamepad import Gamepad
from hal.specs import PadSpec
from hal.types import AXES, PadState

RESTING = dict.fromkeys(AXES, 0.0)


class Played(GamepadDriver):
    """Reports what the test sets."""

    proves_liveness = True

    def __init__(self, spec: PadSpec) -> None:
        super().__init__(spec)
        self.reading = PadReading(0.0, 0.0, 0.0, 0, RESTING, frozenset(), connected=True)
        self.failure: Exception | None = None
        self.news = threading.Event()
        self.closed = 0

    def open(self) -> None:
        pass

    def poll(self, now: float, timeout: float) -> PadReading:
        if timeout:
            self.news.wait(timeout)
            self.news.clear()
        if self.failure is not None:
            raise self.failure
        return self.reading

    def shows(self, *buttons: str, connected: bool = True, unknown: tuple[str, ...] = (), **axes: float) -> None:
        old = self.reading
        t = old.t + 0.01
        self.reading = PadReading(
            t, t, t, old.seq + 1, {**RESTING, **axes}, frozenset(buttons), connected=connected, unknown=unknown
        )
        self.news.set()

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def driver(pad_spec: PadSpec) -> Played:
    return Played(pad_spec)


@pytest.fixture
def pad(driver: Played) -> Iterator[Gamepad]:
    pad = Gamepad(driver)
    pad.open(0.0)
    yield pad
    pad.close()


@pytest.fixture
def see(pad: Gamepad, driver: Played) -> Callable[..., PadState]:
    """Let the driver report something, poll once, and return the state."""

    def see(*buttons: str, connected: bool = True, unknown: tuple[str, ...] = (), **axes: float) -> PadState:
        driver.shows(*buttons, connected=connected, unknown=unknown, **axes)
        pad.poll_once(driver.reading.t)
        return pad.state()

    return see


See = Callable[..., PadState]


def test_before_it_is_opened_it_is_disconnected(driver: Played) -> None:
    state = Gamepad(driver).state()
    assert not state.connected
    assert state.axis("left_x") == 0.0


def test_the_state_has_axes_buttons_and_stamps(see: See, driver: Played) -> None:
    state = see("south", left_x=1.0, right_y=-1.0, l2=1.0, dpad_y=1.0)
    assert state.connected
    assert state.pressed("south")
    assert [state.axis(name) for name in ("left_x", "right_y", "l2", "dpad_y", "left_y")] == [1.0, -1.0, 1.0, 1.0, 0.0]
    assert (state.stamp.t, state.stamp.t_device, state.stamp.seq) == (driver.reading.t, driver.reading.t_device, 1)
    with pytest.raises(TypeError):
        state.axes["left_x"] = 0.0  # type: ignore[index]


def test_a_stick_starts_from_zero_at_the_edge_of_its_dead_zone(see: See, pad: Gamepad) -> None:
    zone = pad.driver.spec.dead_zone
    assert see(left_x=zone).axis("left_x") == 0.0
    assert 0.0 < see(left_x=zone + 1e-6).axis("left_x") < 2e-6
    assert see(left_x=-(zone + 0.5 * (1.0 - zone))).axis("left_x") == pytest.approx(-0.5)
    assert see(left_x=-1.0).axis("left_x") == -1.0
    assert see(dpad_x=-1.0).axis("dpad_x") == -1.0


def test_the_larger_of_the_rigs_dead_zone_and_the_pads_own_counts(see: See, driver: Played) -> None:
    driver.flat = {"left_x": 0.2, "left_y": 0.01}
    assert see(left_x=0.2).axis("left_x") == 0.0
    assert see(left_y=0.5).axis("left_y") == pytest.approx((0.5 - 0.08) / 0.92)


def test_a_reading_that_is_not_a_number_moves_nothing(see: See, pad: Gamepad) -> None:
    deadman = pad.hold("l2")
    see()
    assert see(left_x=math.nan, l2=math.nan).axis("left_x") == 0.0
    assert not deadman.held


def test_nothing_counts_until_every_stick_was_at_rest(driver: Played) -> None:
    driver.shows("south", left_x=1.0)
    pad = Gamepad(driver)
    pad.open(0.0)
    assert pad.state().connected
    assert pad.state().axis("left_x") == 0.0
    assert pad.waiting_for == ("left_x",)
    driver.shows("south", right_x=1.0)
    pad.poll_once(0.1)
    assert pad.state().axis("right_x") == 0.0
    driver.shows("south", right_x=0.2)  # near enough to rest
    pad.poll_once(0.2)
    driver.shows("south", right_x=1.0)
    pad.poll_once(0.3)
    assert pad.state().axis("right_x") == 1.0
    assert not pad.state().pressed("south")  # it was never seen up
    assert pad.waiting_for == ("south",)


def test_a_button_that_was_pressed_counts_once_it_was_released(see: See, driver: Played) -> None:
    see(connected=False)
    assert not see("south").pressed("south")
    assert see("east").buttons == {"east"}
    assert see("south", "east").buttons == {"south", "east"}


def test_an_axis_that_stays_where_it_is_put_blocks_nothing_and_counts_once_it_was_at_neutral(driver: Played) -> None:
    driver.absolute = frozenset({"push_z"})
    driver.shows("l2", push_z=0.7, unknown=("push_z",))
    pad = Gamepad(driver)
    pad.open(0.0)
    seen = []
    for push_z, left_x in ((0.7, 1.0), (0.1, 0.0), (0.8, 0.0)):
        driver.shows(push_z=push_z, left_x=left_x)
        pad.poll_once(driver.reading.t)
        seen.append((pad.state().axis("left_x"), pad.state().axis("push_z") > 0.5))
    assert seen == [(1.0, False), (0.0, False), (0.0, True)]
    driver.shows(connected=False)
    pad.poll_once(driver.reading.t)
    driver.shows(push_z=0.8)
    pad.poll_once(driver.reading.t)
    assert pad.state().axis("push_z") == 0.0, "after a reconnection it has to pass neutral again"


def test_an_unreported_axis_blocks_everything(driver: Played) -> None:
    driver.shows(unknown=("left_x",))
    pad = Gamepad(driver)
    pad.open(0.0)
    driver.shows(unknown=("left_x",), right_x=1.0)
    pad.poll_once(0.1)
    assert pad.waiting_for == ("left_x", "right_x")
    assert pad.state().axis("right_x") == 0.0


def test_after_a_reconnection_sticks_and_dead_man_must_be_released_first(see: See, pad: Gamepad) -> None:
    deadman = pad.hold("l2")
    see()
    assert see(left_y=1.0, l2=1.0).axis("left_y") == 1.0
    assert deadman.held
    state = see(connected=False, left_y=1.0, l2=1.0)  # a driver that forgets to release everything
    assert (state.connected, state.axis("left_y"), deadman.held, deadman.connected) == (False, 0.0, False, False)
    state = see(left_y=1.0, l2=1.0)
    assert (state.connected, state.axis("left_y"), deadman.held, deadman.connected) == (True, 0.0, False, True)
    see(left_y=1.0)
    assert not see(left_y=1.0, l2=1.0).axis("left_y")
    assert not deadman.held
    see()
    assert see(left_y=1.0, l2=1.0).axis("left_y") == 1.0
    assert deadman.held
    assert deadman.record.presses == 2


def test_a_dead_man_on_a_trigger_has_hysteresis_and_one_on_a_button_has_not(see: See, pad: Gamepad) -> None:
    trigger, button = pad.hold("l2"), pad.hold("l1")
    see()
    held = [(see(l2=value), trigger.held)[1] for value in (0.4, 0.6, 0.4, 0.2)]
    assert held == [False, True, True, False]
    see("l1")
    assert (button.held, trigger.held) == (True, False)


def test_a_trigger_that_is_only_a_button_is_a_dead_man_too(driver: Played, pad: Gamepad) -> None:
    deadman = pad.hold("l2")
    pad.poll_once(0.0)
    driver.reading = driver.reading._replace(seq=1, axes={"left_x": 0.0}, buttons=frozenset({"l2"}))
    pad.poll_once(0.1)
    assert deadman.held


def test_the_dead_man_of_a_control_is_one_object_with_the_pads_state(pad: Gamepad) -> None:
    assert pad.hold("l2") is pad.hold("l2")
    assert pad.hold("l1") is not pad.hold("l2")
    assert pad.hold("r1").connected
    with raises_code(DeviceNotFound, "unknown_control"):
        pad.hold("L1")


def test_a_dead_man_created_while_pressed_must_be_released_first(see: See, pad: Gamepad) -> None:
    see("l1")
    deadman = pad.hold("l1")
    assert not deadman.held
    see("l1")
    assert not deadman.held
    see()
    see("l1")
    assert deadman.held


def test_a_release_before_anything_counts_does_not_arm_the_dead_man(driver: Played) -> None:
    driver.shows(left_x=1.0)
    pad = Gamepad(driver)
    pad.open(0.0)
    deadman = pad.hold("l1")
    for buttons, left_x, held in (((), 1.0, False), (("l1",), 0.0, False), ((), 0.0, False), (("l1",), 0.0, True)):
        driver.shows(*buttons, left_x=left_x)
        pad.poll_once(driver.reading.t)
        assert deadman.held is held


def test_the_heartbeat_reaches_the_servo_with_every_poll(see: See, pad: Gamepad, driver: Played) -> None:
    seen: list[float] = []
    pad.hold("l2").attach(lambda record: seen.append(record.t_alive))
    seen.clear()
    for _ in range(3):
        see()
    pad.poll_once(99.0)  # no news from the pad: the record is passed on all the same, with the old time
    assert seen == pytest.approx([0.01, 0.02, 0.03, 0.03])


def test_a_driver_that_fails_is_a_disconnected_pad(see: See, pad: Gamepad, driver: Played) -> None:
    deadman = pad.hold("l2")
    see()
    see(l2=1.0)
    assert deadman.held
    driver.failure = ValueError("garbage on the wire")
    pad.poll_once(1.0)
    assert not pad.state().connected
    assert not deadman.held
    assert pad.error is driver.failure
    driver.failure = None
    state = see(l2=1.0)
    assert state.connected
    assert pad.error is None
    assert not deadman.held


def test_state_is_replaced_only_by_a_change(see: See, pad: Gamepad) -> None:
    state = see("south")
    pad.poll_once(5.0)  # the same reading again
    assert pad.state() is state
    assert see() is not state


def test_only_a_pad_whose_silence_is_noticed_may_guard_a_real_arm(pad_spec: PadSpec, driver: Played) -> None:
    pad = Gamepad(driver)
    pad.hold("l2").check_trust()
    driver.proves_liveness = False
    with raises_code(NotSupported, "deadman_not_trusted"):
        pad.hold("l2").check_trust()
    pad_spec.options["accept_silent_pad"] = True
    pad.hold("l2").check_trust()


def test_distrust_gives_the_reason_and_the_option(pad: Gamepad, driver: Played) -> None:
    assert pad.distrust() is None
    driver.proves_liveness = False
    assert "accept_silent_pad" in str(pad.distrust())


class Shaking(Played):
    """It has motors, and a mapping of its own."""

    mapping = "spacemouse"

    def __init__(self, spec: PadSpec) -> None:
        super().__init__(spec)
        self.rumbles: list[tuple[float, float, float]] = []

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        self.rumbles.append((strong, weak, seconds))
        if self.failure is not None:
            raise self.failure
        return True


def test_a_pad_rumbles_within_what_it_can_and_never_raises(pad_spec: PadSpec, driver: Played) -> None:
    shaking = Shaking(pad_spec)
    pad = Gamepad(shaking)
    assert pad.rumble()
    assert pad.rumble(strong=2.0, weak=-1.0, seconds=1.0)
    assert pad.rumble(strong=math.nan, seconds=math.nan)
    assert shaking.rumbles[1:] == [(1.0, 0.0, 1.0), (0.0, shaking.rumbles[0][1], 0.0)]
    assert all(0.0 <= share <= 1.0 for share in shaking.rumbles[0][:2])
    shaking.failure = OSError(19, "unplugged")
    assert not pad.rumble()
    assert pad.error is shaking.failure
    assert not Gamepad(driver).rumble(), "one without motors"


def test_the_mapping_and_the_axes_of_the_connected_pad(pad_spec: PadSpec, driver: Played) -> None:
    assert Gamepad(driver).mapping is None
    assert Gamepad(Shaking(pad_spec)).mapping == "spacemouse"
    driver.reading = driver.reading._replace(axes={"push_x": 0.0, "left_x": 0.0})
    pad = Gamepad(driver)
    assert pad.reported == ()
    pad.open(0.0)
    assert pad.reported == ("left_x", "push_x")
    assert set(pad.state().axes) == set(AXES), "the others are 0"


def test_a_cap_has_a_dead_zone_like_a_stick(see: See, pad: Gamepad) -> None:
    zone = pad.driver.spec.dead_zone
    assert see(push_x=zone).axis("push_x") == 0.0
    assert see(turn_z=-1.0).axis("turn_z") == -1.0


def test_its_own_thread_polls_it_and_close_ends_the_thread(driver: Played) -> None:
    pad = Gamepad(driver)
    pad.open(0.0)
    pad.start_thread(lambda: driver.reading.t)
    driver.shows("south")
    end = time.monotonic() + 5.0
    while not pad.state().pressed("south"):
        assert time.monotonic() < end
        time.sleep(0.001)
    deadman = pad.hold("l2")
    before = {thread for thread in threading.enumerate() if thread.name == "hal pad pad"}
    assert len(before) == 1
    pad.close()
    pad.close()
    assert not any(thread.is_alive() for thread in before)
    assert driver.closed == 1
    assert not pad.state().connected
    assert not deadman.connected


def test_a_change_sets_the_events_that_wait_for_it(driver: Played, pad: Gamepad) -> None:
    changed = threading.Event()
    pad.wake(changed)
    pad.poll_once(1.0)
    assert not changed.is_set(), "a new time is no change"
    driver.shows("south")
    pad.poll_once(2.0)
    assert changed.is_set()
    changed.clear()
    pad.close()
    assert changed.is_set(), "it is not connected any more"


def test_a_closed_pad_is_not_polled(driver: Played, pad: Gamepad) -> None:
    pad.close()
    driver.shows("south")
    pad.poll_once(1.0)
    assert not pad.state().connected


def test_controls_are_named_as_printed_on_the_pad(
    driver: Played, pad: Gamepad, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [pad.control_name(name) for name in ("l2", "dpad_x", "south")] == ["L2", "D-pad left/right", "south"]
    monkeypatch.setattr(Played, "control_names", {"l2": "LT", "south": "A"})
    assert [pad.control_name(name) for name in ("l2", "r2", "south")] == ["LT", "R2", "A"]


@pytest.mark.parametrize("clock", ["real_time", "lock_step"])
def test_a_program_operates_the_simulated_pad_of_a_rig(clock: str) -> None:
    with hal.open({"gamepads": {"pad": {"sim": True}}}, clock=clock) as rig:
        pad, simulated = rig.gamepads["pad"], rig.driver("pad")
        pad.wake(changed := threading.Event())
        simulated.press("l2")
        if clock == "lock_step":
            rig.clock.sleep(0.1)
        assert changed.wait(5.0)
        assert pad.state().axes["l2"] == 1.0
        assert pad.hold("l2")
        assert "no person holds it" in str(pad.distrust())
