"""One finding of the check before a real arm moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Level", "Verdict"]

Level = Literal["ok", "warn", "fail", "unknown"]
"""``warn``: it may work. ``fail``: it will not. ``unknown``: nobody could look, which is never the same as ``ok``."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was looked at, how that stands, and what a person can do about it."""

    name: str
    level: Level
    found: str
    remedy: str = ""
    """What mends it, a command where there is one; empty where nothing is to be done."""
