"""Every fault that the emulator can inject: the app's error, its delay, the state of the arm, and how to continue.

pytest -s tests/wire/test_franka_faults.py      # prints the table of docs/measured.md
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from waiting import wait_until

import hal
from hal.rig import Rig
from hal.types import RobotStatus

from .franka_kit import Emulator
from .rig_kit import Drive, arm_of, rig_of, settled

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytestmark = pytest.mark.pair

DOCS = Path(__file__).parents[2] / "docs" / "measured.md"


@dataclass(frozen=True)
class Case:
    """One fault command."""

    command: str
    error: type[Exception]
    says: str
    """In the error's text."""
    status: RobotStatus
    """Status of the arm afterwards."""
    within: float
    """Longest time from the command to the app's error, s, with a large margin."""
    undo: str = ""
    """Command that ends the fault, if it does not end by itself."""
    recover: bool = True
    """Whether recover() is required."""

    @property
    def name(self) -> str:
        return self.command


CASES = (
    Case("reflex joint_reflex", hal.RobotFault, "joint", RobotStatus.FAULT, 1.0),
    Case("reflex cartesian_reflex", hal.RobotFault, "", RobotStatus.FAULT, 1.0),
    Case("reflex communication_constraints_violation", hal.RobotFault, "in a row", RobotStatus.FAULT, 1.0),
    Case("user-stop on", hal.RobotFault, "user stop", RobotStatus.FAULT, 1.0, undo="user-stop off", recover=False),
    Case("emergency-stop on", hal.RobotFault, "", RobotStatus.FAULT, 1.0, undo="emergency-stop off", recover=False),
    Case("silence 0.5", hal.RobotFault, "in a row", RobotStatus.FAULT, 2.0),
    Case("silence 2", hal.MotionStopped, "no state", RobotStatus.LOST, 3.0),
    Case("lose-commands 1", hal.RobotFault, "in a row", RobotStatus.FAULT, 1.0, undo="lose-commands 0"),
    Case("truncate on", hal.MotionStopped, "packets", RobotStatus.LOST, 2.0, undo="truncate off", recover=False),
    Case("report-lag 9", hal.RobotFault, "was sent", RobotStatus.FAULT, 1.0, undo="report-lag 0"),
    Case("report-noise 0.01", hal.RobotFault, "reported", RobotStatus.FAULT, 1.0, undo="report-noise 0"),
    Case("restart 0.3", hal.MotionStopped, "", RobotStatus.LOST, 3.0, recover=False),
)


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    # It waits for a set-point that is late: a busy machine must not look like a fault of the arm.
    with Emulator("--lockstep") as started:
        yield started


@pytest.fixture(scope="module")
def rig(emulator: Emulator) -> Iterator[Rig]:
    with rig_of(emulator.host) as opened:
        yield opened


@pytest.fixture(scope="module")
def table() -> Iterator[list[str]]:
    rows: list[str] = []
    yield rows
    print("\n| fault | the app gets | after | state of the arm | to continue |\n|---|---|---|---|---|")
    print("\n".join(rows))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.command)
def test_a_fault_is_named_and_the_arm_can_continue(emulator: Emulator, rig: Rig, case: Case, table: list[str]) -> None:
    arm = arm_of(rig)
    drive = Drive(arm)
    struck: list[float] = []

    def strike() -> None:
        wait_until(lambda: drive.error is not None or abs(arm.state(5.0).tcp_twist[1]) > 0.03, "moving")
        struck.append(time.monotonic())
        emulator.control.send(case.command)

    striker = threading.Thread(target=strike)
    striker.start()
    drive.go(rig, 10.0)
    striker.join()
    assert struck, drive.error
    error = drive.error
    assert isinstance(error, case.error), f"{type(error).__name__}: {error}"
    assert case.says in str(error)
    took = drive.t_error - struck[0]
    assert 0.0 < took < case.within
    if case.status is not RobotStatus.LOST:
        assert settled(arm).status is case.status
    if case.undo:
        emulator.control.send(case.undo)
    if case.recover:
        wait_until(lambda: recovered(arm), "recovered")
    wait_until(lambda: is_well(arm), "well again")
    again = Drive(arm)
    again.go(rig, 0.5)
    assert again.error is None, again.error
    assert "success" in emulator.events("motion ended")[-1]["text"]
    named = f"{case.error.__name__}: {str(error).partition(';')[0]}"
    if drive.t_stale:
        named = f"StaleStateError after {1e3 * (drive.t_stale - struck[0]):.0f} ms, then {named}"
    how = [f"`{case.undo}`"] if case.undo else []
    how += ["`recover()`"] if case.recover else ([] if case.undo else ["by itself"])
    table.append(f"| `{case.command}` | {named} | {1e3 * took:.0f} ms | {case.status} | {', '.join(how)} |")


def recovered(arm: hal.Robot) -> bool:
    try:
        arm.recover()
    except (hal.RobotFault, hal.ConnectionLost):
        return False
    assert arm.state().fault is None, "what is read after recover() is newer than it"
    return True


def is_well(arm: hal.Robot) -> bool:
    try:
        return arm.state().status is RobotStatus.IDLE
    except hal.HalError:
        return False


def test_an_arm_does_not_continue_by_itself(emulator: Emulator, rig: Rig) -> None:
    """A session that is open while the arm is in reflex and recovers stays stopped until it is armed again."""
    arm = arm_of(rig)
    with arm.control(rate_hz=10, unattended=True) as control:
        moving = False
        for _ in rig.clock.rate(50):
            control.send(hal.Twist([0.0, 0.05, 0.0]))
            moving = moving or abs(arm.state().tcp_twist[1]) > 0.03
            if moving:
                break
        emulator.control.send("reflex joint_reflex")
        wait_until(lambda: arm.state().status is RobotStatus.FAULT, "faulty")
        arm.recover()
        wait_until(lambda: arm.state().fault is None, "recovered")
        before = arm.state().q
        with pytest.raises(hal.HalError):
            for tick in rig.clock.rate(50):
                control.send(hal.Twist([0.0, 0.05, 0.0]))
                assert tick.t
        assert abs(arm.state().q - before).max() < 1e-3
        control.rearm()
        for _ in zip(range(40), rig.clock.rate(50), strict=False):
            control.send(hal.Twist([0.0, 0.05, 0.0]))
        assert abs(arm.state().q - before).max() > 1e-3, "after rearm() it continues"


def test_the_docs_list_every_fault() -> None:
    text = DOCS.read_text()
    missing = [case.command for case in CASES if f"`{case.command}`" not in text]
    assert not missing
