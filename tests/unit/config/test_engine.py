"""The choice of the simulation's engine: in the rig, as an argument, by what is installed."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from errors_kit import raises_code, raises_problems

import hal
from hal import registry
from hal.apps.check import main as check
from hal.apps.teleop import main as teleop
from hal.config import load
from hal.config.data_files import find_data
from hal.errors import CommandError, DriverMissing
from hal.recording.metadata import rig_metadata
from hal.specs import Plan

Installed = Callable[..., None]
EYE = {"model": "realsense_d435", "pose": {"position": [0, 0, 1]}}
PANDA: dict[str, Any] = {"robots": {"arm": {"model": "panda"}}, "cameras": {"eye": EYE}}


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Installed:
    """Returns a function that makes only these engines count as installed."""
    find = importlib.util.find_spec

    def only(*engines: str) -> None:
        def find_spec(name: str, package: str | None = None) -> object:
            if name in registry.ENGINES:
                return object() if name in engines else None
            return find(name, package)

        monkeypatch.setattr(importlib.util, "find_spec", find_spec)

    return only


def drivers(plan: Plan) -> set[str | None]:
    """Return the drivers of all simulated devices of a rig, and of its world."""
    grippers = {robot.gripper.driver for robot in plan.robots if robot.gripper is not None}
    return (
        {robot.driver for robot in plan.robots} | grippers | {camera.driver for camera in plan.cameras} | {plan.engine}
    )


def engine(*there: str, rig: dict[str, Any] = PANDA, **arguments: Any) -> str | None:
    (found,) = drivers(load(rig, **arguments).resolve())
    return found


def test_auto_is_the_first_engine_that_is_installed(installed: Installed) -> None:
    for there in (("pybullet", "mujoco"), ("mujoco",), ("pybullet",)):
        installed(*there)
        assert engine() == there[0]


def test_the_rig_names_its_engine_and_an_argument_replaces_it(installed: Installed) -> None:
    installed("pybullet", "mujoco")
    named = {**PANDA, "simulation": {"engine": "mujoco"}}
    assert engine(rig=named) == "mujoco"
    assert engine(rig=named, engine="pybullet") == "pybullet"
    assert engine(rig=named, engine="auto") == "pybullet"
    assert engine(overrides=["simulation.engine=mujoco"]) == "mujoco"


def test_an_engine_named_by_a_model_means_the_engine_of_the_rig(installed: Installed, tmp_path: Path) -> None:
    """As in models from before there was a choice, whose options of the simulation still apply."""
    installed("mujoco")
    model = yaml.safe_load(find_data("robots", "panda.yaml").read_text())
    model["urdf"] = str(find_data("robots", "panda.urdf"))
    model["drivers"] = model["gripper"]["drivers"] = {"sim": "pybullet"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**model, "simulated": {"speed": 1}}))
    rig = {"robots": {"arm": {"model": str(tmp_path / "mine.yaml")}}}
    plan = load(rig).resolve()
    assert drivers(plan) == {"mujoco"}
    assert plan.robots[0].options == {"speed": 1}


def test_a_driver_with_a_world_is_an_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one of another package, which nothing here names."""
    classes = {kind: f"lab_engine:{kind}" for kind in ("robot", "gripper", "camera", "world")}
    spec = registry.DriverSpec(name="lab_engine", **classes)
    monkeypatch.setitem(sys.modules, "lab_engine", SimpleNamespace(DRIVER=spec))
    assert engine(engine="lab_engine:DRIVER") == "lab_engine:DRIVER"
    assert engine(rig={**PANDA, "simulation": {"engine": "lab_engine:DRIVER"}}) == "lab_engine:DRIVER"
    with raises_problems("invalid_choice"):
        load(PANDA, engine="mock")


def test_a_wrong_engine_is_a_problem() -> None:
    with raises_problems("invalid_choice"):
        load(PANDA, engine="bullet")
    with raises_problems("invalid_choice"):
        load({**PANDA, "simulation": {"engine": "bullet"}})


def test_nothing_is_simulated_without_an_engine() -> None:
    assert load(PANDA, driver="mock", engine="mujoco").resolve().engine is None
    assert load({"cameras": {}}).resolve().engine is None


def test_an_engine_that_is_not_installed_is_refused_before_anything_opens(installed: Installed) -> None:
    installed("pybullet")
    with pytest.raises(DriverMissing) as refused:
        hal.open(PANDA, engine="mujoco", clock="lock_step")
    assert (refused.value.code, refused.value.name) == ("missing_engine", "mujoco")
    assert "pip install 'robot-hal[mujoco]'" in str(refused.value)
    assert "pybullet" in str(refused.value)


def test_without_any_engine_the_error_names_both_commands(installed: Installed) -> None:
    installed()
    with pytest.raises(DriverMissing) as refused:
        hal.open(PANDA)
    assert "robot-hal[sim]" in str(refused.value)
    assert "robot-hal[mujoco]" in str(refused.value)


def test_programs_have_the_option(installed: Installed, capsys: pytest.CaptureFixture[str]) -> None:
    installed("pybullet", "mujoco")
    assert check(["--engine", "mujoco", "--duration", "0.1"]) == 0
    assert "simulation" in capsys.readouterr().out
    installed("pybullet")
    assert check(["--engine", "mujoco", "--duration", "0.1"]) == 2
    assert "robot-hal[mujoco]" in capsys.readouterr().out
    assert teleop(["--engine", "mujoco", "--dry-run"]) == 2
    assert "DriverMissing" in capsys.readouterr().err


def test_a_viewer_that_does_not_exist_is_refused() -> None:
    with raises_code(CommandError, "unknown_viewer"):
        hal.open(PANDA, viewer="gui")


def test_a_recording_names_its_engine(installed: Installed) -> None:
    installed("mujoco")
    rig: Any = SimpleNamespace(plan=load(PANDA).resolve(), renderer=None)
    assert rig_metadata(rig)["engine"]["name"] == "mujoco"
