"""A leader on a servo bus: what it reads, what it refuses, and that it never writes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from time import monotonic
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from servo_bus_kit import SteppedServos, so101_leader
from waiting import wait_until

import hal
from hal.config import load
from hal.driver import PadReading
from hal.drivers.servo_bus import bus
from hal.drivers.servo_bus.leader import ServoLeader
from hal.errors import ConfigError
from hal.leader import Leader
from hal.lock import DeviceLock
from hal.preflight import preflight
from hal_emulators.servo_bus.server import ServoBusEmulator, find_arms, find_leaders

Q = [0.3, -0.4, 0.5, 0.2, -1.0]


@pytest.fixture
def far() -> Iterator[SteppedServos]:
    with SteppedServos() as emulator:
        emulator.arm.place(Q)
        yield emulator


@pytest.fixture
def leader(far: SteppedServos) -> Iterator[ServoLeader]:
    with closing(so101_leader(far)) as driver:
        driver.open()
        yield driver


def poll(leader: ServoLeader) -> PadReading:
    return leader.poll(monotonic(), 0.0)


def test_it_reads_joints_and_lever_and_writes_nothing(far: SteppedServos, leader: ServoLeader) -> None:
    before = {id: bytes(servo.registers[:56]) for id, servo in {servo.id: servo for servo in far.arm.servos}.items()}
    assert poll(leader).joints == pytest.approx(Q, abs=0.001)
    far.execute("hand 0.1 0 0 0.1 0 0 1")
    far.advance(0.2)
    reading = poll(leader)
    assert reading.joints == pytest.approx([0, 0, 0.1, 0, 0], abs=0.001)
    assert reading.axes["r2"] == pytest.approx(1.0, abs=0.01)
    leader.close()
    assert {
        id: bytes(servo.registers[:56]) for id, servo in {servo.id: servo for servo in far.arm.servos}.items()
    } == before


@pytest.mark.parametrize(
    ("command", "cause"),
    [
        ("register 2 40 1", "shoulder_lift (motor 2) has torque"),
        ("register 3 3 1234", "elbow_flex (motor 3): is of the model 1234"),
        ("register 6 11 4095", "the lever (motor 6): its range is"),
        ("silent 4 on", "no answer from wrist_flex (motor 4)"),
        ("unplug on", "no SO-101 leader at "),
    ],
)
def test_what_is_no_leader_is_refused_by_name(
    command: str, cause: str, far: SteppedServos, leader: ServoLeader
) -> None:
    far.execute(command)
    far.advance(0.01)
    assert not poll(leader).connected
    assert cause in leader.describe()
    assert leader.notes == (f"lead: {leader.describe().partition(': ')[2]}",)


def test_a_port_that_another_program_uses_is_left_to_it(far: SteppedServos, leader: ServoLeader) -> None:
    lock = DeviceLock(f"servo-bus-{os.path.realpath(far.arm.port)}", "the servo bus", 0.1)
    with patch.object(bus, "_PATIENCE", 0.0):
        assert not poll(leader).connected
    assert "in use" in leader.describe()
    lock.release()
    assert leader.poll(monotonic() + 1.0, 0.0).connected


def test_a_gello_is_read_by_its_own_signs_offsets_and_trigger(tmp_path: Path) -> None:
    """Its motors are mounted anywhere, and one counts turns."""
    signs, port = (1, -1, 1, 1, 1, -1, 1), str(tmp_path / "gello.emulated")
    entry = {"model": "gello_franka", "port": port, "offsets": [math.pi] * 7, "options": {"lever_deg": [223, 180]}}
    rig = {"leaders": {"lead": entry}}
    with ServoBusEmulator(find_leaders(rig), paced=False) as far, patch.multiple(bus, _ANSWER=2.0):
        far.arms["lead"].place([0.2, -0.5, 0.1, -2.0, 0.3, 1.8, 0.7])
        with closing(ServoLeader(load(rig).resolve().pads[0])) as leader:
            leader.open()
            reading = poll(leader)
            led = [sign * q for sign, q in zip(signs, (0.2, -0.5, 0.1, -2.0, 0.3, 1.8, 0.7), strict=True)]
            led[5] += 2 * math.pi  # the turn nearest to 1.571
            assert leader.describe() == f"GELLO for a Franka at {port}"
            assert reading.joints == pytest.approx(led, abs=0.002)
            far.execute("turn 2 1")
            far.execute("hand 0.1 0.2 -0.5 0.1 -2.0 0.3 1.8 0.8 0.5")
            far.advance(0.12)
            later = poll(leader)
            assert later.joints == pytest.approx([*led[:6], 0.8], abs=0.002)
            assert later.axes["r2"] == pytest.approx(0.5, abs=0.02)


def test_a_rate_at_which_a_reading_takes_too_long_is_refused() -> None:
    rig = {"leaders": {"lead": {"model": "gello_franka", "port": "/dev/lead", "options": {"baud": 57_600}}}}
    with pytest.raises(ConfigError, match="57600 bit/s is too slow: a reading of 8 motors takes 82 ms, at most 8 are"):
        load(rig)


def test_a_leader_is_emulated_beside_an_arm_that_has_no_port() -> None:
    rig = {"robots": {"arm": {"model": "so101"}}, "leaders": {"lead": {"model": "so101_leader", "port": "/dev/lead"}}}
    assert (find_arms(rig), [arm.name for arm in find_leaders(rig)]) == ([], ["lead"])
    with pytest.raises(ConfigError, match=r"robots.arm.real.port: is missing"):
        find_arms(rig | {"leaders": {}})


class Follower:
    """A leader that may follow, and an arm at :data:`Q`, from which it is away."""

    def __init__(self, far: SteppedServos, leader: ServoLeader) -> None:
        self.far, self.leader, self.now = far, leader, 1000.0
        leader.open()

    def run(self, turns: int, wanted: Sequence[float] | None = None, until: Callable[[], bool] = lambda: False) -> bool:
        """Let it follow for some turns of 10 ms, at most until something is true, and return whether that is."""
        for _ in range(turns):
            self.leader.follow(wanted)
            self.turn()
            if until():
                return True
        return False

    def turn(self) -> None:
        """Let 10 ms pass."""
        self.far.advance(0.01)
        self.now += 0.01
        self.leader.poll(self.now, 0.0)

    def on(self) -> list[bool]:
        return self.far.execute("state")["on"]


@pytest.fixture
def follower(far: SteppedServos) -> Iterator[Follower]:
    with closing(so101_leader(far, follow=0.3, lever="deadman")) as driver:
        yield Follower(far, driver)


AWAY = [0.1, -0.2, 0.3, 0.4, -0.8]


def test_a_leader_follows_the_arm_slowly_and_with_little_torque_and_is_let_go_at_once(follower: Follower) -> None:
    follower.far.execute(f"hand 0.1 {' '.join(map(str, Q))}")
    follower.run(100)
    assert not any(follower.on()), "as long as no policy drives"
    assert follower.run(20, AWAY, lambda: all(follower.on()[:-1]))
    follower.run(150, AWAY)
    state = follower.far.execute("state")
    assert state["q"] == pytest.approx(AWAY, abs=0.1), "a weak motor sags"
    assert state["limits"][:5] == [300] * 5
    assert max(state["peak_speed"]) < 1.0
    assert not state["on"][5], "the lever"
    assert follower.leader.poll(follower.now, 0.0).joints == pytest.approx(state["q"], abs=0.01)
    assert follower.run(2, None, lambda: not any(follower.on()))
    follower.run(50)
    assert follower.far.execute("state")["q"] == pytest.approx(state["q"], abs=0.02), "the hand holds it"
    assert follower.run(20, Q, lambda: all(follower.on()[:-1]))
    wait_until(lambda: follower.turn() is None and not any(follower.on()), "nobody gave it more to follow")


def test_a_leader_is_let_go_when_it_is_closed_and_when_a_motor_is_silent(follower: Follower) -> None:
    assert follower.run(20, AWAY, lambda: all(follower.on()[:-1]))
    follower.far.execute("silent 2 on")
    with patch.object(bus, "_ANSWER", 0.05):
        assert follower.run(40, AWAY, lambda: follower.on() == [False, True, False, False, False, False])
    follower.far.execute("silent 2 off")
    assert follower.run(100, None, lambda: not any(follower.on())), "that motor, too, once it answers"
    assert follower.run(60, AWAY, lambda: all(follower.on()[:-1]))
    follower.leader.close()
    assert not any(follower.on())


def test_a_leader_that_gets_no_torque_says_which_joint_is_outside_of_its_range(follower: Follower) -> None:
    """A motor of one turn takes no goal there, so that it would leap to the end of its range."""
    follower.far.execute("register 2 9 2047")  # its range now begins above where it is
    assert not follower.run(30, AWAY, lambda: any(follower.on()))
    assert "without torque: shoulder_lift (motor 2) is outside" in follower.leader.describe()
    follower.leader.close()
    entry = {"model": "so101_leader", "port": follower.far.arm.port, "follow": 0.3, "lever": "deadman"}
    (result,) = preflight(load({"leaders": {"lead": entry}}).resolve(), 0.05, machine=False)
    assert (result.level, "shoulder_lift" in result.found, "by hand" in result.remedy) == ("warn", True, True)
    follower.leader.open()
    follower.far.execute(f"hand 0.1 0 0.1 {' '.join(map(str, Q[2:]))}")
    assert follower.run(60, AWAY, lambda: all(follower.on()[:-1])), "inside"
    assert "torque" not in follower.leader.describe()


def test_a_leader_that_may_not_follow_never_has_torque(far: SteppedServos, follower: Follower) -> None:
    follower.far.execute("register 1 40 1")  # by another program
    assert not follower.run(30, AWAY, lambda: follower.leader.poll(follower.now, 0.0).connected)
    assert "shoulder_pan (motor 1) has torque" in follower.leader.describe()
    with closing(so101_leader(far)) as driver:
        follower.leader.close()
        follower.far.execute("register 1 40 0")
        other = Follower(far, driver)
        assert not other.run(30, AWAY, lambda: any(other.on()))
    with pytest.raises(ConfigError, match="leaders.lead.follow: needs a dead-man"):
        so101_leader(far, follow=0.3)
    with pytest.raises(ConfigError, match="leaders.lead.feedback: a Feetech motor has no"):
        so101_leader(far, feedback=0.3, lever="deadman")


def test_the_hand_feels_a_bounded_share_of_the_arms_external_torques_while_it_leads(tmp_path: Path) -> None:
    """From ``hal.open`` to the goals of the leader's motors: by its signs; none before, after, and once it is lost."""
    leader = {"model": "gello_franka", "port": str(tmp_path / "gello.emulated"), "options": {"lever_deg": [223, 180]}}
    arm = {"model": "panda", "drivers": {"sim": "mock"}}
    rig = {"sim": True, "robots": {"arm": arm}, "gamepads": {"pad": {"sim": True}}}
    rig["leaders"] = {"lead": leader | {"feedback": 0.1}}
    with (
        ServoBusEmulator(find_leaders(rig), paced=False) as far,
        patch.multiple(bus, _ANSWER=2.0),
        hal.open(rig, clock="lock_step") as opened,
    ):
        robot, pad = opened.robots["arm"], opened.driver("pad")
        far.execute("hand 0.1 0 0.3 0 -1.9 0 1.6 0")
        session = hal.TeleopSession(opened, [robot])
        far.arms["lead"].plant.step = lambda dt, drives: None  # a hand that holds it firmly

        def drive(seconds: float, turn: Callable[[], object] = lambda: None) -> dict[str, Any]:
            """Drive for some time, and return the state of the leader."""
            end = opened.clock.now() + seconds

            def until(_: hal.PadState) -> str:
                turn()
                far.advance(0.01)
                return "over" if opened.clock.now() > end else ""

            session.run(until)
            return far.execute("state")

        def note() -> None:
            state = far.execute("state")
            if all(state["on"][:7]):
                seen.append([goal - count for count, goal in zip(state["counts"], state["goals"], strict=True)])
            else:
                seen.clear()  # also where this computer was too late for the torques, which begin anew

        seen: list[list[int]] = []
        opened.driver("arm").inject(tau_ext=[6.0, 0.0, 0.0, 0.0, 0.0, 6.0, 500.0])
        assert not any(drive(0.3)["on"]), "it does not lead yet"
        state = drive(0.6, lambda: (pad.press("l2"), note()))
        assert state["limits"][:7] == [266] * 7, "the motors themselves keep to 0.3 of their torque"
        assert not state["on"][7], "the lever"
        pushes = seen[-1]
        counts, most = 885 * 128 / 800 / 10.6, 0.3 * 885 * 128 / 800  # for 1 Nm of an XM540, and at most
        assert pushes[0] == pytest.approx(0.6 * counts, abs=1), "0.1 of 6 Nm"
        assert pushes[5] == pytest.approx(-0.6 * counts, abs=1), "this joint's sign is -1"
        assert pushes[6] == pytest.approx(most, abs=1)
        assert max(abs(b[6] - a[6]) for a, b in pairwise(seen)) < 0.5 * most, "no leap"
        assert not any(drive(0.1, lambda: pad.release("l2"))["on"]), "it does not lead any more"
        held: list[bool] = []

        def lose_torques() -> None:
            pad.press("l2")
            held.append(all(far.execute("state")["on"][:7]))
            if held[-1]:
                opened.driver("arm").inject(tau_ext=None)

        assert not any(drive(0.6, lose_torques)["on"]), "no torques are known"
        assert any(held)
        pad.release("l2")
        drive(0.1)
        opened.driver("arm").inject(tau_ext=[3.0] * 7)
        assert all(drive(0.6, lambda: pad.press("l2"))["on"][:7])
        far.execute("unplug on")
        drive(0.1)
        assert not opened.gamepads["lead"].state().connected
        pad.release("l2")
        far.execute("unplug off")
        assert not any(drive(1.0)["on"]), "plugged in again"
        assert all(drive(0.6, lambda: pad.press("l2"))["on"][:7])
    assert not any(far.execute("state")["on"]), "the program ended"


def test_an_emulated_leader_may_not_lead_a_real_arm(leader: ServoLeader) -> None:
    assert "no person holds it" in str(Leader(leader).distrust())


def test_the_hand_moves_motors_without_torque_only(far: SteppedServos) -> None:
    far.execute("register 1 40 1")
    with pytest.raises(ValueError, match="have torque"):
        far.execute("hand 1 0 0 0 0 0")
    far.execute("register 1 40 0")
    far.execute("hand 0.2 0 0 0 0 0")
    far.execute("hand 0.2 0.1 0 0 0 0 0.5")
    far.advance(0.2)
    assert far.arm.plant.q == pytest.approx(np.zeros(5), abs=1e-3)
    far.advance(0.2)
    assert far.arm.plant.q == pytest.approx([0.1, 0, 0, 0, 0], abs=1e-3)
