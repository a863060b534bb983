"""A gamepad that is plugged in (Linux), through python-evdev."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="evdev",
    gamepad="hal.drivers.evdev.pad:EvdevPad",
    pad_input="plugged",
    pad_title="a gamepad at the program's computer",
    requires={"evdev": "pip install evdev-binary (x86-64), or pip install evdev (compiles itself)"},
)
