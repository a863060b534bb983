"""Emulators that the tests of a module share; each test gets them as if just switched on."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from .franka_kit import Emulator, shared

collect_ignore = [] if os.environ.get("HAL_SOAK") == "1" else ["test_tours.py"]


@pytest.fixture(scope="module")
def _lockstep_fr3() -> Iterator[Emulator]:
    pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
    with shared("--lockstep", "--unpaced", robot="fr3") as emulator:
        yield emulator


@pytest.fixture(scope="module")
def _lockstep_panda() -> Iterator[Emulator]:
    pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")
    with shared("--lockstep", "--unpaced", robot="panda") as emulator:
        yield emulator


@pytest.fixture
def fr3(_lockstep_fr3: Emulator) -> Emulator:
    """An FR3 in lock-step."""
    _lockstep_fr3.refresh()
    return _lockstep_fr3


@pytest.fixture
def panda(_lockstep_panda: Emulator) -> Emulator:
    """A Panda in lock-step."""
    _lockstep_panda.refresh()
    return _lockstep_panda


@pytest.fixture
def robot() -> str:
    """The robot of a test that is not parametrized by it."""
    return "fr3"


@pytest.fixture
def emulator(robot: str, request: pytest.FixtureRequest) -> Emulator:
    """``robot`` in lock-step."""
    emulator: Emulator = request.getfixturevalue(robot)
    return emulator
