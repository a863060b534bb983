"""Grid times of which there is no row, and why."""

from __future__ import annotations

from typing import Any

__all__ = ["Gaps"]


class Gaps:
    """Those of one episode; neighbours with one reason are one gap."""

    def __init__(self, fps: int) -> None:
        self.rows = 0
        """Rows that are missing."""
        self.lasting = 0.0
        """How long there has been no row now, s."""
        self.why = ""
        """The newest reason."""
        self._fps = fps
        self._found: list[dict[str, Any]] = []
        self._open = False

    def add(self, t: float, why: str) -> None:
        """No row at ``t``, s since the episode's first one."""
        self.rows += 1
        self.lasting += 1.0 / self._fps
        self.why = why
        if not self._open:
            self._found.append({"from_s": round(t, 6), "rows": 0, "why": why})
            self._open = True
        self._found[-1]["rows"] += 1
        self._found[-1]["to_s"] = round(t, 6)

    def over(self) -> None:
        """There is a row again."""
        self._open = False
        self.lasting = 0.0

    def as_json(self) -> list[dict[str, Any]]:
        """As the episode's file lists them."""
        return self._found
