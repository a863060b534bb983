"""The README's ``pip install -e .`` leaves types and completion to editors, and shadows no name of the user's."""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
import hal
from hal.apps.teleop import main
from hal.drivers.mock import DRIVER

with hal.open("panda_table", sim=True) as rig:
    reveal_type(rig.robots["panda"].state().q)
    reveal_type(rig.cameras["wrist"].read().depth)
    reveal_type(main)
    reveal_type(DRIVER)
    rig.robots["panda"].move_home()
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment of its own with the editable install; dependencies come from this environment."""
    folder = tmp_path_factory.mktemp("editable")
    build = f"import setuptools.build_meta as backend; backend.build_editable({str(folder)!r})"
    _run([sys.executable, "-c", build], ROOT)
    (wheel,) = folder.glob("robot_hal-*.whl")
    home = folder / "venv"
    venv.create(home, symlinks=True)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    site = home / "lib" / version / "site-packages"
    _run([sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", site, wheel], folder)
    dependencies = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (site / "dependencies.pth").write_text("\n".join([*dependencies, sysconfig.get_paths()["purelib"]]))
    return home / "bin" / "python"


def test_pyright_knows_the_types_of_what_is_installed(environment: Path, tmp_path: Path) -> None:
    pytest.importorskip("basedpyright", reason="needs pip install -e '.[dev]'")
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"typeCheckingMode": "basic"}))
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", environment, "-p", tmp_path]
    found = json.loads(_run(command, tmp_path, status=1))["generalDiagnostics"]
    revealed = [entry["message"] for entry in found if entry["severity"] == "information"]
    errors = [entry["message"] for entry in found if entry["severity"] == "error"]
    assert len(revealed) == 4
    assert "NDArray[float64]" in revealed[0] or "ndarray" in revealed[0]
    assert "ndarray" in revealed[1] or "NDArray" in revealed[1]
    assert "Program" in revealed[2]
    assert "DriverSpec" in revealed[3]
    (only,) = errors
    assert 'Cannot access attribute "move_home"' in only


def test_nothing_but_hal_is_on_the_path(environment: Path, tmp_path: Path) -> None:
    code = (
        "import importlib.util as u, hal, hal.drivers.mock, hal.apps.teleop; from hal.config.data_files import *;"
        "print([n for n in ('drivers', 'apps', 'config', 'robots', 'sensors', 'tests') if u.find_spec(n)]);"
        "print(data_folder('robots'))"
    )
    shadowing, robots = _run([environment, "-I", "-c", code], tmp_path).splitlines()
    assert shadowing == "[]"
    assert Path(robots) == ROOT.resolve() / "robots"


def test_a_checkout_without_links_says_what_to_do(environment: Path, tmp_path: Path) -> None:
    """As git makes it where there are no symbolic links: each is a text file with the path that it leads to."""
    package = tmp_path / "hal"
    package.mkdir()
    (package / "__init__.py").write_bytes((ROOT / "hal" / "__init__.py").read_bytes())
    for name in ("apps", "drivers"):
        (package / name).write_text(f"../{name}")
    done = subprocess.run(
        [environment, "-c", "import hal.apps"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    line = done.stderr.splitlines()[-1]
    assert line.startswith("ImportError: ")
    assert "git config core.symlinks true && git restore hal src" in line


def _run(command: list[object], folder: Path, status: int = 0) -> str:
    """Return the standard output of a command, which ends with ``status``."""
    texts = [str(part) for part in command]
    result = subprocess.run(texts, cwd=folder, capture_output=True, text=True, timeout=100)
    assert result.returncode == status, f"{' '.join(texts)}\n{result.stdout}{result.stderr}"
    return result.stdout
