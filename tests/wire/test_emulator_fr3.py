"""The vendor's own client of the FR3, pylibfranka, unmodified, against the emulator in lock-step."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from hal.drivers.franka.flags import FLAGS

from .franka_kit import FR3_CLIENT, Emulator, run_client

HOME = [0.0, -0.785398163, 0.0, -2.35619449, 0.0, 1.57079633, 0.785398163]


def moved(*ways: float) -> list[float]:
    """Home, with joints 1 and 4 moved so far."""
    return [q + sum(ways) if k in (0, 3) else q for k, q in enumerate(HOME)]


def test_connecting_and_reading(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "read", fr3.host)
    assert report["mode"] == "Idle"
    assert report["q"] == pytest.approx(HOME, abs=1e-6)
    assert report["errors"] == report["last_errors"] == []
    assert report["next"] > report["seconds"]
    assert report["elbow"] == [0.0, -1.0]
    # Where the tcp of a Franka Hand stands in the home position, looking straight down.
    pose = np.array(report["O_T_EE"]).reshape(4, 4).T
    assert pose[:3, 3] == pytest.approx([0.30689, 0.0, 0.48688], abs=1e-4)
    assert pose[:3, :3] == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-6)
    assert report["F_T_EE"][14] == pytest.approx(0.1034)
    # The library makes its model of the URDF that came over the wire: it feels the weight that the joints show.
    assert report["gravity"] == pytest.approx(report["tau"], abs=0.15)
    assert abs(report["gravity"][3]) > 15.0


@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_a_motion_and_a_second_one(fr3: Emulator, kind: str) -> None:
    report = run_client(FR3_CLIENT, "motion", fr3.host, kind=kind, times=2)
    assert [run["error"] for run in report["runs"]] == ["", ""]
    assert report["mode"] == "Idle"
    assert report["q"] == pytest.approx(moved(0.1, 0.1), abs=1e-4)
    stats = fr3.control.send("stats")
    assert (stats["motions"], stats["lost"], stats["stale"], stats["reflexes"]) == (2, 0, 0, 0)
    assert [event["outcome"] for event in fr3.events("motion ended")[-2:]] == ["success", "success"]
    assert 0.1 < stats["limits"]["velocity"]["share"] < 0.2


def test_torques_push_the_arm_and_it_comes_to_rest(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "motion", fr3.host, kind="torque")
    assert report["error"] == ""
    assert report["mode"] == "Idle"
    assert report["q"][0] > 0.05
    assert report["q"][1] == pytest.approx(HOME[1], abs=0.02)  # its weight is carried


def test_two_runs_in_lock_step_are_equal_to_the_last_bit(fr3: Emulator) -> None:
    for kind in ("position", "torque"):
        found = set()
        for _ in range(2):
            fr3.refresh()
            report = run_client(FR3_CLIENT, "motion", fr3.host, kind=kind)
            found.add((report["states"], report["cycles"], tuple(report["q"])))
        assert len(found) == 1, kind


def test_a_handle_that_is_dropped_stops_the_arm_and_another_motion_is_possible(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "dropped", fr3.host)
    assert report["first"].startswith("KeyError")
    assert report["error"] == ""
    assert fr3.events("motion ended")[-2]["outcome"] == "preempted"


def test_setters_are_looked_at_and_remembered(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "setters", fr3.host)
    assert report["good"] == [""] * 6
    assert all("invalid argument" in text for text in report["bad"]), report["bad"]
    settings = fr3.control.send("settings")["settings"]
    assert settings["SetCollisionBehavior"]["upper_force_nominal"] == [23.0] * 6
    assert settings["SetJointImpedance"]["K_theta"][0] == 3000.0
    assert report["m_load"] == pytest.approx(0.5)
    assert report["EE_T_K"][14] == pytest.approx(0.02)
    assert report["after"][14] == pytest.approx(report["before"][14] - 0.1, abs=1e-5)  # a tool 0.1 m longer


def test_a_reflex_stops_refuses_and_is_recovered_from(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "recovery", fr3.host, flag="joint_reflex")
    assert '["joint_reflex"]' in report["first"]
    assert report["told"]["mode"] == "Reflex"
    assert report["told"]["errors"] == report["told"]["last_errors"] == ["joint_reflex"]
    assert "not possible in the current mode" in report["refused"]
    assert (report["recovered"], report["error"], report["errors"]) == ("", "", [])


def test_every_flag_has_the_name_that_the_library_gives_it(fr3: Emulator) -> None:
    assert run_client(FR3_CLIENT, "all_flags", fr3.host)["names"] == [[[name], [name]] for name in FLAGS]


def test_an_arm_beyond_its_range_needs_a_hand(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "recovery", fr3.host, flag="joint_position_limits_violation")
    assert "manual error recovery required" in report["recovered"]
    assert report["mode"] == "Reflex"
    fr3.control.send("guiding on")
    fr3.control.send("guiding off")
    assert fr3.control.send("state")["mode"] == "idle"


@pytest.mark.parametrize(("button", "mode"), [("user-stop", "UserStopped"), ("emergency-stop", "Other")])
def test_a_stop_that_is_pressed(fr3: Emulator, button: str, mode: str) -> None:
    report = run_client(FR3_CLIENT, "stops", fr3.host, button=button)
    assert "User Stop pressed" in report["first"]
    assert report["told"]["mode"] == mode
    assert "not possible in the current mode" in report["refused"]
    assert report["recovery"] != ""
    assert report["error"] == ""  # released


def test_a_step_of_50_mrad_is_stopped(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "jump", fr3.host)
    assert '["joint_motion_generator_velocity_limits_violation"]' in report["error"]
    assert report["mode"] == "Reflex"
    assert report["q"][0] - HOME[0] < 0.06  # the step was not made
    assert "limit 2.62 rad/s" in fr3.events("reflex")[-1]["text"]


def test_a_start_from_elsewhere_is_stopped(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "jump", fr3.host, by=0.02, at=0.0)
    assert '["joint_position_motion_generator_start_pose_invalid"]' in report["error"]


def test_silence_of_half_a_second_is_a_reflex_and_a_longer_one_the_end_of_the_connection(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "motion", fr3.host, commands=["silence 0.3"])
    assert '["communication_constraints_violation"]' in report["error"]
    assert report["wall"] >= 0.3
    fr3.refresh()
    report = run_client(FR3_CLIENT, "motion", fr3.host, commands=["silence 1.5"])
    assert "UDP receive: Timeout" in report["error"]


def test_twenty_lost_commands_in_a_row_end_a_motion_and_nineteen_do_not(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "motion", fr3.host, commands=["lose-commands next 19"], way=0.01)
    assert report["error"] == ""
    assert fr3.control.send("stats")["lost_in_row"] == 19
    fr3.refresh()
    report = run_client(FR3_CLIENT, "motion", fr3.host, commands=["lose-commands next 20"])
    assert '["communication_constraints_violation"]' in report["error"]


def test_lost_states_are_survived_and_lower_the_success_rate(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "motion", fr3.host, commands=["lose-states 0.2"], way=0.02)
    assert report["error"] == ""
    assert 0.6 < fr3.events("motion ended")[-1]["success_rate"] < 0.95
    assert fr3.control.send("stats")["states_lost"] > 20


def test_five_percent_of_lost_commands_end_a_motion_that_is_not_anchored_to_what_the_robot_took(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "smooth", fr3.host, share=0.05, anchored=False, jerk=1500.0)
    assert "acceleration_discontinuity" in report["error"]
    fr3.refresh()
    report = run_client(FR3_CLIENT, "smooth", fr3.host, share=0.05, anchored=True, jerk=1500.0)
    assert (report["error"], report["mode"]) == ("", "Idle")
    assert report["anchors"] > 0
    assert fr3.control.send("stats")["lost"] > 100


def test_states_that_are_too_short(fr3: Emulator) -> None:
    assert "incorrect object size" in run_client(FR3_CLIENT, "truncated", fr3.host)["error"]


def test_another_version_is_refused_by_both_sides_words(fr3: Emulator) -> None:
    fr3.control.send("version 9")
    report = run_client(FR3_CLIENT, "refused", fr3.host)
    assert "server version: 9, library version: 10" in report["error"]


def test_a_second_client_is_turned_away_and_the_first_is_not_disturbed(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "second", fr3.host)
    assert "interrupted" in report["error"]
    assert (report["first"], report["then"]) == ("Idle", "")
    assert fr3.events("second client")


def test_a_restart_and_a_connection_anew(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "comeback", fr3.host, away=0.2)
    assert "closed connection" in report["first"] or "Timeout" in report["first"]
    assert report["dead"] != ""
    assert (report["error"], report["mode"]) == ("", "Idle")


def test_cartesian_motions_are_refused(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "cartesian", fr3.host)
    assert "not possible" in report["error"]
    assert report["mode"] == "Idle"
    assert "Cartesian motions are not emulated" in fr3.events("refused")[-1]["text"]


def test_targets_at_50_hz(fr3: Emulator) -> None:
    report = run_client(FR3_CLIENT, "asynchronous", fr3.host)
    assert report["errors"] == []
    assert report["q"] == pytest.approx(report["goal"], abs=1e-3)
    assert report["mode"] == "Idle"


def test_an_end_that_is_never_told_hangs_the_library(fr3: Emulator) -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        run_client(FR3_CLIENT, "unanswered", fr3.host, timeout=1.5)
    assert fr3.wait_event("client gone", after=fr3.events("motion ended")[-1]["n"])


def test_slow_answers(fr3: Emulator) -> None:
    assert run_client(FR3_CLIENT, "slow", fr3.host, seconds=0.3)["seconds"] >= 0.3
