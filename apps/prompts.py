"""What a person who collects demonstrations is told to do, in the words of what they drive with."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.rig import Rig
    from hal.robot import Robot

__all__ = ["Prompts", "called"]

SONY = {"south": "Cross", "east": "Circle", "west": "Square", "north": "Triangle", "home": "PS"}


class Prompts:
    """One line for each moment."""

    def __init__(self, rig: Rig, robot: Robot, drives_home: bool) -> None:
        """``drives_home``: is the arm one that drives to where an episode starts, and nobody puts things back?"""
        self._by_page = rig.console is not None and rig.console.driven_by is None
        self._has_page = rig.console is not None
        self._drives_home = drives_home
        self._has_gripper = robot.gripper is not None

    def now(self, phase: str, actions: tuple[str, ...], mapping: TeleopMapping) -> str:
        """What a person should do in this phase, in which ``actions`` are possible; nothing where they only wait."""
        if phase == "resetting":
            then = "; then its gripper opens" if self._has_gripper else ""
            return f"let go of {mapping.deadman}, then hold it until the arm is home{then}" if self._drives_home else ""
        place = "put everything where it starts; " if self._drives_home and phase == "ready" else ""
        return f"{place}{self.buttons(actions, mapping, phase)}" if actions else ""

    def buttons(self, actions: Collection[str], mapping: TeleopMapping, phase: str = "recording") -> str:
        """What these actions are done with."""
        if self._by_page:
            shuffle = '; "Discard" shuffles the objects' if phase == "ready" and "discard" in actions else ""
            return f"press Record{shuffle}" if "record" in actions else ""  # the other buttons say what they do
        words = {
            "record": "starts the recording",
            "finish": "saves it as a success",
            "fail": "saves it as a failure",
            "discard": "puts things elsewhere"
            if phase == "ready"
            else f"forgets it, once {mapping.deadman} is let go of",
        }
        names = {action: called(button) for action, button in mapping.actions.items()}
        told = [f"{names[action]} {words[action]}" for action in actions if action in names]
        return ", ".join(told) or ("the page has the buttons" if self._has_page else "this pad has no buttons for it")


def called(button: str) -> str:
    """A button's name, with that on the tutorial's pad."""
    return f"{button} ({SONY[button]})" if button in SONY else button
