"""An assertion about the code of an error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from hal.errors import HalError


@contextmanager
def raises_code(error: type[HalError], code: str) -> Iterator[None]:
    """Fail unless the block raises this type of error with this code."""
    with pytest.raises(error) as caught:
        yield
    assert caught.value.code == code
