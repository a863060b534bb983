"""Cameras of another computer, which ``hal serve`` has there (``at: ADDRESS`` in the rig)."""

from hal.registry import DriverSpec

DRIVER = DriverSpec(name="served", camera="hal.drivers.served.camera:ServedCamera")
