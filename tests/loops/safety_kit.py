"""The rows of docs/safety.md, what each trip of a mock arm is caused by, and which tests show a row."""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
from loop_kit import TURN, Loop, driving, mock_rig

import hal
from hal import JointTorque, Trip

ROOT = Path(__file__).parents[2]
TICK = 1 / 240
"""Period of the mock arm's servo, s."""
BROWSER, SYSTEM, WIRE = "tests/browser/test_", "tests/system/test_", "tests/wire/test_"
CAN, ARMS = "tests/lock_step/test_can_faults.py::test_", "tests/unit/core/test_session_arms.py::test_"
ELSEWHERE = {
    "the console's browser freezes": (f"{BROWSER}trips.py", f"{BROWSER}pages.py"),
    "a [leader arm](leaders.md) is unplugged": (
        "tests/unit/core/test_leader.py::test_a_leader_that_is_lost_while_the_pad_is_held_stops_the_arm_within_150_ms",
    ),
    "another arm of the same `hal teleop`": (
        f"{ARMS}a_trip_of_one_arm_holds_the_other_until_a_new_press_of_its_own",
        f"{ARMS}independent_arms_do_not_stop_each_other",
    ),
    "your loop is too slow or hangs": (f"{SYSTEM}ends.py::test_user_code_that_goes_wrong",),
    "the app is killed": (
        f"{SYSTEM}ends.py::test_an_app_that_ends",
        f"{WIRE}ur_rig.py::test_the_arm_stands_when_the_app_is_killed",
        f"{WIRE}xarm_rig.py::test_the_arm_stands_when_the_app_is_killed",
    ),
    "the [link](several-machines.md) to the computer": (
        f"{SYSTEM}remote.py::test_a_link_that_stalls_stops_the_arm_until_it_is_acknowledged",
        f"{SYSTEM}remote.py::test_a_server_that_freezes_or_is_killed_moves_the_arm_only_after_a_new_press_or_session",
    ),
    "that link is cut": (
        f"{SYSTEM}remote.py::test_a_link_that_is_lost_ends_the_program_and_a_new_one_moves_nothing_by_itself",
        f"{SYSTEM}remote.py::test_a_program_that_freezes_or_is_killed",
        f"{SYSTEM}keys.py::test_keys_from_the_command_line_and_certificates_that_are_revoked_and_expire",
        f"{SYSTEM}remote.py::test_a_server_whose_host_is_killed_ends_and_the_next_call_says_so",
    ),
    "a computer that has sent nothing over": ("tests/unit/remote/test_link.py::test_a_silent_end_is_gone",),
    "longest round trip of a link": (f"{SYSTEM}remote.py::test_a_link_with_a_long_round_trip_opens_no_session",),
    "the host's process dies": (f"{SYSTEM}real_time.py::test_a_host_that_is_killed_is_told_by_the_next_call",),
    "a Franka ends the motion": (f"{WIRE}franka_faults.py", f"{WIRE}franka_stops.py"),
    "a Franka's set-points or states": (f"{WIRE}franka_tour.py::test_packets_that_are_lost_end_no_motion",),
    "the app of a Franka is killed": (f"{WIRE}franka_ends.py::test_an_app_is_killed_while_the_robot_hangs",),
    "a UR stops": (f"{WIRE}ur_faults.py::test_a_fault_in_motion_is_named_and_the_arm_continues_after_recover",),
    "the host of a UR dies": (
        f"{WIRE}ur_rig.py::test_the_controller_stops_its_program_when_the_host_is_killed",
        f"{WIRE}ur_rig.py::test_the_arm_stands_150_ms_after_the_last_message",
        f"{WIRE}ur_faults.py::test_a_fault_in_motion_is_named_and_the_arm_continues_after_recover",
    ),
    "a UFACTORY arm stops": (
        f"{WIRE}xarm_faults.py::test_a_fault_in_motion_is_named_and_the_arm_continues_after_recover",
    ),
    "the host of a UFACTORY arm dies": (
        f"{WIRE}xarm_rig.py::test_the_arm_stands_at_its_last_set_point_when_the_host_is_killed",
        f"{WIRE}xarm_rig.py::test_the_arm_stands_while_the_host_is_frozen_and_continues_without_a_jump",
        f"{WIRE}xarm_faults.py::test_a_fault_in_motion_is_named_and_the_arm_continues_after_recover",
    ),
    "the host of an arm with Damiao": (f"{WIRE}can_gravity.py::test_an_arm_without_its_program_sinks_slowly",),
    "an arm with Damiao motors is closed": (
        f"{CAN}close_lowers_a_raised_arm_slowly_and_never_drops_it",
        f"{CAN}a_gripper_holds_while_its_arm_sinks",
    ),
    "the host of a PiPER dies": (
        f"{WIRE}piper_rig.py::test_an_arm_whose_program_ends_holds",
        f"{WIRE}piper_rig.py::test_a_bus_that_is_cut_stops_the_program_and_comes_back",
    ),
    "the host of an arm on a servo bus": (f"{WIRE}servo_bus_rig.py::test_an_arm_whose_program_is_killed_holds",),
    "the host of a ViperX freezes": (
        "tests/unit/drivers/servo_bus/test_servo_bus.py::test_a_motor_stops_when_it_hears_nothing_and_is_switched_on_anew",
    ),
    "a servo of a bus reports a fault": (f"{WIRE}servo_bus_rig.py::test_a_fault_of_bus_or_motor",),
    "a motor or joint on a CAN bus": (f"{CAN}a_fault_in_motion",),
    "the process of a Robotiq gripper dies": (
        f"{WIRE}robotiq.py::test_the_gripper_keeps_its_grip_when_its_process_is_killed",
        f"{WIRE}robotiq.py::test_a_line_that_is_gone_is_known_soon_and_comes_back",
    ),
    "a Robotiq gripper was without power": ("tests/unit/drivers/robotiq/test_robotiq.py::test_only_home_activates",),
    "a stop, or a released dead-man, while a gripper does not answer": (
        f"{WIRE}franka_hand.py::test_fingers_hear_a_stop_that_came_while_the_connection_was_lost",
        f"{WIRE}xarm_rig.py::test_a_gripper_hears_a_stop_that_came_while_it_did_not_answer",
    ),
    "the process of a gripper dies": (
        f"{SYSTEM}gripper_process.py::test_an_arm_does_not_wait_for_a_gripper_that_is_slow_or_dead",
    ),
}
"""How a row begins -> the tests that show it through ``hal.open`` or an emulator."""
SHOWN = set(ELSEWHERE)
"""How each row begins that has a test."""


def shows(*rows: str) -> Callable[[Any], Any]:
    """Note which rows a test shows, by how they begin."""
    SHOWN.update(rows)
    return lambda test: test


def check_rows() -> None:
    """Assert that each row of the page's tables has a test, and each test a row."""
    text = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    rows = []
    for heading in ("The numbers", "Trips and how to continue", "Events and their effects"):
        section = text.split(f"## {heading}\n")[1].split("\n## ")[0]
        rows += [line.strip("| ").split(" |")[0] for line in re.findall(r"^\|.*\|$", section, re.MULTILINE)[2:]]
    assert len(rows) > 50
    found = {row: [begin for begin in SHOWN if row.startswith(begin)] for row in rows}
    assert [row for row, begins in found.items() if len(begins) != 1] == [], "rows without a test"
    assert SHOWN - {begins[0] for begins in found.values()} == set(), "tests without a row"
    for place in itertools.chain(*ELSEWHERE.values()):
        file, _, name = place.partition("::")
        assert f"def {name}" in (ROOT / file).read_text(encoding="utf-8"), place


@dataclass(frozen=True)
class Stop:
    """A cause of a trip."""

    name: str
    trip: Trip
    begin: Callable[[Loop], object]
    end: Callable[[Loop], object] | None = None
    """What ends the cause; None where it is over by itself."""
    after: float = TICK
    """Time from the event to the stop, at most, s; at least 15 ms less."""
    deadman: bool | None = None
    """Whether it needs a session with a dead-man; None for both kinds."""
    command: hal.Command = TURN
    rig: dict[str, Any] = field(default_factory=dict)

    def start(self, deadman: bool, **more: Any) -> Any:
        """Return a program in motion."""
        return driving(deadman=deadman, command=self.command, **self.rig, **more)


def stop_from_a_thread(loop: Loop) -> None:
    """Stop the rig in another thread."""
    thread = threading.Thread(target=loop.rig.stop)
    thread.start()
    thread.join()


def inject(device: str = "arm", **faults: Any) -> Callable[[Loop], object]:
    """Return a function that injects faults into the arm, or the ``pad``."""
    return lambda loop: getattr(loop, device).inject(**faults)


def report(**fields: Any) -> Callable[[Loop], object]:
    """Return a function that lets the arm report these instead of its own."""
    return lambda loop: loop.alter(lambda reading: reading._replace(**fields))


def report_nonsense(loop: Loop) -> None:
    """Let the arm report set-points that it was not given."""
    numbers = itertools.cycle([0.01, -0.01, 0.006, -0.008, 0.009])
    loop.alter(lambda reading: reading._replace(q_commanded=[x + next(numbers) for x in reading.q_commanded]))


def recover(loop: Loop) -> None:
    """Let the arm report the truth, and clear its fault."""
    loop.restore()
    loop.arm.recover()
    loop.wait(0.05)


def report_truth(loop: Loop) -> None:
    """End every kind of invalid reading."""
    loop.arm.inject(garbage=None)
    loop.restore()


def push(change: Callable[[Any], Any]) -> Callable[[Loop], object]:
    """Return a function that changes the torques which drive the mock arm's joints."""

    def begin(loop: Loop) -> None:
        driven = type(loop.device)._driven.__get__(loop.device)
        loop.device._driven = lambda tau, dt: driven(change(tau), dt)  # type: ignore[method-assign]

    return begin


def let_go(loop: Loop) -> None:
    """End a push."""
    loop.device.__dict__.pop("_driven", None)


def turn_back(loop: Loop) -> None:
    """Drive the other way."""
    loop.command = JointTorque([-5.0] + [0.0] * 6)


HOME = (-0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
PUSHING = JointTorque([3.0] + [0.0] * 6)
NONSENSE = {
    "too few": inject(garbage="short"),
    "nan": inject(garbage="nan"),
    "inf": inject(garbage="inf"),
    "beyond the range": report(q=(2.8973 + 1.01, *HOME)),
    "too fast": report(dq=(1001.0, *[0.0] * 6)),
    # Also in what the servo does not need: a reading with such a number is not one.
    **{
        f"{name}: {value}": report(**{name: (value, *[0.0] * (5 if name == "wrench_ext" else 6))})
        for name in ("dq", "q_commanded", "dq_commanded", "tau", "tau_ext", "wrench_ext")
        for value in (nan, inf)
    },
}
STOPS = (
    Stop("no command", Trip.COMMAND_LATE, lambda loop: loop.wait(0.3), None, 0.08 + TICK),
    Stop("a frozen pad", Trip.DEADMAN_SILENT, inject("pad", freeze=True), inject("pad", freeze=False), 0.12, True),
    Stop("no pad", Trip.DEADMAN_LOST, inject("pad", disconnect=True), inject("pad", disconnect=False), 0.015, True),
    Stop("rig.stop()", Trip.STOP, stop_from_a_thread),
    Stop("a fault of the arm", Trip.FAULT, inject(fault="collision"), recover),
    Stop("SETPOINT_MISMATCH", Trip.FAULT, report_nonsense, recover, 22 * TICK),
    Stop("no answer", Trip.DEVICE_LOST, inject(disconnect=True), inject(disconnect=False)),
    Stop("an old reading", Trip.DEVICE_LOST, inject(freeze=True), inject(freeze=False), 0.15),
    *(
        Stop(name, Trip.BAD_READING, begin, report_truth, TICK, None if name == "too few" else False)
        for name, begin in NONSENSE.items()
    ),
    Stop("pushed too fast", Trip.LIMIT, push(lambda tau: [tau[0] + 30.0, *tau[1:]]), let_go, 2 * TICK, command=PUSHING),
    Stop(
        "at the end of a joint",
        Trip.LIMIT,
        lambda loop: None,
        turn_back,
        1.0,
        command=PUSHING,
        rig={"robots__panda__initial": [2.3, *HOME]},
    ),
)
SHOWN.update(f"`{stop.trip.name}`" for stop in STOPS)


# Reports of set-points.


def code_of(error: hal.HalError | None) -> str | None:
    """Return the code of an error, or None."""
    return None if error is None else error.code


def reported(change: Callable[[list[Any], int], Any]) -> str | None:
    """Return the code that ends 1.5 s of driving; ``change`` makes each report of the set-points so far."""
    with mock_rig() as rig:
        loop = Loop(rig, rig.robots["panda"].control(), TURN)
        given: list[Any] = []

        def changed(reading: Any) -> Any:
            given.append(reading.q_commanded)
            return reading._replace(q_commanded=change(given, len(given)))

        loop.alter(changed)
        with loop.control:
            return code_of(loop.drive(1.5))


def wrong(count: int) -> Callable[[list[Any], int], Any]:
    """Report ``count`` set-points that were not given, after 200 that were."""
    return lambda given, n: [x + 0.01 * (1 + n % 3) for x in given[-1]] if 200 <= n < 200 + count else given[-1]


def noisy(size: float) -> Callable[[list[Any], int], Any]:
    """Report the set-points with noise, rad."""
    random = np.random.default_rng(1)
    return lambda given, n: given[-1] + size * random.choice([-1.0, 1.0], 7)


def late(cycles: int) -> Callable[[list[Any], int], Any]:
    """Report the set-points so many cycles late."""
    return lambda given, n: given[max(0, n - 1 - cycles)]
