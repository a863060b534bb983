"""The driver of Robotiq grippers: what it writes and when, its units, its faults, and its settings."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from robotiq_kit import FarGripper, emulated_robotiq, robotiq_overrides
from waiting import wait_until

import hal
from hal.config.loader import load
from hal.drivers.robotiq.gripper import RobotiqGripper
from hal.drivers.robotiq.link import Link, Request, Status
from hal.drivers.robotiq.settings import is_emulated
from hal.registry import check_record
from hal.specs import GripperSpec
from hal.types import GripperOutcome

TIOCGEXCL = 0x80045440
"""Of Linux' asm-generic/ioctls.h; the module termios lacks it."""
CLOSE = bytes.fromhex("09 10 03E8 0003 06 0900 00FF FFFF 4229")
CLOSED_ON_AN_OBJECT = bytes.fromhex("09 03 06 B900 00FF BD00 1D7C")
"""Frames of the instruction manual: close at full speed and force, its answer, and a status with gOBJ 2."""


@pytest.fixture
def far() -> Iterator[FarGripper]:
    """An activated gripper whose fingers move with the readings."""
    with emulated_robotiq(paced=False) as far:
        far.driver.open()
        yield far


@pytest.fixture
def taken(far: FarGripper, monkeypatch: pytest.MonkeyPatch) -> list[Request]:
    """What is written to the gripper's registers."""
    requests: list[Request] = []
    take = far.gripper.take
    monkeypatch.setattr(far.gripper, "take", lambda request: (requests.append(request), take(request)))
    return requests


def test_the_frames_are_those_of_the_manual(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    heard: list[bytes] = []

    def answer() -> None:
        while frame := os.read(ours, 256):
            heard.append(frame)
            os.write(ours, CLOSE[:6] + bytes.fromhex("0130") if frame[1] == 16 else CLOSED_ON_AN_OBJECT)

    threading.Thread(target=answer, daemon=True).start()
    spec = load("franka_robotiq", sim=False).resolve().robots[0].gripper
    assert spec is not None
    spec = replace(spec, speed=0.15, options={"model": "2f85", "port": os.ttyname(theirs)})
    driver = RobotiqGripper(spec)
    driver.open()
    driver.move(0.0, 0.15, 235.0)
    reading = driver.read(time.monotonic())
    driver.close()
    assert [frame for frame in heard if frame[1] == 16] == [CLOSE]
    assert (reading.grasped, reading.moving, reading.fault) == (True, False, None)


def test_opening_reading_and_closing_write_nothing(far: FarGripper, taken: list[Request]) -> None:
    far.run(0.1)
    far.driver.stop()
    far.driver.close()
    far.driver.open()
    assert taken == []


@pytest.mark.parametrize(
    ("model", "speed", "force", "registers"),
    [
        ("2f85", 0.020, 20.0, (0, 0)),
        ("2f85", 0.150, 235.0, (255, 255)),
        ("2f85", 0.072, 106.0, (102, 102)),
        ("2f85", 0.001, 1.0, (0, 0)),
        ("2f140", 0.250, 125.0, (255, 255)),
        ("2f140", 0.118, 10.0, (102, 0)),
        ("hand_e", 0.150, 185.0, (255, 255)),
    ],
)
def test_speed_and_force_are_those_of_the_data_sheet(
    far: FarGripper, taken: list[Request], model: str, speed: float, force: float, registers: tuple[int, int]
) -> None:
    far.driver.close()
    spec = far.driver.spec
    driver = RobotiqGripper(replace(spec, speed=1.0, options={**spec.options, "model": model}))
    driver.open()
    driver.move(0.04, speed, force)
    driver.read(time.monotonic())
    driver.close()
    assert (taken[0].sp, taken[0].fr) == registers


def test_a_width_goes_to_counts_and_back(far: FarGripper, taken: list[Request]) -> None:
    width_max, counts = far.driver.spec.width_max, []
    for width in (0.0, 0.02, 0.04, 0.06, width_max):
        far.driver.move(width, 0.1, 60.0)
        reading = far.run(1.5)
        counts.append(taken[-1].pr)
        assert reading.width == pytest.approx(max(width, far.driver.spec.width_min), abs=4e-4)
    assert counts[0] == 255, "closed is beyond where the pads meet, so that they press"
    assert counts == sorted(counts, reverse=True)


def test_counts_of_the_rig_are_those_that_are_used(far: FarGripper, taken: list[Request]) -> None:
    far.driver.close()
    spec = far.driver.spec
    driver = RobotiqGripper(replace(spec, options={**spec.options, "counts": [13, 213]}))
    driver.open()
    driver.move(spec.width_max, 0.1, 60.0)
    driver.read(time.monotonic())
    assert taken[0].pr == 13
    driver.close()


def test_only_home_activates(far: FarGripper, taken: list[Request]) -> None:
    far.gripper.switch_on()
    at = far.run(0.05).width
    far.driver.move(0.02, 0.1, 60.0)
    reading = far.run(0.3)
    assert (reading.outcome, reading.moving, reading.width) == (GripperOutcome.FAILED, False, at)
    assert reading.fault is not None
    assert reading.fault.code == "not_activated"
    assert taken == []
    far.driver.home()
    assert far.run(0.1).moving
    reading = far.run(4.0)
    assert (reading.fault, reading.moving, reading.outcome) == (None, False, None)
    assert [request.act for request in taken] == [0, 1]


def test_home_of_an_active_gripper_moves_nothing(far: FarGripper, taken: list[Request]) -> None:
    far.driver.home()
    assert not far.run(0.1).moving
    assert taken == []


def test_a_stop_ends_an_activation(far: FarGripper, taken: list[Request]) -> None:
    far.gripper.switch_on()
    far.driver.home()
    far.run(0.5)
    far.driver.stop()
    at = far.run(0.05).width
    assert far.run(0.5).width == at
    assert taken[-1].act == 0


def go_silent(far: FarGripper) -> None:
    """Let the driver notice that the line is silent. The fingers wait meanwhile, as until they are back."""
    far.execute("silent on")
    with pytest.raises(hal.ConnectionLost):
        while True:
            far.driver.read(time.monotonic())


def come_back(far: FarGripper) -> None:
    def read() -> bool:
        with contextlib.suppress(hal.ConnectionLost):
            far.driver.read(time.monotonic())
            return True
        return False

    far.execute("reset")
    wait_until(read, "it answers again")


def assert_at_rest(far: FarGripper) -> None:
    at = far.run(0.1).width
    assert far.run(0.5).width == at
    assert not far.run(0.01).moving


def test_a_reset_on_its_way_is_followed_by_no_activation(far: FarGripper, taken: list[Request]) -> None:
    far.gripper.switch_on()
    far.run(0.05)
    far.execute("late 0.02")
    far.driver.home()
    far.driver.stop()
    far.driver.close()
    far.execute("reset")
    far.driver.open()
    assert_at_rest(far)
    assert not any(request.act for request in taken)


def test_a_stop_ends_an_activation_after_a_motion_was_refused(far: FarGripper) -> None:
    far.gripper.switch_on()
    far.driver.home()
    far.run(0.3)
    far.driver.move(0.03, 0.1, 60.0)
    assert far.run(0.05).outcome is GripperOutcome.FAILED
    far.driver.stop()
    assert_at_rest(far)


def test_a_stop_ends_an_activation_whose_line_was_lost(far: FarGripper) -> None:
    far.gripper.switch_on()
    far.driver.home()
    far.run(0.3)
    go_silent(far)
    come_back(far)
    assert far.run(0.01).moving
    far.driver.stop()
    assert_at_rest(far)


def test_what_it_holds_is_never_older_than_its_target(monkeypatch: pytest.MonkeyPatch) -> None:
    old, new, count = (1, 1, 3, 3, 0, 10, 10), (1, 1, 3, 0, 0, 200, 10), itertools.count()

    def read() -> tuple[int, ...]:
        status, question = divmod(next(count), 7)  # it takes a target after each of a status' seven questions once
        return new if question > status else old

    with emulated_robotiq("text", paced=False) as far:
        monkeypatch.setattr(far.gripper, "read", read)
        link, seen = Link("gripper", far.driver.settings), set[Status | None]()
        link.open()
        while len(seen) < 7:
            link.poll()
            seen.add(link.status)
        link.close()
    assert {(status.pr, status.obj) for status in seen if status is not None} == {(10, 3), (10, 0), (200, 0)}


@pytest.mark.parametrize("before", [True, False])
def test_a_stop_reaches_fingers_whose_line_is_lost(far: FarGripper, before: bool) -> None:
    far.driver.move(0.0, 0.02, 60.0)
    far.run(0.2)
    if before:  # nobody knows of the silence yet
        far.execute("silent on")
        far.driver.stop()
    go_silent(far)
    if not before:
        with pytest.raises(hal.ConnectionLost):
            far.driver.stop()
    come_back(far)
    assert_at_rest(far)
    assert far.gripper.width > 0.05


def test_a_command_that_was_lost_fails(far: FarGripper, taken: list[Request]) -> None:
    far.run(0.05)
    far.execute("silent on")
    far.driver.move(0.0, 0.1, 60.0)
    go_silent(far)
    come_back(far)
    reading = far.run(0.05)
    assert (reading.outcome, reading.moving) == (GripperOutcome.FAILED, False)
    assert reading.fault is not None
    assert reading.fault.code == "lost"
    assert taken == []


def test_a_stop_in_every_cycle_does_not_keep_it_from_reading(far: FarGripper) -> None:
    far.driver.move(0.0, 0.02, 60.0)
    far.run(0.2)
    far.execute("late 0.015")
    seq = far.run(0.05).seq
    for _ in range(20):
        far.driver.stop()
        reading = far.run(0.01)
    assert reading.seq > seq + 2
    assert not reading.moving


def test_an_activation_that_is_blocked_fails(far: FarGripper) -> None:
    far.gripper.switch_on()
    far.gripper.blocked = True
    far.driver.home()
    wait_until(lambda: far.run(0.01).outcome is GripperOutcome.FAILED, "it failed")
    fault = far.run(0.01).fault
    assert fault is not None
    assert fault.code == "activation_failed"
    far.gripper.blocked = False
    far.driver.home()
    assert far.run(4.0).fault is None


def test_a_stop_of_fingers_that_hold_writes_nothing(far: FarGripper, taken: list[Request]) -> None:
    far.execute("object 0.03")
    far.driver.move(0.0, 0.1, 100.0)
    assert far.run(1.0).grasped
    written = list(taken)
    far.driver.stop()
    far.run(0.1)
    far.driver.close()
    assert taken == written
    assert far.gripper.force == pytest.approx(100.0, abs=1.0)


def test_close_stops_moving_fingers(far: FarGripper) -> None:
    far.driver.move(0.0, 0.02, 60.0)
    far.run(0.2)
    far.driver.close()
    at = far.gripper.width
    far.emulator.advance(0.25)
    assert 0.05 < at == far.gripper.width


def test_a_lost_object_is_no_grasp(far: FarGripper) -> None:
    far.execute("object 0.03")
    far.driver.move(0.0, 0.1, 100.0)
    assert far.run(1.0).grasped
    far.execute("object none")
    assert far.run(1.0).grasped is False


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("8", "too_hot"),
        ("A", "low_voltage"),
        ("B", "releasing"),
        ("C", "internal"),
        ("D", "activation_failed"),
        ("E", "overcurrent"),
        ("F", "released"),
    ],
)
def test_a_fault_has_a_name_and_a_remedy(far: FarGripper, code: str, name: str) -> None:
    far.driver.move(0.0, 0.05, 60.0)
    far.run(0.1)
    far.execute(f"fault {code}")
    wait_until(lambda: far.run(0.01).outcome is GripperOutcome.FAILED, "it failed")
    reading = far.run(0.01)
    assert reading.fault is not None
    assert (reading.fault.code, bool(reading.fault.remedy)) == (name, True)
    far.execute("fault 0")
    far.driver.home()
    assert far.run(4.0).fault is None


def test_the_line_is_checked_before_it_is_opened() -> None:
    def problems(**options: object) -> set[str]:
        spec = GripperSpec("arm.gripper", "robotiq", 0.085, 0.1, 60.0, options={"model": "2f85", **options})
        return {key for key, _, _ in check_record("robotiq", "gripper", spec)}

    assert problems(port="/dev/ttyUSB0") == problems(host="192.168.0.2") == set()
    assert problems() == problems(port="/dev/ttyUSB0", host="192.168.0.2") == {"real.port"}
    assert problems(host="192.168.0.2:63352") == {"real.host"}
    assert problems(port="a", slave=0) == {"real.slave"}
    assert problems(port="a", counts=[200, 100]) == {"real.counts"}
    assert problems(port="a", model="3f") == {"real.model"}


def test_a_missing_line_is_an_error_with_a_remedy(far: FarGripper) -> None:
    spec = far.driver.spec
    words = {"/no/such": "plug in", "/no/such.emulated": "hal emulate", "/dev/null": "no serial line"}
    for port, word in words.items():
        driver = RobotiqGripper(replace(spec, options={"model": "2f85", "port": port}))
        with pytest.raises(hal.ConnectionLost, match=word):
            driver.open()


def test_the_emulated_line_is_free_after_a_close(far: FarGripper) -> None:
    """For users who are not root, who cannot open a line that is taken."""
    far.run(0.05)
    far.driver.close()
    line = os.open(str(far.driver.settings.port), os.O_RDWR | os.O_NOCTTY)
    taken = fcntl.ioctl(line, TIOCGEXCL, bytes(4))
    os.close(line)
    assert not any(taken)


def test_only_an_emulator_counts_as_emulated() -> None:
    assert is_emulated({"port": "/tmp/robotiq.emulated"})
    assert is_emulated({"host": "127.0.0.2"})
    assert is_emulated({"host": "localhost."})
    assert not is_emulated({"port": "/dev/pts/3"}), "a pseudo terminal may lead to a real one"
    assert not is_emulated({"host": "192.168.0.2"})
    assert load("franka_robotiq", sim=False, overrides=robotiq_overrides()).resolve().robots[0].emulated
