"""The panel beside the scene: how each arm stands, and two buttons."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import dist

from viser import GuiEvent, ViserServer

from hal.host.records import GroupMemory
from hal.types import Limited, Trip

from .arm import ArmView

__all__ = ["Panel", "status"]

_PERIOD = 0.2
"""Between two looks, s."""
_OLD = 0.3
"""A picture older than this says so, s."""
_HINT = "Dragging a handle only says where to. The arm follows while the console's or the pad's dead-man is held."
_STOP_HINT = "Stops every arm within its limits, if this page still reaches the program. Use the console's stop first."


class Panel:
    """Shows the same to every page."""

    def __init__(
        self,
        server: ViserServer,
        arms: Sequence[tuple[ArmView, GroupMemory]],
        put_back: Callable[[], None],
        stop: Callable[[], None],
        notes: Sequence[str],
    ) -> None:
        self._arms = arms
        self._due = 0.0
        gui = server.gui
        self._texts = [gui.add_markdown(f"**{arm.spec.name}**") for arm, _ in arms]
        back = gui.add_button("Put the handle back", hint="Forget where it was dragged to.")
        halt = gui.add_button("Stop", color="red", hint=_STOP_HINT)
        gui.add_markdown(_HINT)
        gui.add_markdown("*Stop* is an extra and no emergency stop: use the console's stop, or the robot's own.")
        for note in dict.fromkeys(notes):
            gui.add_markdown(f"*{note}*")

        @back.on_click
        async def _(_: GuiEvent) -> None:  # type: ignore[type-arg]
            put_back()

        @halt.on_click
        async def _(_: GuiEvent) -> None:  # type: ignore[type-arg]
            stop()

    def show(self) -> None:
        """Bring the texts up to date, now and then."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + _PERIOD
        for (arm, memory), text in zip(self._arms, self._texts, strict=True):
            new = status(arm, now - memory.get_host().t)
            if text.content != new:
                text.content = new


def status(arm: ArmView, age: float) -> str:
    """How an arm stands, as Markdown. ``age`` is how long its process has published nothing, s."""
    head = f"**{arm.spec.name}**"
    state = arm.state
    if state is None:
        return f"{head}: nothing is known yet"
    if age > _OLD:
        return f"{head}: **this is an old picture**, nothing new for {age:.0f} s"
    lines = [f"{head}: {state.status.name.lower()}"]
    if state.fault is not None:
        lines.append(f"**fault**: {state.fault}")
    if state.trip is not Trip.NONE:
        lines.append(f"**tripped**: {state.trip.name.lower().replace('_', ' ')}")
    lines.append(f"dead-man: {'**held**' if arm.held else 'released'}")
    lines.append(f"limited: {state.limited if state.limited is not Limited.NONE else 'no'}")
    goal = arm.drag.goal
    if goal is not None:
        lines.append(f"goal: {1000 * dist(state.tcp.position, goal.position):.0f} mm away")
    return "  \n".join(lines)
