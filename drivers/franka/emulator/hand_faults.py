"""What can be made to go wrong with the emulated hand, in words; each a line for a control port or a terminal."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["COMMANDS", "Faults", "help_text", "number", "switch"]

COMMANDS = {
    "object W|none": "put a thing of W m between the fingers, or take it away",
    "grasp-ends-at-width on|off": "a grasp that meets nothing ends at its width, or closes all the way (the default)",
    "unhome": "forget how far the fingers open, as after switching on",
    "stop-ignored on|off": "Stop is answered, and does nothing (libfranka, issue 18)",
    "stop-releases on|off": "Stop takes the force away (libfranka, issue 111)",
    "silence S": "send no states for S seconds",
    "slow-reply S": "answer everything S seconds later; 0: at once again",
    "fail [N]": "the next N motions fail at once",
    "version N": "speak this protocol",
    "temperature T": "report T degrees Celsius",
    "drop": "close the connection",
    "restart [S]": "switch off, and on again after S seconds",
    "state": "say how everything is",
    "help": "this list",
}
"""Words -> what they do."""


def help_text() -> str:
    """The table, for people."""
    width = max(map(len, COMMANDS))
    return "\n".join(f"{words:<{width}}  {meaning}" for words, meaning in COMMANDS.items())


@dataclass
class Faults:
    """Which faults are on."""

    version: int
    """The protocol that it says it speaks."""
    temperature: int = 30
    """Degrees Celsius."""
    stop_ignored: bool = False
    stop_releases: bool = False
    silent_until: float = 0.0
    """On the monotonic clock."""
    slow_reply: float = 0.0
    """s"""
    failures: int = 0
    """So many motions that come next fail."""


def switch(word: str) -> bool:
    """``on`` or ``off``; ValueError for anything else."""
    if word not in ("on", "off"):
        raise ValueError(f"on or off, not {word!r}")
    return word == "on"


def number(word: str, least: float = 0.0, most: float = 1e6) -> float:
    """A number in that range; ValueError for anything else."""
    value = float(word)
    if not least <= value <= most:
        raise ValueError(f"a number in {least:g}..{most:g}, not {word}")
    return value
