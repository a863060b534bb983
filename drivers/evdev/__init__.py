"""A gamepad that is plugged in (Linux), through python-evdev."""

from __future__ import annotations

from hal.registry import DriverSpec

__all__ = ["DRIVER"]

DRIVER = DriverSpec(
    name="evdev",
    gamepad="hal.drivers.evdev.pad:EvdevPad",
    requires={"evdev": "pip install evdev-binary (x86-64), or pip install evdev (compiles itself)"},
)
