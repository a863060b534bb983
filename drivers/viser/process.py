"""The process behind the page: it reads the hosts' memory, draws, and says where handles were dragged to.

Nothing here writes into that memory, so nothing that a page does, or that goes wrong here, reaches a servo.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from hal.host.process import Channel, SharedMemory, serve
from hal.host.scheduling import yield_to_others
from hal.specs import GroupSpec, from_json

from .guard import HOST
from .guard import serve as open_page
from .page import Page

__all__ = ["PORT", "main"]

PORT = 8080
"""The first port to try."""
_NICE = 10
"""It comes after everything else."""
_FRAME = 1 / 30
"""How often a page is brought up to date, s."""
_IDLE = 0.1
"""How often it looks around while there is no page, s."""
_REPEAT = 0.1
"""A goal is said again after so long, as a sign of life, s."""


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; ``memories`` are those of the hosts, in the order of ``config["groups"]``."""
    yield_to_others(_NICE)
    server = open_page(PORT, config["label"], config["secret"])
    page = Page(server, [from_json(GroupSpec, group) for group in config["groups"]], memories)
    channel.send({"ready": {"address": f"http://{HOST}:{server.get_port()}", "notes": page.notes}})
    teller = Teller(channel, page)

    def update() -> float:
        due = time.monotonic() + (_FRAME if page.watched else _IDLE)
        page.update()
        teller.tell()
        return max(0.0, due - time.monotonic())

    serve(channel, {"clear": page.clear_goal, "edited": page.edited}, update)


class Teller:
    """Tells the app what people want: goals, as long as they stand, and a stop."""

    def __init__(self, channel: Channel, page: Page) -> None:
        self._channel = channel
        self._page = page
        self._told: dict[str, int] = {}
        self._due = 0.0

    def tell(self) -> None:
        """Say what is new; ConnectionLost when the app is gone."""
        if self._page.stop.is_set():
            self._page.stop.clear()
            self._channel.send({"stop": True})
        goals = {arm.spec.name: goal for arm in self._page.arms if (goal := arm.drag.goal) is not None}
        numbers = {robot: goal.seq for robot, goal in goals.items()}
        now = time.monotonic()
        if numbers == self._told and (not goals or now < self._due):
            return
        self._told, self._due = numbers, now + _REPEAT
        said = {robot: [goal.seq, *goal.position, *goal.orientation] for robot, goal in goals.items()}
        self._channel.send({"goals": said, "t": now})
