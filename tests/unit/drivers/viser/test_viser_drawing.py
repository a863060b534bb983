"""The GLB files and workspace lines that the 3D viewer sends to a browser."""

from __future__ import annotations

import io
import math
import re
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from specs import data, panda

from hal.commands import CHUNK_POINTS, Command, CommandRecord, JointChunk, Kind, SessionRecord, encode
from hal.config import load
from hal.config.data_files import find_data
from hal.drivers.scene.shapes import Visual
from hal.drivers.viser.meshes import visuals_glb
from hal.host.records import RobotMail
from hal.kinematics.urdf import read_urdf
from hal.specs import WorkspaceSpec

RED, WHITE = (1.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0, 1.0)


def shape(kind: str, size: tuple[float, ...], file: str = "", rgba: tuple[float, ...] = WHITE) -> Visual:
    return Visual(0, kind, size, file, (0, 0, 0), (0, 0, 0, 1), rgba)


def loaded(visual: Visual) -> Any:
    """Return the visual as a browser loads it."""
    notes: list[str] = []
    data = visuals_glb([visual], notes)
    assert not notes
    return trimesh.load(io.BytesIO(data), file_type="glb", process=False)


def colors(scene: Any) -> np.ndarray:
    return np.concatenate([np.asarray(part.visual.vertex_colors)[:, :3] for part in scene.geometry.values()])


@pytest.mark.parametrize(
    ("kind", "size", "extents"),
    [
        ("box", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
        ("sphere", (0.1,), (0.2, 0.2, 0.2)),
        ("cylinder", (0.1, 0.4), (0.2, 0.2, 0.4)),
        ("capsule", (0.1, 0.4), (0.2, 0.2, 0.6)),
    ],
)
def test_primitives_have_their_size_and_colour(kind: str, size: tuple[float, ...], extents: tuple[float, ...]) -> None:
    scene = loaded(shape(kind, size, rgba=RED))
    assert scene.extents == pytest.approx(extents, abs=2e-3)
    assert scene.bounds.mean(axis=0) == pytest.approx((0, 0, 0), abs=1e-3)
    assert (colors(scene) == (255, 0, 0)).all()


def test_meshes_of_an_arm_keep_their_pose_and_colours() -> None:
    pytest.importorskip("pybullet_data")
    pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
    from hal.drivers.viser.scene import shown_visuals

    links = shown_visuals(read_urdf(Path(panda().urdf)), "panda", [])
    (link,) = links["panda_link1"]
    scene = loaded(link)
    assert scene.bounds == pytest.approx(trimesh.load(link.file, process=False).bounds, abs=1e-3)
    (finger,) = links["panda_leftfinger"]
    shades = colors(loaded(finger)).astype(int)
    assert (np.ptp(shades, axis=1) < 20).all()  # greys
    assert shades.min() < 70  # the dark pad, in linear numbers
    assert shades.max() > 180  # the white rest


def test_meshes_that_are_not_installed_are_drawn_by_the_collision_shapes(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
    from hal.drivers.viser.scene import shown_visuals

    file = tmp_path / "arm.urdf"
    file.write_text(re.sub(r"://\w+/", "://no_such_package/", find_data("robots", "panda.urdf").read_text()))
    notes: list[str] = []
    drawn = shown_visuals(read_urdf(file, meshes=False), "panda", notes)
    assert [visual.kind for visual in drawn["panda_link1"]] == ["cylinder", "cylinder"]
    (note,) = notes
    assert "no_such_package" in note


def test_few_large_triangles_keep_their_texture() -> None:
    urdf = read_urdf(Path(data("table/table.urdf")))
    (top, *_) = urdf.links[urdf.root].visuals
    scene = loaded(shape("mesh", top.size, top.file))
    pictures = [part.visual.material.baseColorTexture for part in scene.geometry.values()]
    assert len(pictures) == 1
    assert max(pictures[0].size) <= 512


@pytest.mark.parametrize("content", [None, "\0\1\2"])
def test_wrong_mesh_file_is_named(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "odd.stl"
    if content is not None:
        file.write_text(content)
    notes: list[str] = []
    assert visuals_glb([shape("mesh", (1.0, 1.0, 1.0), str(file))], notes) == b""
    (note,) = notes
    assert "odd.stl" in note


def test_workspace_is_drawn_at_its_bounded_sides() -> None:
    pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
    from hal.drivers.viser.scene import workspace_lines

    box = workspace_lines(WorkspaceSpec((0.1, -0.2, 0.0), (0.6, 0.2, 0.5)))
    assert box.shape == (12, 2, 3)
    assert box.reshape(-1, 3).min(axis=0) == pytest.approx((0.1, -0.2, 0.0))
    assert box.reshape(-1, 3).max(axis=0) == pytest.approx((0.6, 0.2, 0.5))
    table = workspace_lines(WorkspaceSpec((-10.0, -10.0, 0.01), (10.0, 10.0, 10.0)))
    assert table.shape == (4, 2, 3)
    assert (table[..., 2] == np.float32(0.01)).all()
    assert len(workspace_lines(WorkspaceSpec((-10.0,) * 3, (10.0,) * 3))) == 0


def test_a_camera_is_a_pyramid_where_it_sees_from() -> None:
    """On the link that carries it; not at all if its pose is unknown."""
    pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
    from hal.drivers.viser.scene import draw_cameras

    nodes: dict[str, Any] = {}

    def add(path: str, fov: float, aspect: float, **_: object) -> Any:
        nodes[path] = SimpleNamespace(fov=fov, aspect=aspect, position=np.zeros(3), wxyz=np.array([1.0, 0.0, 0.0, 0.0]))
        return nodes[path]

    cameras = load("panda_table", sim=True).resolve().cameras
    arm: Any = SimpleNamespace(spec=panda(), paths={"panda_hand": "/hand"})
    scene: Any = SimpleNamespace(add_camera_frustum=add)
    draw_cameras(scene, [*cameras, replace(cameras[0], name="lost", view=None)], [arm])
    assert nodes.keys() == {"/cameras/scene", "/hand/wrist"}
    for camera, node in zip(cameras, nodes.values(), strict=True):
        assert camera.view is not None
        assert node.position == pytest.approx(camera.view.position)
        assert np.roll(node.wxyz, -1) == pytest.approx(camera.view.orientation)
        assert 0.5 * camera.height / math.tan(node.fov / 2) == pytest.approx(camera.K[1][1])
        assert node.aspect == pytest.approx(camera.width / camera.height, rel=0.01)


def test_what_an_arm_goes_to_is_the_way_of_its_motion_or_the_points_of_its_newest_command() -> None:
    pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
    from hal.drivers.viser.shapes import find_goal

    mail = RobotMail(memoryview(bytearray(RobotMail.size(2))), 2)

    def send(session: int, command: Command) -> None:
        now = time.monotonic()
        kind, values = encode(command, now)
        mail.put_command(CommandRecord(1, session, now, now + 60.0, kind, values))

    mail.put_session(SessionRecord(1, 0, 0))
    assert find_goal(mail, None) is None
    send(1, JointChunk(time.monotonic() + np.array([0.1, 0.2, 0.3]), [[1, 2], [3, 4], [5, 6]]))
    assert find_goal(mail, None) == (Kind.JOINT_CHUNK, (1, 2, 3, 4, 5, 6))
    mail.put_session(SessionRecord(2, 0, 0))
    assert find_goal(mail, None) is None, "that session is over"
    mail.put_way(2, [(k, -k) for k in range(1000)])
    kind, values = find_goal(mail, None) or (None, ())
    assert (kind, values[-2:]) == (Kind.JOINT_CHUNK, (999, -999)), "a long way has fewer points, and its last one"
    assert 400 < len(values) <= 2 * CHUNK_POINTS
    mail.put_session(SessionRecord(0, 0, 0))
    assert find_goal(mail, None) is None
