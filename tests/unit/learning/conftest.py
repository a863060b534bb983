"""The rig that most tests of this folder use."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import hal


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    """A mock without cameras, in lock-step."""
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        yield rig
