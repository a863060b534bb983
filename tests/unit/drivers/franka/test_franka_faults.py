"""A Franka's faults in words: every flag, every mode, and what the vendors' libraries really raise."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from franka_at_home import address

from hal.drivers.franka.fault_texts import FLAG_TEXTS
from hal.drivers.franka.faults import (
    HAND_PORT,
    fault_of,
    fault_of_exception,
    flags_in,
    is_connection_lost,
    version_fault,
)
from hal.drivers.franka.flags import FLAGS
from hal.drivers.franka.troubles import TROUBLES
from hal.host import records
from hal.types import Fault

HERE = Path(__file__).parents[3] / "kits"
HOST = address(6)
LIBRARIES = {"pylibfranka": 10, "panda_py": 5}
"""Name -> its protocol."""


def fits(fault: Fault) -> bool:
    """Does it reach a program whole?"""
    return records.fault_of(*records.fault_values(fault)) == fault


# Flags and modes.


def test_every_flag_says_what_it_means_and_what_to_do() -> None:
    assert set(FLAG_TEXTS) == set(FLAGS)
    causes = [cause for cause, _ in FLAG_TEXTS.values()]
    assert len(set(causes)) == len(FLAGS), "no two flags mean the same"
    for text in (text for pair in FLAG_TEXTS.values() for text in pair):
        assert text.strip() == text
        assert len(text) > 15
        assert text.isascii()
        assert text.isprintable(), "one line"
        assert not text.endswith(".")
        assert "support" not in text


@pytest.mark.parametrize("flag", FLAGS)
def test_a_flag_becomes_a_fault_that_fits_into_a_state(flag: str) -> None:
    fault = fault_of([flag], "reflex")
    assert fault is not None
    assert fits(fault)
    assert (fault.cause, fault.remedy) == FLAG_TEXTS[flag]
    worst = fault_of([flag, *FLAGS], "reflex", 0.123, False)
    assert worst is not None
    assert fits(worst)


def test_codes_tell_flags_apart_though_some_names_are_too_long() -> None:
    codes = {fault.code for flag in FLAGS if (fault := fault_of([flag], "reflex"))}
    assert len(codes) == len(FLAGS)
    assert "communication_constraints_violation" in codes


@pytest.mark.parametrize("mode", ["reflex", "Reflex", "kReflex", "RobotMode.kReflex", "RobotMode.Reflex"])
def test_modes_are_understood_as_every_library_spells_them(mode: str) -> None:
    fault = fault_of(["joint_reflex"], mode)
    assert fault is not None
    assert fault.code == "joint_reflex"


@pytest.mark.parametrize(
    ("mode", "code"),
    [
        ("kUserStopped", "user_stopped"),
        ("user_stopped", "user_stopped"),
        ("Guiding", "guiding"),
        ("kAutomaticErrorRecovery", "recovering"),
        ("recovering", "recovering"),
        ("Other", "not_ready"),
        ("Reflex", "reflex"),
        ("Dancing", "unknown_mode"),
    ],
)
def test_a_mode_that_keeps_the_robot_from_moving_is_a_fault(mode: str, code: str) -> None:
    fault = fault_of([], mode)
    assert fault is not None
    assert fault.code == code
    assert fault.cause
    assert fault.remedy
    assert fits(fault)


@pytest.mark.parametrize("mode", ["Idle", "kMove", "idle"])
def test_a_robot_that_may_move_has_no_fault_whatever_ended_its_last_motion(mode: str) -> None:
    assert fault_of(["joint_reflex"], mode) is None


def test_the_user_stop_is_told_before_what_it_interrupted() -> None:
    fault = fault_of(["joint_reflex"], "user_stopped")
    assert fault is not None
    assert fault.code == "user_stopped"


def test_of_several_flags_the_likely_reason_comes_first() -> None:
    jump, lost = "joint_motion_generator_acceleration_discontinuity", "communication_constraints_violation"
    fault = fault_of([jump, lost], "reflex", 0.62)
    assert fault is not None
    assert fault.code == lost
    assert "62% of the last 100" in fault.cause
    assert jump in fault.cause


@pytest.mark.parametrize("realtime", [True, False, None])
def test_lost_set_points_are_blamed_on_the_kernel_only_where_it_is_known_to_be_none(realtime: bool | None) -> None:
    fault = fault_of(["communication_constraints_violation"], "reflex", 0.4, realtime)
    assert fault is not None
    assert ("no" in fault.remedy and "real-time kernel" in fault.remedy) == (realtime is False)
    assert "hal-check" in fault.remedy


def test_a_success_rate_of_nothing_is_not_told() -> None:
    """Outside a motion the robot reports 0."""
    fault = fault_of(["communication_constraints_violation"], "reflex", 0.0)
    assert fault is not None
    assert "%" not in fault.cause


def test_the_panda_library_does_not_know_the_last_four_flags_by_name_but_its_text_does() -> None:
    text = '["base_acceleration_invalid_reading", "tau_J_range_violation", "nonsense", "Idle"]'
    assert flags_in(text) == ("base_acceleration_invalid_reading", "tau_j_range_violation")


@pytest.mark.parametrize(
    ("server", "library", "words"),
    [
        (5, 10, ["protocol 5", "it is a Panda", "model: panda"]),
        (10, 5, ["protocol 10", "it is an FR3", "model: fr3"]),
        (9, 10, ["protocol 9", "older system", "up to date"]),
        (4, 5, ["protocol 4", "old system", "4.2.1"]),
        (11, 10, ["protocol 11", "newer", "pip install"]),
        (4, 3, ["the hand", "protocol 4", "Desk"]),
    ],
)
def test_versions_that_do_not_fit_say_what_the_robot_is(server: int, library: int, words: list[str]) -> None:
    fault = version_fault(server, library)
    assert fits(fault)
    assert all(word in str(fault) for word in words), fault


def test_a_text_that_nobody_knows_is_passed_on() -> None:
    fault = fault_of_exception(RuntimeError("libfranka: a new\n complaint " + "x" * 300))
    assert fault.cause.startswith("a new complaint")
    assert fits(fault)


def test_every_trouble_fits_into_a_state() -> None:
    for trouble in TROUBLES:
        assert fits(trouble.fault("a-rather-long-name.of-a.robot.example.org:1337")), trouble.code


def test_a_broken_socket_is_a_lost_connection_and_a_flag_is_none() -> None:
    assert is_connection_lost(OSError("gone"))
    assert not is_connection_lost(RuntimeError('aborted by reflex! ["joint_reflex"]'))
    assert not is_connection_lost(RuntimeError("something else"))


@pytest.mark.parametrize(
    ("text", "code", "lost"),
    [
        ("libfranka: Connection timeout. Please check your network connection or settings.", "unreachable", True),
        ("libfranka: Connection error: Host not found", "unknown_host", True),
        ("libfranka: Connection error: Net Exception", "no_way", True),
        ("libfranka: TCP send bytes: I/O error", "closed", True),
        ("libfranka: Running kernel does not have realtime capabilities.", "realtime", False),
        ("libfranka gripper: Command failed!", "hand_failed", False),
        ("libfranka gripper: Command aborted!", "hand_aborted", False),
        ("libfranka: Move command aborted!", "aborted", False),
    ],
)
def test_texts_that_were_seen_from_the_libraries(text: str, code: str, lost: bool) -> None:
    error = RuntimeError(text)
    fault = fault_of_exception(error, host="172.16.0.2")
    assert fault.code == code
    assert fits(fault)
    assert is_connection_lost(error) == lost


def test_a_refusal_at_the_port_of_the_hand_is_about_the_hand() -> None:
    error = RuntimeError("libfranka: Connection to FCI refused. Please install FCI feature or enable FCI mode in Desk.")
    assert fault_of_exception(error, host="172.16.0.2", port=HAND_PORT).code == "no_hand"
    assert fault_of_exception(error, host="172.16.0.2").code == "refused"


# What the libraries raise.


@dataclass(frozen=True)
class Try:
    """What the robot says, what is tried then, and the code of the fault that comes of it."""

    says: dict[str, Any]
    action: str
    code: str
    lost: bool = False
    only: str = ""
    """Library, where the other one cannot get there."""


ALL = list(range(41))
STATUS = {10: {"impossible": 5, "reflex": 8, "user stop": 9}, 5: {"impossible": 3, "reflex": 6, "user stop": 7}}
"""Of Move."""


def tries(version: int) -> dict[str, Try]:
    status = STATUS[version]
    return {
        "another version": Try({"version": 15 - version}, "read", "version", True),
        "an older system": Try({"version": 9}, "read", "version", True),
        "hangs up": Try({"hang_up": True}, "read", "closed", True),
        "no states": Try({"silent": True}, "read", "silent", True),
        "short states": Try({"short": 1}, "read", "packets", True),
        "a model without shrinking limits": Try({"model": False}, "read", "model", True, "pylibfranka"),
        "all flags": Try(
            {"end": status["reflex"], "mode": 4, "flags": ALL}, "move", "communication_constraints_violation"
        ),
        "no flag": Try({"end": status["reflex"], "mode": 4}, "move", "reflex"),
        "user stop": Try({"end": status["user stop"], "mode": 5}, "move", "user_stopped"),
        "not now": Try({"start": status["impossible"], "mode": 3}, "move", "guiding"),
        "a safety rule": Try({"start": 4}, "move", "safety_rule", only="pylibfranka"),
        "a singular pose": Try({"start": 6 if version == 10 else 4}, "move", "singular"),
        "a bad number": Try({"status": 2}, "set", "invalid_argument"),
        "by hand only": Try({"status": 3 if version == 10 else 2}, "recover", "manual_recovery"),
        "not a number": Try({}, "nan", "not_a_number"),
        "two at once": Try({}, "twice", "occupied", only="pylibfranka"),
    }


def ask(library: str) -> dict[str, dict[str, Any]]:
    """Try all of it; what came of each."""
    version = LIBRARIES[library]
    chosen = {name: a for name, a in tries(version).items() if a.only in ("", library)}
    says = [{"layout": version, "version": version, **a.says} for a in chosen.values()]
    liar = subprocess.Popen(
        [sys.executable, str(HERE / "franka_liar.py"), json.dumps({"host": HOST, "says": says})],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert liar.stdout is not None
        assert liar.stdout.readline().strip() == "ready"
        wanted = {"library": library, "host": HOST, "tries": {name: a.action for name, a in chosen.items()}}
        done = subprocess.run(
            [sys.executable, str(HERE / "franka_listener.py"), json.dumps(wanted)],
            capture_output=True,
            text=True,
            timeout=20,
        )
    finally:
        liar.kill()
        liar.wait()
        assert liar.stdout is not None
        liar.stdout.close()
    assert done.returncode == 0, done.stderr
    return {told["name"]: told for told in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("library", LIBRARIES)
def test_what_a_library_raises_is_understood(library: str) -> None:
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"needs the Python package {library}")
    told = ask(library)
    for name, a in tries(LIBRARIES[library]).items():
        if a.only not in ("", library):
            continue
        assert told[name]["raised"] is not None, name
        code, cause, remedy = told[name]["fault"]
        assert code == a.code, (name, told[name])
        assert told[name]["lost"] == a.lost, (name, told[name])
        assert cause
        assert remedy
        assert fits(Fault(code, cause, remedy)), name
    assert flags_in(told["all flags"]["text"]) == FLAGS, "in the order of the packets"


@pytest.mark.parametrize("library", LIBRARIES)
def test_nobody_there(library: str) -> None:
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"needs the Python package {library}")
    wanted = {"library": library, "host": HOST, "tries": {"nobody": "read"}}
    done = subprocess.run(
        [sys.executable, str(HERE / "franka_listener.py"), json.dumps(wanted)],
        capture_output=True,
        text=True,
        timeout=30,
    )
    told = json.loads(done.stdout)
    assert told["fault"][0] == "refused"
    assert f"{HOST}:1337" in told["fault"][1]
    assert told["lost"]
