"""The keys of the terminal in which a program runs, as a gamepad, also over ssh."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="terminal",
    gamepad="hal.drivers.terminal.pad:TerminalPad",
    pad_input="keys",
    pad_title="the terminal of the program",
)
