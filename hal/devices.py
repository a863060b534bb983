"""Devices by name."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TypeVar

from .errors import DeviceNotFound

__all__ = ["Devices"]

T = TypeVar("T")


class Devices(dict[str, T]):
    """Devices by name. A name that is not there raises DeviceNotFound, which lists those that are."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self._kind = kind

    def __missing__(self, name: str) -> T:
        close = get_close_matches(name, self, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        there = ", ".join(self) if self else "none"
        raise DeviceNotFound(f"this rig has no {self._kind} {name!r}{hint}; it has: {there}")
