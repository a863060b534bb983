"""Fixtures for tests of research code: ``mock_rig``. Pytest finds them where robot-hal is installed.

Pytest imports this module in every session, with or without robots. It therefore imports nothing but pytest until a
test uses a fixture.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from .rig import Rig


@pytest.fixture
def mock_rig_config() -> Any:
    """Return the rig of :func:`mock_rig`, as for ``hal.open``: the built-in Panda, unless your tests override this."""
    return "panda_table"


@pytest.fixture
def mock_rig(mock_rig_config: Any) -> Iterator[Rig]:
    """Open a rig whose devices are all mocks, in lock-step, for one test; ``mock_rig_config`` names it."""
    from .rig import open_rig

    with open_rig(mock_rig_config, driver="mock") as rig:
        yield rig
