"""The other side of ``serve.py``: plug a synthetic pad in, move its controls, pull its cable."""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gesture import Motors

_ANSWER = 20.0  # s


class Bench:
    """Holds one pad at a time."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("serve.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._plugged = False

    def plug(
        self, make: str, axes: Mapping[str, float] | None = None, buttons: tuple[str, ...] = (), frozen: bool = False
    ) -> float:
        """Plug one in that is held like this, and may be silent; returns when, s on the monotonic clock."""
        t: float = self._ask("plug", make=make, axes=dict(axes or {}), buttons=buttons, frozen=frozen)["t"]
        self._plugged = True
        return t

    def show(self, axes: Mapping[str, float] | None = None, buttons: tuple[str, ...] = ()) -> None:
        """Hold it like this from now on; what is not named is let go of."""
        self._ask("show", axes=dict(axes or {}), buttons=buttons)

    def storm(self, reports: int, axes: Mapping[str, float], buttons: tuple[str, ...]) -> None:
        """That many reports of sticks that tremble, at once; then hold it like this."""
        self._ask("storm", reports=reports, axes=dict(axes), buttons=buttons)

    def freeze(self, frozen: bool = True) -> None:
        """A pad that speaks all the time falls silent, though it is still plugged in."""
        self._ask("freeze", frozen=frozen)

    @property
    def motors(self) -> list[tuple[float, Motors]]:
        """What the pad was asked of its motors since it was plugged in, and when, s on the monotonic clock."""
        return [(t, Motors(strong, weak)) for t, strong, weak in self._ask("motors")["motors"]]

    def unplug(self) -> float:
        """Pull its cable, if there is one; returns when, s on the monotonic clock."""
        if not self._plugged:
            return 0.0
        self._plugged = False
        t: float = self._ask("unplug")["t"]
        return t

    def _ask(self, what: str, **details: Any) -> dict[str, Any]:
        server = self._server
        assert server.stdout is not None
        server.stdin.write(json.dumps({"do": what, **details}) + "\n")
        server.stdin.flush()
        if not select.select([server.stdout], [], [], _ANSWER)[0]:
            raise TimeoutError(f"the synthetic pads did not answer within {_ANSWER:g} s to: {what}")
        answer: dict[str, Any] = json.loads(server.stdout.readline() or '{"error": "the synthetic pads ended"}')
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def close(self) -> None:
        """End the process that plays the pads."""
        server = self._server
        server.stdin.close()
        try:
            server.wait(5.0)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
