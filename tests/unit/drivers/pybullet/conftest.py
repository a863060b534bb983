"""Tests of the PyBullet driver are skipped where PyBullet is not installed."""

from __future__ import annotations

from pathlib import Path

import pytest
from engines_kit import has_engine


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip this folder's tests before their fixtures start."""
    if not has_engine("pybullet"):
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason="needs pybullet (pip install pybullet)"))
