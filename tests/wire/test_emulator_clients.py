"""The vendor's clients, pylibfranka (FR3) and panda-python (Panda), unmodified, against the emulator in lock-step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hal.drivers.franka.flags import FLAGS

from .franka_kit import Emulator, run_client

HOME = [0.0, -0.785398163, 0.0, -2.35619449, 0.0, 1.57079633, 0.785398163]
Client = Callable[..., dict[str, Any]]
both = pytest.mark.parametrize("robot", ["fr3", "panda"])


@pytest.fixture
def client(robot: str, emulator: Emulator) -> Client:
    """Run a scenario of its client, and return the report."""
    return lambda scenario, **options: run_client(robot, scenario, emulator.host, **options)


def settings(emulator: Emulator) -> dict[str, Any]:
    return dict(emulator.control.send("settings")["settings"])


@both
def test_connecting_and_reading(client, robot):
    report = client("read")
    assert report["mode"] == "Idle"
    assert report["q"] == pytest.approx(HOME, abs=1e-6 if robot == "fr3" else 0.0)  # Panda: double precision
    assert report["errors"] == report["last_errors"] == []
    assert report["next"] > report["seconds"]
    # The position of the TCP of a Franka Hand in the home position, pointing straight down.
    pose = np.array(report["O_T_EE"]).reshape(4, 4).T
    assert pose[:3, 3] == pytest.approx([0.30689, 0.0, 0.48688], abs=1e-4)
    assert pose[:3, :3] == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-6)
    assert report["F_T_EE"][14] == pytest.approx(0.1034)
    if robot == "panda":
        assert (report["version"], report["m_ee"]) == (5, 0.73)
    else:
        assert report["elbow"] == [0.0, -1.0]
    # The library makes its model of what came over the wire: it has the weight that the joints show.
    assert report["gravity"] == pytest.approx(report["tau"], abs=0.15)
    assert abs(report["gravity"][3]) > 15.0


@pytest.mark.parametrize("robot", ["panda"])
def test_panda_py_opens_its_panda_and_moves_it_by_its_model(client, emulator):
    report = client("panda_py_panda")
    assert report["pose"] == pytest.approx(report["O_T_EE"], abs=1e-9)
    assert report["moved"] is True
    assert report["q"] == pytest.approx(np.array(HOME) + 0.1, abs=2e-3)
    assert report["way"] == pytest.approx([0.0, 0.05, 0.0], abs=0.01)
    assert [event["outcome"] for event in emulator.events("motion ended")[-2:]] == ["success", "success"]


@both
@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_two_motions(client, emulator, kind):
    report = client("motion", kind=kind, times=2)
    assert [run["error"] for run in report["runs"]] == ["", ""]
    assert report["mode"] == "Idle"
    assert report["q"] == pytest.approx([q + 0.2 * (k in (0, 3)) for k, q in enumerate(HOME)], abs=1e-4)
    stats = emulator.control.send("stats")
    assert (stats["motions"], stats["lost"], stats["stale"], stats["reflexes"]) == (2, 0, 0, 0)
    assert [event["outcome"] for event in emulator.events("motion ended")[-2:]] == ["success", "success"]
    assert 0.1 < stats["limits"]["velocity"]["share"] < 0.25


@both
def test_torques_push_the_arm_and_it_comes_to_rest(client):
    report = client("motion", kind="torque")
    assert (report["error"], report["mode"]) == ("", "Idle")
    assert report["q"][0] > 0.05
    assert report["q"][1] == pytest.approx(HOME[1], abs=0.02), "its weight is carried"


@both
@pytest.mark.parametrize("kind", ["position", "torque"])
def test_two_runs_in_lock_step_are_equal_to_the_last_bit(client, emulator, kind):
    found = set()
    for _ in range(2):
        emulator.refresh()
        report = client("motion", kind=kind)
        found.add((report["states"], report["cycles"], tuple(report["q"])))
    assert len(found) == 1


@both
def test_a_motion_that_the_client_drops_stops_the_arm_and_another_one_is_possible(client, emulator):
    report = client("cancelled")
    assert "gone" in report["first"]
    assert report["error"] == ""
    assert emulator.events("motion ended")[-2]["outcome"] == "preempted"


@both
def test_setters_are_checked_and_remembered(client, emulator, robot):
    report = client("setters")
    assert not any(report["good"])
    assert all("invalid argument" in text for text in report["bad"]), report["bad"]
    kept = settings(emulator)
    assert kept["SetCollisionBehavior"]["upper_force_nominal"] == [23.0] * 6
    assert kept["SetJointImpedance"]["K_theta"][0] == 3000.0
    assert report["m_load"] == pytest.approx(0.5)
    assert report["after"][14] == pytest.approx(report["before"][14] - 0.1, abs=1e-5), "a tool 0.1 m longer"
    if robot == "fr3":
        assert report["EE_T_K"][14] == pytest.approx(0.02)


@both
def test_every_flag_has_the_name_that_the_library_gives_it(client, robot):
    known = 41 if robot == "fr3" else 37
    names = client("all_flags")["names"]
    assert names[:known] == [[[name], [name]] for name in FLAGS[:known]]
    assert names[known:] == [[[], []]] * (41 - known)


def test_an_arm_beyond_its_range_has_to_be_guided_by_hand(client, emulator):
    report = client("recovery", flag="joint_position_limits_violation")
    assert "manual error recovery required" in report["recovered"]
    assert report["mode"] == "Reflex"
    emulator.control.send("guiding on")
    emulator.control.send("guiding off")
    assert emulator.control.send("state")["mode"] == "idle"


def test_a_start_from_elsewhere_is_stopped(client):
    report = client("jump", by=0.02, at=0.0)
    assert '["joint_position_motion_generator_start_pose_invalid"]' in report["error"]


def test_nineteen_lost_commands_in_a_row_end_no_motion(client, emulator):
    assert client("motion", commands=["lose-commands next 19"], way=0.01)["error"] == ""
    assert emulator.control.send("stats")["lost_in_row"] == 19


def test_lost_states_lower_the_success_rate_and_end_no_motion(client, emulator):
    assert client("motion", commands=["lose-states 0.2"], way=0.02)["error"] == ""
    assert 0.6 < emulator.events("motion ended")[-1]["success_rate"] < 0.95
    assert emulator.control.send("stats")["states_lost"] > 20


def test_cartesian_motions_are_refused(client, emulator):
    report = client("cartesian")
    assert "not possible" in report["error"]
    assert report["mode"] == "Idle"
    assert "Cartesian motions are not emulated" in emulator.events("refused")[-1]["text"]
