"""HAL_TEST_STRICT=1 makes a skip a failure, so that CI cannot pass by leaving tests out."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.parametrize(("strict", "expected"), [("0", "2 skipped, 1 xfailed"), ("1", "1 failed, 1 xfailed, 1 error")])
def test_a_skipped_test(tmp_path: Path, strict: str, expected: str) -> None:
    result = _run(tmp_path, SKIPS, strict)
    assert expected in result.stdout
    assert "needs umockdev" in result.stdout
    assert "needs xvfb" in result.stdout
    assert result.returncode == int(strict)


@pytest.mark.parametrize(("strict", "code"), [("0", 5), ("1", 2)])
def test_a_module_that_skips_itself(tmp_path: Path, strict: str, code: int) -> None:
    result = _run(tmp_path, "import pytest\npytest.importorskip('no_such_library')\n", strict)
    assert "no_such_library" in result.stdout
    assert result.returncode == code


def _run(folder: Path, test: str, strict: str) -> subprocess.CompletedProcess[str]:
    (folder / "conftest.py").write_text(CONFTEST.read_text())
    (folder / "test_skips.py").write_text(test)
    options = ["-q", "-ra", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(folder)]
    command = [sys.executable, "-m", "pytest", *options, str(folder)]
    environment = os.environ | {"HAL_TEST_STRICT": strict}
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment, cwd=folder)
