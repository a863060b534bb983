"""A gamepad that plays a recording."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="playback",
    gamepad="hal.drivers.playback.pad:PlaybackPad",
    pad_input="recording",
    pad_title="a recording",
    checks={"gamepad": "hal.drivers.playback.pad:check"},
)
