"""Assertions about the codes of errors, and values that no configuration may accept everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from hal.errors import ConfigError, HalError


@contextmanager
def raises_code(error: type[HalError], code: str) -> Iterator[None]:
    """Fail unless the block raises this type of error with this code."""
    with pytest.raises(error) as caught:
        yield
    assert caught.value.code == code


@contextmanager
def raises_problems(*codes: str) -> Iterator[None]:
    """Fail unless the block raises a ConfigError with problems of these codes, in their order."""
    with pytest.raises(ConfigError) as caught:
        yield
    assert tuple(problem.code for problem in caught.value.problems) == codes


NONSENSE = [None, -1, 2.5, "x", [], {}, [1, 2], True, float("nan"), float("inf"), 10**400, {1: 2}, [None] * 7]
"""Values of many types: somewhere each of them is wrong."""


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every key and item in nested data."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [deeper for key, item in items for deeper in places(item, (*path, key))]
