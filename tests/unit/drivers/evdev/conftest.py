"""Fixtures of the evdev driver's tests: a fake input system, and pads on it."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
from evdev_kit import FakeInput, MakePad, pads_on

collect_ignore_glob = [] if sys.platform == "linux" else ["test_*.py"]  # evdev is Linux only


@pytest.fixture
def system() -> FakeInput:
    return FakeInput()


@pytest.fixture
def make_pad(system: FakeInput) -> Iterator[MakePad]:
    with pads_on(system) as make:
        yield make
