"""Data that come with the hal are found by path, from a checkout and from an installed wheel."""

from __future__ import annotations

import importlib.util
import inspect
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hal.config.data_files import data_folder, find_data, is_path, list_data


def test_finds_built_in_files() -> None:
    assert find_data("robots", "panda.yaml").is_file()
    assert find_data("config", "objects", "cube.yaml").is_file()
    assert {"panda", "iiwa"} <= set(list_data("robots"))
    assert "realsense_d435" in list_data("sensors", "cameras")


def test_a_missing_file_lists_what_exists() -> None:
    with pytest.raises(FileNotFoundError, match="panda"):
        find_data("robots", "pnada.yaml")
    with pytest.raises(LookupError, match="robots, sensors, config"):
        data_folder("secrets")


def test_the_users_own_folders_do_not_shadow_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "panda.yaml").write_text("mine: true")
    monkeypatch.chdir(tmp_path)
    assert "mine" not in find_data("robots", "panda.yaml").read_text()


@pytest.mark.parametrize("name", ["./panda", "robots/panda", "panda.yaml", "panda.yml", "C:\\panda"])
def test_a_slash_or_an_ending_means_a_path(name: str) -> None:
    assert is_path(name)
    assert not is_path("panda")


def test_an_installed_copy_finds_its_own_data(tmp_path: Path) -> None:
    """The layout of a wheel: hal/data/{robots,sensors,config} inside the package."""
    package = tmp_path / "site" / "hal"
    (package / "data" / "robots").mkdir(parents=True)
    (package / "data" / "robots" / "only_here.yaml").write_text("x: 1")
    (package / "config").mkdir()
    copy = package / "config" / "data_files.py"
    shutil.copy(inspect.getfile(find_data), copy)
    spec = importlib.util.spec_from_file_location("installed_data_files", copy)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.list_data("robots") == ("only_here",)
    assert module.find_data("robots", "only_here.yaml").parent == package / "data" / "robots"


def test_importing_hal_loads_neither_pydantic_nor_yaml() -> None:
    heavy = "('pydantic', 'yaml', 'pinocchio', 'ruckig', 'pybullet', 'importlib.resources')"
    code = f"import sys, hal; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_loading_a_rig_imports_no_simulator_and_no_kinematics() -> None:
    code = (
        "import sys, hal.config; plan = hal.config.load('panda_table').resolve(); assert plan.robots;"
        "heavy = ('pinocchio', 'ruckig', 'pybullet', 'pybullet_data', 'moderngl', 'trimesh');"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
