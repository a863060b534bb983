"""A wheel, installed elsewhere, holds everything and works from a folder full of names that it uses itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAPPED = {"hal": "hal", "apps": "hal/apps", "drivers": "hal/drivers"}
DATA = {name: f"hal/data/{name}" for name in ("config", "robots", "sensors")}
SHIPPED_CODE = (".py", ".html", ".css", ".js")
SHIPPED_DATA = {".yaml", ".json", ".jsonl", ".urdf", ".obj", ".mtl", ".png"}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy, so that nothing is written into the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in (*MAPPED, *DATA, "src"):
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
    _run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, source], folder
    )
    (built,) = folder.glob("robot_hal-*.whl")
    return built


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the wheel is installed in, as site-packages; what it depends on comes from this environment."""
    folder = tmp_path_factory.mktemp("site")
    _run([sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", folder, wheel], folder)
    return folder


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A working directory that holds modules and folders of the names that the hal uses."""
    for name in ("json.py", "yaml.py", "numpy.py", "drivers/__init__.py", "apps/__init__.py", "robots/__init__.py"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"raise RuntimeError('the wrong {name} was imported')\n")
    for name in ("robots/panda.yaml", "config/panda_table.yaml", "sensors/cameras/realsense_d435.yaml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("this: is the wrong file\n")
    return tmp_path


def test_every_module_and_every_data_file_is_in_the_wheel(wheel: Path) -> None:
    expected = {"hal/py.typed"}
    for folder, place in (MAPPED | DATA).items():
        for path in (ROOT / folder).rglob("*"):
            wanted = path.suffix in (SHIPPED_CODE if folder in MAPPED else SHIPPED_DATA)
            if wanted and path.is_file():
                expected.add(f"{place}/{path.relative_to(ROOT / folder).as_posix()}")
    shipped = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert len(expected) > 30, "the comparison looks at the right folders"
    assert shipped == expected


def test_the_wheel_works_beside_a_users_own_drivers_and_json(installed: Path, hostile: Path) -> None:
    code = (
        "import sys; sys.path.pop(0)\n"  # python -c puts the working directory first; a script does not
        "import hal, hal.registry, hal.drivers.mock.robot\n"
        "print(hal.__file__)\n"
        "print(hal.drivers.mock.robot.__file__)\n"
        "print(hal.registry.load('mock', 'camera').__module__)\n"
    )
    output = _run([sys.executable, "-c", code], hostile, PYTHONPATH=str(installed)).splitlines()
    assert output[0].startswith(str(installed))
    assert output[1].startswith(str(installed))
    assert output[2] == "hal.drivers.mock.camera"


def test_a_users_own_drivers_folder_does_not_shadow_ours_even_first_on_the_path(installed: Path, hostile: Path) -> None:
    for name in ("json.py", "yaml.py", "numpy.py"):  # shadowing the standard library is beyond anybody's help
        (hostile / name).unlink()
    code = "import hal.drivers.mock.robot as m, hal.apps; print(m.__file__)"
    output = _run([sys.executable, "-c", code], hostile, PYTHONPATH=str(installed))
    assert output.startswith(str(installed))


def test_the_console_script_works_from_there(installed: Path, hostile: Path) -> None:
    script = installed / "bin" / "hal"
    output = _run([sys.executable, str(script), "teleop", "--help"], hostile, PYTHONPATH=str(installed))
    assert "--sim" in output
    assert "--pad" in output


def test_the_data_is_found_from_there(installed: Path, hostile: Path) -> None:
    """The built-in rig, validated by its name, is the installed one and not the user's file of the same path."""
    script = installed / "bin" / "hal"
    command = [sys.executable, str(script), "teleop", "--sim", "--config", "panda_table", "--dry-run"]
    output = _run(command, hostile, PYTHONPATH=str(installed))
    assert "panda" in output


def test_the_recorded_tour_of_the_tests_is_the_one_that_is_shipped() -> None:
    shipped = (ROOT / "config" / "teleop" / "tour.jsonl").read_bytes()
    assert shipped
    assert (ROOT / "tests" / "data" / "pads" / "tour.jsonl").read_bytes() == shipped


def _run(command: list[object], folder: Path, **environment: str) -> str:
    """Standard output of a command; its error output, if it fails."""
    texts = [str(part) for part in command]
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    result = subprocess.run(texts, cwd=folder, env=kept | environment, capture_output=True, text=True, timeout=100)
    assert result.returncode == 0, f"{' '.join(texts)}\n{result.stdout}{result.stderr}"
    return result.stdout
