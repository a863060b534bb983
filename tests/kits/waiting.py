"""Wait for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_until(condition: Callable[[], object], what: str = "so", timeout: float = 30.0) -> None:
    """Poll until a condition holds; fail with ``what`` if it does not within ``timeout``, s, on a busy computer."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"after {timeout:g} s still not {what}"
        time.sleep(0.002)
