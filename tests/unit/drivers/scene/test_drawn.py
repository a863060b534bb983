"""What is drawn of a world: where a snapshot has it, after edits, and with files that are not installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from errors_kit import raises_code, raises_problems
from pictures_kit import box, drawn, stepped
from specs import cube, data, floor, iiwa, panda

from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.mirror import LocalMirror
from hal.drivers.scene.world import SimulatedWorld
from hal.errors import DeviceNotFound
from hal.geometry import Pose
from hal.specs import BodySpec, to_json

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
TURNED = (0.1, 0.2, 0.3, 0.9273618495495703)


def pose(world: DrawnWorld | SimulatedWorld[Any], name: str, link: str | None = None) -> Pose:
    found = world.pose(name, link)
    return Pose(found["position"], found["orientation"])


def assert_same(world: SimulatedWorld[Any], shown: DrawnWorld) -> None:
    assert list(shown.bodies) == world.names()
    for name, body in shown.bodies.items():
        assert body.index == world.describe(name)["index"]
        for link in [None] if body.spec.urdf is None else world.describe(name)["links"]:
            distance, angle = pose(world, name, link).distance(pose(shown, name, link))
            assert distance < 1e-6, (name, link)
            assert angle < 1e-5, (name, link)


def test_shows_every_link_edits_and_fixed_bodies_that_were_moved() -> None:
    mug = BodySpec("mug", (0.3, 0.4, 0.1), TURNED, "urdf", urdf=data("objects/mug.urdf"), scale=2.0)
    held = BodySpec(
        "held", (0.0, 0.1, 0.2), TURNED, "box", half_extents=(0.1, 0.1, 0.1), robot="panda", link="panda_hand"
    )
    arms = panda(base_position=(0.0, 0.0, 0.5), base_orientation=TURNED), iiwa(base_position=(0.0, 1.0, 0.0))
    with stepped(floor(), cube((0.5, -0.2, 0.03)), mug, held, robots=arms) as world:
        mirror = LocalMirror(world)
        shown = mirror.drawn
        assert_same(world, shown)  # at the start
        assert len(shown.snapshot()) == len(world.snapshot())
        before = pose(shown, "panda", "panda_hand")
        world.add(box("wall", (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)))
        world.remove("cube")
        world.set_color("wall", (1.0, 0.0, 0.0, 1.0))
        world.set_pose("wall", {"position": [0.0, 2.0, 0.5]})
        world.reset("panda", q=[0.5, -0.5, 0.2, -2.0, 0.1, 1.5, 0.5])
        for _ in range(30):
            world.step()
        mirror.update()
        assert pose(shown, "panda", "panda_hand").distance(before)[0] > 0.1
        assert shown.visuals(shown.bodies["wall"].id)[0].rgba == (1.0, 0.0, 0.0, 1.0)
        assert_same(world, shown)


def test_a_snapshot_of_other_bodies_is_refused() -> None:
    shown = drawn(floor(), cube())
    snapshot = shown.snapshot()
    shown.request("add", {"spec": to_json(box("wall", (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)))})
    with pytest.raises(ValueError, match="snapshot"):
        shown.show(snapshot)
    with raises_code(DeviceNotFound, "unknown_body"):
        shown.pose("cub")
    with raises_code(DeviceNotFound, "unknown_link"):
        shown.pose("cube", "lid")


def test_an_invisible_object_and_an_infinite_plane() -> None:
    hidden = BodySpec("hidden", (0.0, 0.0, 0.0), UPRIGHT, "sphere", radius=0.1, visible=False)
    shown = drawn(floor(), hidden)
    assert shown.visuals(shown.bodies["hidden"].id) == ()
    (plane,) = shown.visuals(shown.bodies["floor"].id)
    assert (plane.kind, plane.position[2] + plane.size[2] / 2) == ("box", 0.0)


def urdf_of(folder: Path, visual: str, collision: str) -> BodySpec:
    """An object whose URDF names these two shapes, in XML."""
    urdf = folder / "thing.urdf"
    urdf.write_text(
        '<robot name="thing"><link name="base"><inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" '
        f'iyy="0.01" iyz="0" izz="0.01"/></inertial><visual><geometry>{visual}</geometry><material name="red">'
        f'<color rgba="1 0 0 1"/></material></visual><collision><origin xyz="0 0 0.5"/><geometry>{collision}'
        "</geometry></collision></link></robot>"
    )
    return BodySpec("thing", (0.0, 0.0, 0.0), UPRIGHT, "urdf", urdf=str(urdf))


ABSENT = '<mesh filename="package://no_such_meshes/thing.obj"/>'


def test_without_the_package_of_its_meshes_a_link_is_drawn_by_its_collision_shapes(tmp_path: Path) -> None:
    spec = urdf_of(tmp_path, ABSENT, '<box size="0.1 0.2 0.3"/>')
    shown = drawn(spec)
    (visual,) = shown.visuals(shown.bodies["thing"].id)
    assert (visual.kind, visual.size, visual.position) == ("box", (0.1, 0.2, 0.3), (0.0, 0.0, 0.5))
    assert visual.rgba == (1.0, 0.0, 0.0, 1.0)
    assert len(shown.notes) == 1
    assert "no_such_meshes" in shown.notes[0]
    with stepped(spec) as world:
        assert world.warnings == []
        assert world.aabb("thing")["upper"][2] == pytest.approx(0.65, abs=2e-3)


def test_the_first_of_several_shapes_whose_file_exists_is_drawn_and_touched(tmp_path: Path) -> None:
    (tmp_path / "there.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    there = '<mesh filename="there.obj"/>'
    visual = f'{ABSENT}<mesh filename="gone.obj"/>{there}<box size="1 1 1"/>'
    spec = urdf_of(tmp_path, visual, f'{ABSENT}<box size="2 2 2"/>')
    shown = drawn(spec)
    (visual,) = shown.visuals(shown.bodies["thing"].id)
    assert (visual.kind, Path(visual.file).name, shown.notes) == ("mesh", "there.obj", [])
    with stepped(spec) as world:
        assert world.aabb("thing")["upper"][2] == pytest.approx(1.5, abs=2e-3)
    plain = drawn(urdf_of(tmp_path, f'{ABSENT}<box size="1 1 1"/>', there))
    assert plain.visuals(plain.bodies["thing"].id)[0].kind == "box"
    assert "no_such_meshes" in plain.notes[0]


@pytest.mark.parametrize(
    ("visual", "collision", "code"),
    [
        ('<box size="1 1 1"/>', ABSENT, "missing_package"),
        ('<mesh filename="gone.obj"/>', '<box size="1 1 1"/>', "missing_file"),
    ],
)
def test_a_mesh_that_is_touched_or_should_be_beside_the_urdf_must_exist(tmp_path, visual, collision, code):
    spec = urdf_of(tmp_path, visual, collision)
    with raises_problems(code):
        drawn(spec)
    with raises_problems(code), stepped(spec):
        pass
