"""Settings of a Franka arm and its hand, and what is refused before a device is opened."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hal.config import load
from hal.config.schema import is_own_host
from hal.drivers.franka.limits import FER, FR3
from hal.drivers.franka.settings import ArmSettings, HandSettings, check_arm, check_hand
from hal.errors import ConfigError
from hal.specs import GripperSpec, LimitsSpec, RobotSpec


def arm(model: str = "fr3", **options: Any) -> RobotSpec:
    """A valid real arm with these options."""
    spec = (
        load("franka", sim=False, overrides=[f"robots.arm.model={model}", "robots.arm.real.host=172.16.0.2"])
        .resolve()
        .robots[0]
    )
    return replace(spec, options={**spec.options, **options})


def hand(**options: Any) -> GripperSpec:
    spec = arm().gripper
    return replace(spec, options={**spec.options, **options})


def limited(model: str = "fr3", **limits: Any) -> RobotSpec:
    """The same arm with other limits."""
    spec = arm(model)
    return replace(spec, limits=replace(spec.limits, **limits))


def codes_of(problems: Iterable[tuple[str, str, str]]) -> dict[str, str]:
    """The code of each problem, by its key."""
    return {key: code for key, _, code in problems}


def other(values: tuple[float, ...], joint: int, value: float) -> tuple[float, ...]:
    """``values`` with another value for one joint, counted from 1."""
    return (*values[: joint - 1], value, *values[joint:])


@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_the_example_rig_is_valid(model: str) -> None:
    assert list(check_arm(arm(model))) == []
    settings = ArmSettings.of(arm(model))
    assert (settings.host, settings.arm) == ("172.16.0.2", {"fr3": "fr3", "panda": "fer"}[model])
    assert (settings.stream, list(check_hand(hand()))) == ("position", [])
    assert HandSettings.of(hand()).host == "172.16.0.2"


def test_the_defaults_are_those_of_the_vendors_examples() -> None:
    settings = ArmSettings.of(arm())
    lower, upper, force, _ = settings.collision_behavior.arguments()
    assert lower == upper == [20, 20, 18, 18, 16, 14, 12]
    assert force == [20, 20, 20, 25, 25, 25]
    assert settings.joint_impedance == (3000, 3000, 3000, 2500, 2500, 2000, 2000)
    alone = (settings.cartesian_impedance, settings.load, settings.end_effector, settings.stiffness_frame)
    assert alone == (None,) * 4


def test_every_setting() -> None:
    spec = arm(
        stream="velocity",
        collision_behavior={"upper_torque": [30] * 7, "upper_force": [40] * 6},
        joint_impedance=[0, 14250, 1, 2, 3, 4, 5],
        cartesian_impedance=[10, 3000, 100, 1, 300, 10],
        load={"mass": 0.5, "com": [0, 0, 0.1], "inertia": [1e-3, 2e-3, 2.5e-3, 1e-5, 2e-5, 3e-5]},
        end_effector={"position": [0, 0, 0.1]},
        stiffness_frame=[[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]],
    )
    assert list(check_arm(spec)) == []
    settings = ArmSettings.of(spec)
    mass, com, inertia = settings.load.arguments() if settings.load else (0, [], [])
    assert (mass, com) == (0.5, [0, 0, 0.1])
    assert inertia == [1e-3, 1e-5, 2e-5, 1e-5, 2e-3, 3e-5, 2e-5, 3e-5, 2.5e-3]
    assert settings.end_effector.matrix() == pytest.approx([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0.1, 1])
    columns = np.reshape(settings.stiffness_frame.matrix(), (4, 4)).T
    assert columns == pytest.approx(np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]))


WRONG: dict[str, list[dict[str, Any]]] = {
    "hst": [{"hst": "172.16.0.2"}],
    "host": [{"host": host} for host in ("172.16.0.256", "172.16.0.2:1337", "https://robot.local", "", 172, "::1")],
    "arm": [{"arm": "fr4"}],
    "stream": [{"stream": "torques"}],
    "joint_impedance": [{"joint_impedance": k} for k in ([3000] * 6, [3000] * 6 + [14251], [math.nan] * 7)],
    "cartesian_impedance": [{"cartesian_impedance": k} for k in ([5] * 6, [10] * 3 + [301] * 3)],
    "collision_behavior.upper_torqe": [{"collision_behavior": {"upper_torqe": []}}],
    "collision_behavior.upper_force": [{"collision_behavior": {"upper_force": [-1] * 6}}],
    "collision_behavior": [{"collision_behavior": k} for k in ({"upper_torque": [10] * 7}, {"lower_force": [30] * 6})],
    "load.mass": [{"load": {"mass": 3.1}}, {"load": {"com": [0, 0, 0]}}],
    "load": [{"load": {"mass": 1, "inertia": inertia}} for inertia in ([1, 1, 3, 0, 0, 0], [1, 1, 1, 2, 0, 0])],
    "end_effector": [
        {"end_effector": [0, 0, 0.1]},
        {"end_effector": [[1, 0, 0]] * 4},
        {"end_effector": [[1, 0, 0, 0]] * 3 + [[0, 0, 0, 1]]},  # no rotation
        {"end_effector": np.diag([-1.0, 1, 1, 1]).tolist()},  # not right-handed
        {"end_effector": np.diag([1.0, 1, 1, 2]).tolist()},
    ],
    "stiffness_frame.orientation": [{"stiffness_frame": {"orientation": [0, 0, 0, 2]}}],
}


@pytest.mark.parametrize(("key", "options"), [(key, options) for key, wrong in WRONG.items() for options in wrong])
def test_an_invalid_value_is_reported_by_its_key(key: str, options: dict[str, Any]) -> None:
    spec = arm(**options)
    assert codes_of(check_arm(spec)).get(f"real.{key}", "invalid") != "invalid"
    with pytest.raises(ConfigError) as caught:
        ArmSettings.of(spec)
    assert {problem.file for problem in caught.value.problems} == {"robots.arm.real"}


@pytest.mark.parametrize("host", ["robot.local", "franka", "127.0.0.2", "my-arm.lab.example."])
def test_hosts_that_may_be(host: str) -> None:
    assert ArmSettings.of(arm(host=host)).host == host
    assert HandSettings.of(hand(host=host)).host == host


def test_a_host_must_be_given() -> None:
    nowhere = replace(arm(), options={"arm": "fr3"})
    assert (
        codes_of(check_arm(nowhere))
        == codes_of(check_hand(replace(hand(), options={})))
        == {"real.host": "missing_key"}
    )


def test_invalid_settings_of_a_hand() -> None:
    assert codes_of(check_hand(hand(tolerence=0.01))) == {"real.tolerence": "unknown_key"}
    assert codes_of(check_hand(hand(tolerance=0))) == {"real.tolerance": "out_of_range"}


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost", " LOCALHOST. "])
def test_a_robot_on_this_computer_is_own_host(host: str) -> None:
    assert is_own_host({"host": host})


@pytest.mark.parametrize("host", ["172.16.0.2", "localhost.lab.example", "127.0.0.1.lab.example", 127, None])
def test_another_robot_is_not_emulated(host: object) -> None:
    assert not is_own_host({"host": host})
    assert not is_own_host({})


def test_the_rehearsals_rig_is_emulated_and_the_labs_is_not() -> None:
    (rehearsal,) = load("franka_emulator").resolve().robots
    assert (rehearsal.driver, rehearsal.attended, rehearsal.emulated) == ("franka", True, True)
    assert load("franka_emulator", clock="lock_step").resolve().clock == "lock_step"
    assert not arm().emulated


@pytest.mark.parametrize(
    ("model", "limit", "joint", "value", "official"),
    [
        ("fr3", "lower", 4, -3.1, -3.077),
        ("fr3", "upper", 1, 2.95, 2.9007),
        ("fr3", "velocity", 5, 5.3, 5.26),
        ("fr3", "acceleration", 2, 10.5, 10),
        ("fr3", "jerk", 7, 5001, 5000),
        ("fr3", "torque", 6, 13, 12),
        ("panda", "lower", 6, -0.02, -0.0175),
        ("panda", "upper", 4, -0.06, -0.0698),
        ("panda", "velocity", 1, 2.2, 2.175),
        ("panda", "acceleration", 2, 8, 7.5),
        ("panda", "jerk", 2, 3800, 3750),
        ("panda", "torque", 1, 88, 87),
    ],
)
def test_no_limit_lies_beyond_the_arms_own(model: str, limit: str, joint: int, value: float, official: float) -> None:
    good = getattr(arm(model).limits, limit)
    found = {key: (text, code) for key, text, code in check_arm(limited(model, **{limit: other(good, joint, value)}))}
    text, code = found[f"limits.{limit}"]
    assert code == "out_of_range"
    assert all(part in text for part in (f"{model}_joint{joint}", f"{value:g}", f"{official:g}"))


def test_the_arms_own_limits_are_allowed() -> None:
    own = {"acceleration": FR3.acceleration, "jerk": FR3.jerk, "torque": FR3.torque}
    assert list(check_arm(limited(**own))) == []
    names = ("lower", "upper", "velocity", "acceleration", "jerk", "torque")
    assert list(check_arm(limited("panda", **{name: getattr(FER, name) for name in names}))) == []


def test_an_fr3_may_not_be_fast_where_its_range_ends() -> None:
    """At each end by itself; the message has the joint, its speed and the limit there."""
    good = arm().limits
    for end, k in (("lower", 0), ("upper", 1)):
        near = FR3.lower[0] + 0.1 if end == "lower" else FR3.upper[0] - 0.1
        ((key, text, code),) = check_arm(limited(**{end: other(getattr(good, end), 1, near)}))
        allowed = abs(FR3.velocity_range([near] * 7)[k][0])
        assert (key, code) == ("limits", "out_of_range")
        assert all(part in text for part in ("fr3_joint1", "1.91 rad/s", f"{allowed:.4g}", f"{near:g} rad"))
        assert "fr3_joint2" not in text
        slower = other(good.velocity, 1, math.floor(100 * allowed) / 100)
        assert list(check_arm(limited(velocity=slower, **{end: other(getattr(good, end), 1, near)}))) == []


def test_franka_s_own_rectangular_speeds_are_a_little_too_fast() -> None:
    rectangular = (2.0, 1.0, 1.5, 1.25, 3.0, 1.5, 3.0)  # control-parameters-joint-fr3-rectangular.csv
    ((key, text, code),) = check_arm(limited(velocity=rectangular))
    assert (key, code) == ("limits", "out_of_range")
    assert all(f"fr3_joint{k}" in text for k in range(1, 8))


def test_numbers_that_are_not_known_do_not_confuse_the_check() -> None:
    """Limits are NaN where the file has errors, which are reported elsewhere."""
    unknown = (math.nan,) * 7
    assert list(check_arm(replace(arm(), limits=LimitsSpec(*[unknown] * 5)))) == []


def test_other_arms_and_rates_are_refused() -> None:
    assert codes_of(check_arm(replace(arm(), rate_hz=500.0))) == {"rate_hz": "wrong_rate"}
    six = replace(arm(), joints=arm().joints[:6])
    assert codes_of(check_arm(six)) == {"model": "wrong_count"}
    assert codes_of(check_arm(replace(arm(), options={"host": "172.16.0.2"})))["real.arm"] == "missing_key"


def test_nothing_of_the_vendor_is_imported_to_check_a_rig() -> None:
    code = (
        "import sys; from hal.config import load;"
        "load('franka', sim=False, overrides=['robots.arm.real.host=172.16.0.2']).resolve();"
        "print([m for m in ('pylibfranka', 'panda_py', 'pinocchio', 'pybullet') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
