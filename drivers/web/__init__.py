"""The console: a page in a browser that shows a rig, and drives it with on-screen sticks, keys or a pad."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="web",
    gamepad="hal.drivers.web.pad:WebPad",
    pad_input="console",
    pad_title="the console",
    checks={"gamepad": "hal.drivers.web.pad:check_hand"},
    console="hal.drivers.web.console:WebConsole",
    requires={"aiohttp": "pip install aiohttp", "simplejpeg": "pip install simplejpeg"},
)
