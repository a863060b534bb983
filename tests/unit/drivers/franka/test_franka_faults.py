"""Faults of a Franka: every flag, every mode, and the messages of the client libraries."""

from __future__ import annotations

import pytest

from hal.drivers.franka.faults import (
    HAND_PORT,
    KNOWN_ERRORS,
    fault_of,
    fault_of_exception,
    flags_in,
    is_connection_lost,
    version_fault,
)
from hal.drivers.franka.flags import FLAG_TEXTS, FLAGS, flag_index
from hal.errors import Fault
from hal.host import records


def fits(fault: Fault) -> bool:
    """Return whether a fault reaches a program unshortened."""
    return records.make_fault(*records.fault_values(fault)) == fault


def test_every_flag_has_its_own_cause_and_a_remedy() -> None:
    assert (len(FLAGS), set(FLAG_TEXTS)) == (41, set(FLAGS))
    assert len({cause for cause, _ in FLAG_TEXTS.values()}) == len(FLAGS)
    assert all(text.isascii() and text.isprintable() for texts in FLAG_TEXTS.values() for text in texts)


def test_flags_by_name_and_by_number() -> None:
    assert flag_index("joint_reflex") == flag_index("6") == 6
    for wrong in ("41", "-1", "joint", ""):
        with pytest.raises(ValueError, match="no error flag"):
            flag_index(wrong)


def test_every_flag_becomes_a_fault_with_its_own_code_that_fits_into_a_state() -> None:
    codes = set()
    for flag in FLAGS:
        fault, worst = fault_of([flag], "reflex"), fault_of([flag, *FLAGS], "reflex", False)
        assert worst is not None
        assert fits(fault)
        assert fits(worst)
        assert (fault.cause, fault.remedy) == FLAG_TEXTS[flag]
        codes.add(fault.code)
    assert len(codes) == len(FLAGS)
    assert "communication_constraints_violation" in codes


@pytest.mark.parametrize("mode", ["reflex", "Reflex", "kReflex", "RobotMode.kReflex", "RobotMode.Reflex"])
def test_modes_are_understood_in_every_librarys_spelling(mode: str) -> None:
    fault = fault_of(["joint_reflex"], mode)
    assert fault.code == "joint_reflex"


@pytest.mark.parametrize(
    ("mode", "flags", "code"),
    [
        ("kUserStopped", [], "user_stopped"),
        ("user_stopped", ["joint_reflex"], "user_stopped"),
        ("Guiding", [], "guiding"),
        ("kAutomaticErrorRecovery", [], "recovering"),
        ("recovering", [], "recovering"),
        ("Other", [], "not_ready"),
        ("Reflex", [], "reflex"),
        ("Dancing", [], "unknown_mode"),
        ("Idle", ["joint_reflex"], None),
        ("kMove", ["joint_reflex"], None),
        ("idle", ["joint_reflex"], None),
    ],
)
def test_the_mode_decides_whether_there_is_a_fault(mode: str, flags: list[str], code: str | None) -> None:
    fault = fault_of(flags, mode)
    assert (fault and fault.code) == code
    if fault is not None:
        assert fault.cause
        assert fault.remedy
        assert fits(fault)


def test_of_several_flags_the_likely_reason_comes_first() -> None:
    jump, lost = "joint_motion_generator_acceleration_discontinuity", "communication_constraints_violation"
    fault = fault_of([jump, lost], "reflex")
    assert fault.code == lost
    assert jump in fault.cause


@pytest.mark.parametrize("realtime", [True, False, None])
def test_lost_set_points_mention_the_kernel_only_if_it_is_not_a_real_time_kernel(realtime: bool | None) -> None:
    fault = fault_of(["communication_constraints_violation"], "reflex", realtime)
    assert ("kernel" in fault.remedy) == (realtime is False)


@pytest.mark.parametrize(("rate", "shown"), [("0.62", True), ("0", False)])
def test_a_success_rate_is_named_but_for_zero(rate: str, shown: bool) -> None:
    """Outside a motion the robot reports 0."""
    text = f'aborted by reflex! ["communication_constraints_violation"]\ncontrol_command_success_rate: {rate}'
    fault = fault_of_exception(RuntimeError(text))
    assert ("62% of the last" in fault.cause) == shown


def test_flags_are_found_in_the_librarys_spelling() -> None:
    text = '["base_acceleration_invalid_reading", "tau_J_range_violation", "nonsense", "Idle"]'
    assert flags_in(text) == ("base_acceleration_invalid_reading", "tau_j_range_violation")


@pytest.mark.parametrize(
    ("server", "library", "advice"),
    [(5, 10, "model: panda"), (10, 5, "model: fr3"), (9, 10, "10"), (4, 5, "4.2.1"), (11, 10, "pip"), (4, 3, "hand")],
)
def test_another_version_names_the_arm_that_it_belongs_to(server: int, library: int, advice: str) -> None:
    fault = version_fault(server, library)
    assert fits(fault)
    assert fault.code == "version"
    assert advice in fault.remedy


def test_an_unknown_message_is_passed_on() -> None:
    fault = fault_of_exception(RuntimeError("libfranka: a new\n complaint " + "x" * 300))
    assert fault.code == "libfranka"
    assert fault.cause.startswith("a new complaint")
    assert fits(fault)


def test_every_known_error_fits_into_a_state() -> None:
    for known in KNOWN_ERRORS:
        assert fits(known.fault("a-rather-long-name.of-a.robot.example.org:1337")), known.code


@pytest.mark.parametrize(
    ("error", "code", "lost"),
    [
        ("libfranka: Connection timeout. Please check your network connection or settings.", "unreachable", True),
        ("libfranka: Connection error: Host not found", "unknown_host", True),
        ("libfranka: Connection error: Net Exception", "no_way", True),
        ("libfranka: TCP send bytes: I/O error", "closed", True),
        ("libfranka: Running kernel does not have realtime capabilities.", "realtime", False),
        ("libfranka gripper: Command failed!", "hand_failed", False),
        ("libfranka gripper: Command aborted!", "hand_aborted", False),
        ("libfranka: Move command aborted!", "aborted", False),
        ('libfranka: aborted by reflex! ["joint_reflex"]', "joint_reflex", False),
        ("libfranka: something else", "libfranka", False),
        (OSError("gone"), "libfranka", True),
    ],
)
def test_messages_of_the_libraries_are_recognised(error: str | OSError, code: str, lost: bool) -> None:
    raised = RuntimeError(error) if isinstance(error, str) else error
    fault = fault_of_exception(raised, host="172.16.0.2")
    assert fault.code == code
    assert fits(fault)
    assert is_connection_lost(raised) == lost


def test_a_refusal_at_the_hands_port_means_that_there_is_no_hand() -> None:
    error = RuntimeError("libfranka: Connection to FCI refused. Please install FCI feature or enable FCI mode in Desk.")
    assert fault_of_exception(error, host="172.16.0.2", port=HAND_PORT).code == "no_hand"
    assert fault_of_exception(error, host="172.16.0.2").code == "refused"
