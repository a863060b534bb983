"""What stands in for a RealSense camera: librealsense's own software device, fed with pictures that are known exactly.

The library has no wire to speak to, so the emulated camera lives in the process that uses it. What is behind it is the
library itself, unmodified: list of devices, pipelines, matching, alignment, recordings. Two things it cannot do with
such a device, and :func:`emulated_context` does them in its place: announce that a camera was unplugged, and take it
off the list while somebody still has a pipeline. There is no ``hardware_reset``.
"""

from __future__ import annotations

from .camera import SoftwareCamera
from .context import emulated_context
from .number import read_number
from .options import Emulation
from .recording import write_recording

__all__ = ["Emulation", "SoftwareCamera", "emulated_context", "read_number", "write_recording"]
