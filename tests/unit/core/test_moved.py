"""Import paths and names of the previous release still work, and a warning names the new ones."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest

from hal._moved import MODULES, NAMES, RenamedAttribute, _find
from hal.calibration import Calibration, Collector, View
from hal.testing import Bench
from hal.views import Console


@pytest.mark.parametrize(("old", "new"), MODULES.items())
def test_an_old_module_leads_to_the_new_one(old: str, new: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=new):
        module = import_module(old)
    target = import_module(new)
    assert all(getattr(module, name) is getattr(target, name) for name in target.__all__)
    assert all(getattr(module, name) is _find(path) for name, path in NAMES.get(old, {}).items())


@pytest.mark.parametrize(
    ("module", "name"), [(module, name) for module in NAMES if module not in MODULES for name in NAMES[module]]
)
def test_a_name_that_left_its_module_is_found(module: str, name: str) -> None:
    with pytest.warns(DeprecationWarning, match=NAMES[module][name]):
        assert getattr(import_module(module), name) is _find(NAMES[module][name])


def test_old_names_of_methods_and_fields_are_found() -> None:
    renamed = [vars(owner) for owner in (Bench, Calibration, Collector, Console, View)]
    assert sum(isinstance(value, RenamedAttribute) for names in renamed for value in names.values()) == 7
    for owner, old, new in (
        (Collector, "take", "take_view"),
        (Bench, "gave", "was_given"),
        (Calibration, "doubtful", "doubts"),
    ):
        with pytest.warns(DeprecationWarning, match=new):
            assert getattr(owner, old) is getattr(owner, new)


def test_the_warning_names_the_line_of_the_user() -> None:
    uses = (
        "from hal.pose import Pose",
        "from hal.robot import RobotDriver",
        "from hal.calibration import Sighting",
        "hal.console.DrivingView",
        "hal.calibration.Collector.take",
    )
    code = "\n".join(("import hal", *uses))
    child = subprocess.run([sys.executable, "-W", "always", "-c", code], capture_output=True, text=True, timeout=60)
    assert child.returncode == 0, child.stderr
    for line in range(2, 2 + len(uses)):
        assert f"<string>:{line}: DeprecationWarning" in child.stderr


def test_unknown_names_stay_errors() -> None:
    with pytest.raises(ModuleNotFoundError):
        import_module("hal.no_such_module")
    for module in ("hal", "hal.calibration", "hal.kinematics", "hal.robot"):
        with pytest.raises(AttributeError):
            _ = import_module(module).no_such_name
