"""A recording on its way to the pages."""

from __future__ import annotations

from typing import Any

from hal.views import RecordingView

__all__ = ["as_message"]

_LONGEST = 300
"""Characters of a line; a page shows no more."""


def as_message(view: RecordingView) -> dict[str, Any]:
    """``view`` as JSON; numbers may be numpy's. TypeError or ValueError for what is no number."""
    return {
        "phase": view.phase,
        "prompt": _line(view.prompt),
        "task": _line(view.task),
        "episode": int(view.episode),
        "saved": int(view.saved),
        "wanted": int(view.wanted),
        "succeeded": int(view.succeeded),
        "failed": int(view.failed),
        "discarded": int(view.discarded),
        "seconds": round(float(view.seconds), 2),
        "frames": int(view.frames),
        "dropped": int(view.dropped),
        "free_bytes": int(view.free_bytes),
        "trouble": _line(view.trouble),
        "actions": list(view.actions),
    }


def _line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else line[: _LONGEST - 1] + "…"
