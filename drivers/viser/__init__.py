"""A page that shows a rig in 3D, with a handle on each tcp to drag: viser, in a process of its own."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="viser",
    viewer3d="hal.drivers.viser.viewer:ViserViewer",
    replay3d="hal.drivers.viser.replay:write_replay",
    requires={"viser": "pip install 'robot-hal[viewer]'"},
)
