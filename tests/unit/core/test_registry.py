"""Drivers by name: built in, installed by another package, named directly, missing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from errors_kit import raises_code

from hal import registry
from hal.driver import RobotDriver
from hal.errors import DeviceNotFound, DriverMissing, NotSupported
from hal.registry import DriverSpec

DRIVERS = Path(__file__).parents[3] / "drivers"


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on sys.path, like site-packages, whose modules are removed afterwards."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("lab_"):
            del sys.modules[name]


def install(folder: Path, name: str, module: str, text: str) -> None:
    """Write what pip installs for a package with one entry point and one module."""
    (folder / f"{module}.py").write_text(text)
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[hal.drivers]\n{name} = {module}:DRIVER\n")


def test_every_driver_folder_is_in_the_table_and_resolves() -> None:
    folders = {path.parent.name for path in DRIVERS.glob("*/__init__.py") if "DriverSpec(" in path.read_text()}
    assert {path.parent.name for path in DRIVERS.glob("*/__init__.py")} - folders == {"scene"}, "what engines share"
    assert {place.removeprefix("hal.drivers.").partition(":")[0] for place in registry.BUILT_IN.values()} == folders
    for name in registry.BUILT_IN:
        spec = registry.driver(name)
        assert spec.name == name
        assert spec.kinds


def test_the_mock_robot_is_a_robot_driver() -> None:
    assert issubclass(registry.load("mock", "robot"), RobotDriver)


def test_nothing_is_imported_before_its_first_use() -> None:
    code = (
        "import sys, hal.registry as r; r.driver('mock');"
        "print([m for m in sys.modules if m.startswith(('hal.drivers.mock.', 'importlib.metadata', 'pybullet'))])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.strip() == "[]"


def test_an_unknown_driver_lists_the_drivers_and_the_nearest_spelling() -> None:
    with pytest.raises(DeviceNotFound, match=r"did you mean 'pybullet'\?.*evdev, feetech, franka, .*mock"):
        registry.load("pybulet", "robot")


def test_a_kind_that_a_driver_lacks_lists_what_it_has() -> None:
    with pytest.raises(NotSupported, match="it has: robot, gripper, camera, gamepad"):
        registry.load("mock", "world")
    with raises_code(NotSupported, "unknown_kind"):
        registry.load("mock", "griper")


def test_a_driver_of_another_package_through_its_entry_point(lab: Path) -> None:
    install(
        lab,
        "lab_arm",
        "lab_arm_driver",
        "from hal.registry import DriverSpec\n"
        "DRIVER = DriverSpec('lab_arm', robot='lab_arm_driver:Arm')\n"
        "class Arm: pass\n",
    )
    assert "lab_arm" in registry.names()
    assert "lab_arm_driver" not in sys.modules, "names() must not import drivers"
    assert registry.driver("lab_arm").kinds == ("robot",)
    assert registry.load("lab_arm", "robot").__name__ == "Arm"


def test_another_package_cannot_replace_a_built_in_driver(lab: Path) -> None:
    install(lab, "mock", "lab_impostor", "raise RuntimeError('imported')\n")
    assert registry.load("mock", "robot").__module__ == "hal.drivers.mock.robot"


def test_a_driver_named_directly(lab: Path) -> None:
    (lab / "lab_direct.py").write_text(
        "from hal.registry import DriverSpec\n"
        "DRIVER = DriverSpec('direct', camera='lab_direct:Camera')\n"
        "class Camera: pass\n"
    )
    assert registry.load("lab_direct:DRIVER", "camera").__name__ == "Camera"


def test_a_missing_vendor_library_names_the_command(lab: Path) -> None:
    (lab / "lab_vendor.py").write_text(
        "from hal.registry import DriverSpec\n"
        "DRIVER = DriverSpec('v', robot='lab_vendor_arm:Arm', requires={'no_such_vendor': 'pip install vendor-sdk'})\n"
    )
    (lab / "lab_vendor_arm.py").write_text("import no_such_vendor.core\nclass Arm: pass\n")
    assert registry.find_missing("lab_vendor:DRIVER") == {"no_such_vendor": "pip install vendor-sdk"}
    with pytest.raises(DriverMissing, match="no_such_vendor.*pip install vendor-sdk") as caught:
        registry.load("lab_vendor:DRIVER", "robot")
    assert isinstance(caught.value, ImportError)
    assert isinstance(caught.value.__cause__, ModuleNotFoundError)


def test_a_library_that_is_installed_is_not_missing(lab: Path) -> None:
    (lab / "lab_fine.py").write_text(
        "from hal.registry import DriverSpec\n"
        "DRIVER = DriverSpec('f', robot='x:Y', requires={'numpy': 'pip install numpy'})\n"
    )
    assert registry.find_missing("lab_fine:DRIVER") == {}


@pytest.mark.parametrize(
    ("text", "code"),
    [("DRIVER = 'lab'", "bad_driver"), ("", "bad_driver"), ("import no_such_thing", "driver_missing")],
)
def test_a_package_that_announces_an_invalid_driver(lab: Path, text: str, code: str) -> None:
    install(lab, "lab_broken", "lab_broken_driver", text)
    with raises_code(DriverMissing, code):
        registry.driver("lab_broken")


def test_an_error_in_a_drivers_own_code_is_not_hidden(lab: Path) -> None:
    (lab / "lab_bug.py").write_text("1 / 0\n")
    with pytest.raises(ZeroDivisionError):
        registry.driver("lab_bug:DRIVER")


def test_the_kinds_of_a_spec() -> None:
    assert DriverSpec("x", camera="a:B", leader="a:C").kinds == ("camera", "leader")
    assert DriverSpec("x").kinds == ()


def test_a_function_that_a_driver_names(lab: Path) -> None:
    assert registry.function("mock", None) is None
    (lab / "lab_checks.py").write_text("def check(spec):\n    return [('real.host', 'is missing')]\n")
    check = registry.function("mock", "lab_checks:check")
    assert check is not None
    assert check(None) == [("real.host", "is missing")]
    with raises_code(DriverMissing, "bad_driver"):
        registry.function("mock", "lab_checks:chekc")
