"""A page that replays a recording in 3D: viser's own player, with the scene and its motion in the page."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Iterable, Sequence

from hal.specs import RobotSpec, WorldSpec
from hal.views import ReplayFrame

from .process import set_camera, start_server
from .scene import BodiesView, DrawnArm


def write_replay(robots: Sequence[RobotSpec], world: WorldSpec, frames: Iterable[ReplayFrame]) -> str:
    """Return the page; see :attr:`hal.registry.DriverSpec.replay3d`. It prints nothing, unlike viser."""
    with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryDirectory(prefix="hal-3d-") as folder:
        server = start_server(f"{folder}/socket", "replay")  # viser draws in a server only; no page connects to it
        try:
            arms = [DrawnArm(server.scene, robot, []) for robot in robots]
            bodies = BodiesView(server.scene, world, [])
            set_camera(server, arms)
            recording = server.get_scene_serializer()
            for frame in frames:
                recording.insert_sleep(frame.wait)
                for arm in arms:
                    arm.place(frame.joints[arm.spec.name], frame.tcp_set[arm.spec.name])
                bodies.world.place(frame.bodies, frame.joints)
                bodies.show()
            return recording.as_html()
        finally:
            server.stop()
