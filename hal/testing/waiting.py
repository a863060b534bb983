"""Waiting for what must happen, with words for the case that it does not."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

import pytest

from ..errors import ConnectionLost, HalError, StaleStateError
from .benches import Bench

__all__ = ["comes_back", "in_thread", "is_lost"]

_HANGS = 15.0
"""s after which a call hangs."""

_T = TypeVar("_T")


def is_lost(bench: Bench, use: Callable[[], object]) -> ConnectionLost:
    """The ConnectionLost that ``use`` raises, at once or within the bench's patience. Fails for anything else."""
    deadline = time.monotonic() + bench.patience
    while True:
        try:
            use()
        except ConnectionLost as error:
            return error
        except StaleStateError:
            pass  # on its way
        except Exception as error:
            wanted = "a device that does not answer must raise hal.errors.ConnectionLost"
            pytest.fail(f"{wanted}, not {type(error).__name__}: {error}")
        if time.monotonic() >= deadline:
            pytest.fail(f"the link is lost, and the driver does not raise ConnectionLost within {bench.patience:g} s")


def comes_back(bench: Bench, use: Callable[[], _T]) -> _T:
    """What ``use`` returns as soon as it raises no error of ours any more, within the bench's patience."""
    deadline = time.monotonic() + bench.patience
    while True:
        try:
            return use()
        except HalError as error:
            if time.monotonic() >= deadline:
                raise AssertionError(f"the link is mended, and the driver still says: {error}") from error
            time.sleep(0.01)


def in_thread(act: Callable[[], object]) -> None:
    """Do it in a thread of its own; whatever it raises is raised here. Fails when it hangs."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            act()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(_HANGS)
    assert not thread.is_alive(), "it hangs in a thread that did not open the device"
    if raised:
        raise raised[0]
