"""Import paths of the previous release still work, and say where the names are now."""

from __future__ import annotations

import subprocess
import sys
import warnings
from importlib import import_module

import pytest

from hal._moved import MODULES, NAMES, RENAMED

PUBLIC = {"hal.camera_info": "CameraInfo", "hal.pose": "Pose", "hal.gym": "RigEnv", "hal.resetting": "put_back"}


@pytest.mark.parametrize(("old", "new"), MODULES.items())
def test_an_old_module_leads_to_the_new_one(old: str, new: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=new):
        module = import_module(old)
    target = import_module(new)
    name = PUBLIC.get(old, next(iter(target.__all__)))
    assert getattr(module, name) is getattr(target, RENAMED.get(new, {}).get(name, name))


@pytest.mark.parametrize(("module", "name"), [(module, name) for module, names in NAMES.items() for name in names])
def test_a_name_that_left_its_module_is_found(module: str, name: str) -> None:
    new = NAMES[module][name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        assert getattr(import_module(module), name) is getattr(import_module(new), name)


def test_the_warning_names_the_line_of_the_user() -> None:
    code = "import hal\nfrom hal.pose import Pose\nfrom hal.robot import RobotDriver\n"
    child = subprocess.run([sys.executable, "-W", "always", "-c", code], capture_output=True, text=True, timeout=60)
    assert child.returncode == 0
    assert "<string>:2: DeprecationWarning" in child.stderr
    assert "<string>:3: DeprecationWarning" in child.stderr


def test_unknown_names_stay_errors() -> None:
    with pytest.raises(ModuleNotFoundError):
        import_module("hal.no_such_module")
    with pytest.raises(AttributeError):
        _ = import_module("hal.robot").no_such_name
