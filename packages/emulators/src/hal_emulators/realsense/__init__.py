"""An emulated RealSense: librealsense's own software device, fed with images that are known exactly.

The library has no wire to speak to, so the emulated camera lives in the process that uses it. Behind it is the
unmodified library: list of devices, pipelines, matching, alignment, recordings. Two features are missing from such a
device and are added by :func:`emulated_context`: announcing that a camera was unplugged, and removing it from the list
while a pipeline on it exists. There is no ``hardware_reset``.
"""

from __future__ import annotations

from .camera import SoftwareCamera
from .device import emulated_context
from .pictures import read_number
from .settings import CameraFaults, Emulation

__all__ = ["CameraFaults", "Emulation", "SoftwareCamera", "emulated_context", "read_number"]
