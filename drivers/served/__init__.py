"""Cameras, gamepads and leaders of another computer, which ``hal serve`` has there (``at: ADDRESS`` in the rig)."""

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="served",
    camera="hal.drivers.served.camera:ServedCamera",
    gamepad="hal.drivers.served.pad:ServedPad",
    leader="hal.drivers.served.pad:ServedLeader",
    pad_title="a gamepad of another computer",
)
"""Devices of another computer; its arms are driven by :mod:`hal.remote.client`."""
