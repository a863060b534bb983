"""Assertions about the codes of errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
