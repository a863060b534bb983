"""HAL_TEST_STRICT=1 makes a skip a failure, so that CI cannot pass by leaving tests out."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CONFTEST = Path(__file__).parents[2] / "conftest.py"
SKIPS = """
import pytest

def test_in_the_body():
    pytest.skip("needs umockdev")

@pytest.mark.skip(reason="needs xvfb")
def test_by_mark():
    pass

@pytest.mark.xfail(reason="known", strict=True)
def test_expected_failure():
    raise AssertionError
"""


def test_skipped_tests_and_modules_fail(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST.read_text())
    (tmp_path / "test_skips.py").write_text(SKIPS)
    (tmp_path / "test_module.py").write_text("import pytest\npytest.importorskip('no_such_library')\n")
    plugins = ["-p", "no:cacheprovider", "-p", "no:warnings"]  # others' warnings would be counted
    options = ["-q", "-ra", *plugins, "--continue-on-collection-errors"]
    command = [sys.executable, "-m", "pytest", *options, "--rootdir", str(tmp_path), str(tmp_path)]
    environment = os.environ | {"HAL_TEST_STRICT": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    environment["PYTHONPATH"] = str(CONFTEST.parent / "kits")
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment, cwd=tmp_path)
    assert "1 failed, 1 xfailed, 2 errors" in result.stdout
    assert all(reason in result.stdout for reason in ("needs umockdev", "needs xvfb", "no_such_library"))
    assert result.returncode == 1
