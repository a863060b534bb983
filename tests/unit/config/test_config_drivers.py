"""Problems that a driver finds in a rig before anything is opened, where they are reported, and what is emulated."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from engines_kit import AUTO
from errors_kit import raises_problems

from hal.config import load
from hal.config.data_files import find_data
from hal.errors import ConfigError, DriverMissing
from hal.host.hosts import make_groups
from hal.specs import PayloadSpec, RobotSpec, from_json, to_json

LAB = """
from hal.registry import DriverSpec

PLACES = {"robot": "hal.drivers.mock.robot:MockRobot", "gripper": "hal.drivers.mock.robot:MockGripper"}
DRIVER = DriverSpec(
    name="lab", **PLACES,
    checks={"robot": "lab_driver:check_arm", "gripper": "lab_driver:check_hand"}, emulated="lab_driver:emulated",
    shared_options=("host",),
)
BUS = DriverSpec(
    name="bus", **PLACES, emulated="lab_driver:emulated", steppable=False, group="lab_driver:adapter", payload=True,
)
OTHER = DriverSpec(name="other", **PLACES)
BROKEN = DriverSpec(name="broken", **PLACES, checks={"robot": "lab_driver:nowhere"})

def check_arm(spec):
    if "host" not in spec.options:
        yield "real.host", "is missing: where is it?"
    if spec.options.get("tool") == "hammer":
        yield "real.tool.kind", "must not be a hammer"
    if spec.limits.jerk[0] > 1000:
        yield "limits.jerk", "is too much"
    if spec.limits.upper[0] > 2.5:
        yield "limits", "reach too far"
    if spec.rate_hz != 1000:
        yield "rate_hz", "must be 1000"

def check_hand(spec):
    if "host" not in spec.options:
        yield "real.host", "is missing: where is the hand?"
    if spec.force > 50:
        yield "force", "is too much"

def emulated(options):
    return options.get("host") == "here"

def adapter(options):
    return options.get("adapter")
"""
ME = {"real": "lab_driver:DRIVER"}
QUIET = {"jerk": 900, "upper": [2, 1.7, 2, -0.1, 2, 3, 2]}


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "lab_driver.py").write_text(LAB)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("lab_driver", None)


def rig(hand: dict[str, Any] | None = None, **keys: Any) -> dict[str, Any]:
    """A real arm of the driver above, with its hand; nothing is wrong with it."""
    gripper = {"drivers": ME, **(hand or {})}
    robot = {"model": "panda", "drivers": ME, "real": {"host": "there"}, "limits": QUIET, "gripper": gripper}
    return {"sim": False, "robots": {"arm": {**robot, **keys}}}


def arm(config: dict[str, Any], **arguments: Any) -> RobotSpec:
    return load(config, **arguments).resolve().robots[0]


def found(config: dict[str, Any], **arguments: Any) -> set[tuple[str, str]]:
    """File and key of everything that is wrong."""
    try:
        load(config, **arguments)
    except ConfigError as error:
        return {(Path(problem.file).name, problem.key) for problem in error.problems}
    return set()


def own_model(folder: Path, **keys: Any) -> str:
    """A model of one's own, a Panda otherwise."""
    model = yaml.safe_load(find_data("robots", "panda.yaml").read_text())
    model["urdf"] = str(find_data("robots", "panda.urdf"))
    model["gripper"]["drivers"] = model["drivers"] = {"sim": "pybullet", **ME}
    (folder / "mine.yaml").write_text(yaml.safe_dump({**model, "real": {}, **keys}))
    return str(folder / "mine.yaml")


def test_problems_found_by_a_driver_are_reported_with_all_others() -> None:
    assert found(rig()) == set()
    wrong = rig(real={}, rate_hz=500) | {"cameras": {"eye": {"model": "pinhol"}}}
    assert found(wrong) == {
        ("<dict>", "robots.arm.real.host"),
        ("<dict>", "robots.arm.rate_hz"),
        ("<dict>", "cameras.eye.model"),
    }
    with pytest.raises(ConfigError, match=r"robots.arm.real.host: is missing: where is it\?"):
        load(rig(real={}))


def test_a_driver_is_asked_though_another_arm_is_wrong() -> None:
    config = rig(real={})
    config["robots"] = {"other": {"model": "pnada"}, **config["robots"]}
    assert found(config) == {("<dict>", "robots.other.model"), ("<dict>", "robots.arm.real.host")}


def test_an_override_is_to_blame_for_what_it_set() -> None:
    assert found(rig(), overrides=["robots.arm.real.tool=hammer"]) == {("--set", "robots.arm.real.tool.kind")}


def test_in_simulation_the_real_driver_is_not_consulted() -> None:
    assert found(rig(real={}), sim=True) == set()
    assert found(rig(real={}), driver="mock") == set()


def test_problems_of_a_model_are_reported_for_its_file(tmp_path: Path) -> None:
    model = own_model(tmp_path, real={"tool": "hammer", "host": "there"}, real_limits={})
    config = rig(model=model, real={}, limits={})
    assert found(config) == {("mine.yaml", "real.tool.kind"), ("mine.yaml", "limits.jerk"), ("mine.yaml", "limits")}
    config = rig(model=own_model(tmp_path, real_limits={"jerk": 1500}), limits={"upper": QUIET["upper"]})
    assert found(config) == {("mine.yaml", "real_limits.jerk")}
    rigs = {"tool": "hammer", "host": "there"}
    config = rig(model=model, real=rigs, limits={"jerk": 1200, "allow_looser_limits": True})
    assert found(config) == {
        ("<dict>", "robots.arm.real.tool.kind"),
        ("<dict>", "robots.arm.limits.jerk"),
        ("<dict>", "robots.arm.limits"),
    }


def test_the_options_of_a_model_are_for_its_own_driver(tmp_path: Path) -> None:
    model = own_model(tmp_path, real={"host": "there", "tool": "saw"})
    assert arm(rig(model=model, real={"tool": "drill"})).options == {"host": "there", "tool": "drill"}
    others = {"real": "lab_driver:OTHER"}
    assert arm(rig({"drivers": others}, model=model, drivers=others, real={"x": 1})).options == {"x": 1}


def test_a_hand_has_the_host_of_its_arm_unless_it_has_its_own() -> None:
    def hand(config: dict[str, Any]) -> dict[str, Any]:
        gripper = arm(config).gripper
        assert gripper is not None
        return gripper.options

    assert hand(rig()) == {"host": "there"}
    assert hand(rig({"real": {"host": "elsewhere", "grip": 1}})) == {"host": "elsewhere", "grip": 1}
    assert hand(rig({"drivers": {"real": "lab_driver:OTHER"}})) == {}  # another driver: another device


def test_a_hand_is_checked_too() -> None:
    assert found(rig({"force": 60})) == {("<dict>", "robots.arm.gripper.force")}
    # A missing host is the arm's, reported once; with another driver it is the hand's own.
    assert found(rig(real={})) == {("<dict>", "robots.arm.real.host")}
    config = rig(drivers={"real": "lab_driver:OTHER"})
    assert found(config) == {("<dict>", "robots.arm.gripper.real.host")}


def test_a_driver_whose_check_is_not_there() -> None:
    with pytest.raises(DriverMissing, match="lab_driver has no 'nowhere'"):
        load(rig(drivers={"real": "lab_driver:BROKEN"}))


def test_an_arm_is_emulated_when_all_that_is_real_of_it_is() -> None:
    here = {"host": "here"}
    assert not arm(rig()).emulated
    emulated = arm(rig(real=here))
    assert (emulated.attended, emulated.emulated, emulated.deadline_max) == (True, True, 0.3)
    assert not arm(rig({"real": {"host": "there"}}, real=here)).emulated  # its hand is a real one
    assert arm(rig({"enabled": False}, real=here)).emulated
    assert not arm(rig(real=here), sim=True).emulated


def test_a_real_hand_on_a_simulated_arm_is_attended() -> None:
    config = rig({"sim": False, "real": {"host": "there"}}, sim=True)
    assert (arm(config).driver, arm(config).attended, arm(config).emulated) == (AUTO, True, False)
    config = rig({"sim": False, "real": {"host": "here"}}, sim=True)
    assert (arm(config).attended, arm(config).emulated) == (True, True)


def test_only_an_emulated_arm_can_be_stepped() -> None:
    assert found(rig(), clock="lock_step") == {("<dict>", "robots.arm")}
    assert arm(rig(real={"host": "here"}), clock="lock_step").emulated


def test_an_emulator_on_a_bus_is_emulated_and_cannot_be_stepped() -> None:
    config = rig({"enabled": False}, drivers={"real": "lab_driver:BUS"}, real={"host": "here"})
    assert arm(config).emulated
    with pytest.raises(ConfigError) as caught:
        load(config, clock="lock_step")
    assert [(p.key, p.code) for p in caught.value.problems] == [("robots.arm", "emulated_in_lock_step")]


def two_on_a_bus(*adapters: str | None, **second: Any) -> dict[str, Any]:
    """A left and a right arm, each on its adapter; ``second`` are keys of the right one."""
    arms = {}
    for name, adapter in zip(("left", "right"), adapters, strict=True):
        entry = {"model": "panda", "drivers": {"real": "lab_driver:BUS"}, "gripper": {"enabled": False}}
        arms[name] = entry | {"real": {"adapter": adapter}} | (second if name == "right" else {})
    return {"sim": False, "robots": arms}


@pytest.mark.parametrize(
    ("adapters", "groups"),
    [
        (("usb0", "usb0"), ["left+right"]),
        (("usb0", "usb1"), ["left", "right"]),
        ((None, None), ["left", "right"]),
    ],
)
def test_arms_on_one_adapter_share_a_process(adapters: tuple[str | None, ...], groups: list[str]) -> None:
    found = make_groups(load(two_on_a_bus(*adapters)).resolve())
    assert [group.name for group in found] == groups
    assert [robot.name for group in found for robot in group.robots] == ["left", "right"]
    (simulated,) = make_groups(load(two_on_a_bus(*adapters), sim=True).resolve())
    assert simulated.name == "simulation"


def test_arms_that_share_a_process_have_one_rate() -> None:
    with pytest.raises(ConfigError) as caught:
        load(two_on_a_bus("usb0", "usb0", rate_hz=200))
    assert [(p.key, p.code) for p in caught.value.problems] == [("robots.right.rate_hz", "unequal_rates")]
    assert len(make_groups(load(two_on_a_bus("usb0", "usb1", rate_hz=200)).resolve())) == 2


def test_a_payload_is_for_arms_whose_driver_carries_it() -> None:
    payload = {"mass": 0.4, "position": [0, 0, 0.05]}
    config = two_on_a_bus("usb0", "usb0", payload=payload)
    left, right = load(config).resolve().robots
    assert (left.payload, right.payload) == (None, PayloadSpec(0.4, (0.0, 0.0, 0.05)))
    assert from_json(RobotSpec, to_json(right)) == right
    with pytest.raises(ConfigError) as caught:
        load(rig(payload=payload))
    assert [(p.key, p.code) for p in caught.value.problems] == [("robots.arm.payload", "unused_payload")]
    assert arm(rig(payload=payload), sim=True).payload == right.payload
    with pytest.raises(ConfigError) as caught:
        load(two_on_a_bus("usb0", "usb0", payload={"mass": -1}))
    assert [(p.key, p.code) for p in caught.value.problems] == [("robots.right.payload.mass", "out_of_range")]


def test_a_simulated_hand_does_not_fit_a_real_arm() -> None:
    assert found(rig({"sim": True})) == {("<dict>", "robots.arm.gripper")}


def test_real_limits_count_where_the_arm_is_real(tmp_path: Path) -> None:
    model = own_model(tmp_path, real_limits={"jerk": 700, "velocity": [1, 1, 1, 1, 2, 2, 2]})
    config = rig(model=model, limits={"upper": QUIET["upper"]})
    real, simulated = arm(config).limits, arm(config, sim=True).limits
    assert (real.jerk, real.velocity) == ((700.0,) * 7, (1.0,) * 4 + (2.0,) * 3)
    assert simulated.jerk[0] == 7500.0
    assert real.acceleration == simulated.acceleration  # not given
    # The rig may be tighter than that; looser only with allow_looser_limits.
    assert arm(rig(model=model, limits={**QUIET, "jerk": 600})).limits.jerk[0] == 600.0
    assert found(rig(model=model)) == {("<dict>", "robots.arm.limits.jerk")}
    assert arm(rig(model=model, limits={**QUIET, "allow_looser_limits": True})).limits.jerk[0] == 900.0


@pytest.mark.parametrize(
    ("real_limits", "key", "code"),
    [
        ({"jerk": 8000}, "real_limits.jerk", "looser_limit"),
        ({"lower": -3.0}, "real_limits.lower", "looser_limit"),
        ({"velocity": [1, 1]}, "real_limits.velocity", "wrong_count"),
        ({"acceleration": 0}, "real_limits.acceleration", "out_of_range"),
        ({"jrek": 100}, "real_limits.jrek", "unknown_key"),
        ({"lower": 0.5, "upper": 0.4}, "real_limits", "empty_range"),
    ],
)
def test_mistakes_in_real_limits_are_found_in_simulation_too(
    tmp_path: Path, real_limits: dict[str, Any], key: str, code: str
) -> None:
    model = own_model(tmp_path, real_limits=real_limits)
    with pytest.raises(ConfigError) as caught:
        load({"robots": {"arm": {"model": model, "drivers": {"sim": "pybullet"}, "gripper": {"enabled": False}}}})
    assert (key, code) in {(problem.key, problem.code) for problem in caught.value.problems}


def test_links_have_names_that_fit_every_model() -> None:
    eye = {"model": "pinhole", "attached": {"robot": "arm", "link": "hand"}}
    for model, link in (("panda", "panda_hand"), ("fr3", "fr3_hand")):
        (camera,) = load({"robots": {"arm": {"model": model}}, "cameras": {"eye": eye}}).resolve().cameras
        assert camera.view is not None
        assert camera.view.link == link
        load(
            "panda_table", overrides=[f"robots.panda.model={model}"]
        ).resolve()  # its camera is on the hand of any model
    config = {"robots": {"arm": {"model": "panda"}}, "cameras": {"eye": eye}}
    config["cameras"]["eye"]["attached"]["link"] = "hnd"  # type: ignore[index]
    with raises_problems("unknown_link"):
        load(config)


def test_a_name_for_a_link_must_lead_to_one_and_be_free(tmp_path: Path) -> None:
    links = {"hand": "panda_hnad", "panda_link3": "panda_link4", "panda_hand": "panda_hand"}
    model = own_model(tmp_path, links=links, drivers={"sim": "pybullet"})
    config = {"robots": {"arm": {"model": model, "gripper": {"enabled": False}}}}
    assert found(config) == {("mine.yaml", "links.hand"), ("mine.yaml", "links.panda_link3")}
