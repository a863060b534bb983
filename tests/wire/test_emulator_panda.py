"""The vendor's client of the Panda, as panda-python brings it, unmodified, against the emulator in lock-step."""

from __future__ import annotations

import numpy as np
import pytest

from hal.drivers.franka.flags import FLAGS

from .franka_kit import PANDA_CLIENT, Emulator, run_client

HOME = [0.0, -0.785398163, 0.0, -2.35619449, 0.0, 1.57079633, 0.785398163]


def test_connecting_and_reading(panda: Emulator) -> None:
    report = run_client(PANDA_CLIENT, "read", panda.host)
    assert (report["mode"], report["version"]) == ("Idle", 5)
    assert report["q"] == HOME  # in double precision
    pose = np.array(report["O_T_EE"]).reshape(4, 4).T
    assert pose[:3, 3] == pytest.approx([0.30689, 0.0, 0.48688], abs=1e-4)
    assert report["m_ee"] == 0.73
    assert report["model"] != ""  # there is no model library to send


@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_a_motion_and_a_second_one(panda: Emulator, kind: str) -> None:
    report = run_client(PANDA_CLIENT, "motion", panda.host, kind=kind, times=2)
    assert [run["error"] for run in report["runs"]] == ["", ""]
    assert report["q"] == pytest.approx([q + 0.2 if k in (0, 3) else q for k, q in enumerate(HOME)], abs=1e-4)
    stats = panda.control.send("stats")
    assert (stats["motions"], stats["lost"], stats["stale"]) == (2, 0, 0)


def test_torques_push_the_arm(panda: Emulator) -> None:
    report = run_client(PANDA_CLIENT, "motion", panda.host, kind="torque")
    assert (report["error"], report["mode"]) == ("", "Idle")
    assert report["q"][0] > 0.05
    assert report["q"][1] == pytest.approx(HOME[1], abs=0.02)


def test_two_runs_in_lock_step_are_equal_to_the_last_bit(panda: Emulator) -> None:
    found = set()
    for _ in range(2):
        panda.refresh()
        report = run_client(PANDA_CLIENT, "motion", panda.host)
        found.add((report["states"], report["cycles"]))
    assert len(found) == 1


def test_a_callback_that_raises_stops_the_arm_and_another_motion_is_possible(panda: Emulator) -> None:
    report = run_client(PANDA_CLIENT, "thrown", panda.host)
    assert "gone" in report["first"]
    assert report["error"] == ""
    assert panda.events("motion ended")[-2]["outcome"] == "preempted"


def test_setters(panda: Emulator) -> None:
    report = run_client(PANDA_CLIENT, "setters", panda.host)
    assert report["good"] == [""] * 4
    assert all("invalid argument" in text for text in report["bad"]), report["bad"]
    assert report["m_load"] == 0.5


def test_a_reflex_stops_refuses_and_is_recovered_from(panda: Emulator) -> None:
    report = run_client(PANDA_CLIENT, "recovery", panda.host, flag="cartesian_reflex")
    assert '["cartesian_reflex"]' in report["first"]
    assert report["told"]["errors"] == report["told"]["last_errors"] == ["cartesian_reflex"]
    assert "not possible in the current mode" in report["refused"]
    assert (report["recovered"], report["error"], report["errors"]) == ("", "", [])


def test_every_flag_that_the_library_knows_has_its_name(panda: Emulator) -> None:
    names = run_client(PANDA_CLIENT, "all_flags", panda.host)["names"]
    assert names[:37] == [[[name], [name]] for name in FLAGS[:37]]
    assert names[37:] == [[[], []]] * 4


def test_a_step_of_50_mrad_is_stopped(panda: Emulator) -> None:
    report = run_client(PANDA_CLIENT, "jump", panda.host)
    assert '["joint_motion_generator_velocity_limits_violation"]' in report["error"]
    assert "limit 2.175 rad/s" in panda.events("reflex")[-1]["text"]


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("silence 0.3", "communication_constraints_violation"),
        ("silence 1.5", "UDP receive: Timeout"),
        ("lose-commands 1", "communication_constraints_violation"),
        ("user-stop on", "User Stop pressed"),
        ("emergency-stop on", "User Stop pressed"),
    ],
)
def test_what_goes_wrong_in_a_motion(panda: Emulator, command: str, text: str) -> None:
    assert text in run_client(PANDA_CLIENT, "motion", panda.host, commands=[command])["error"]


def test_states_that_are_too_short(panda: Emulator) -> None:
    assert "incorrect object size" in run_client(PANDA_CLIENT, "truncated", panda.host)["error"]


def test_another_version_is_refused(panda: Emulator) -> None:
    panda.control.send("version 9")
    assert "version 9" in run_client(PANDA_CLIENT, "refused", panda.host)["error"]
