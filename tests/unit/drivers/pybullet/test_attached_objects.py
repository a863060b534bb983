"""Things in an arm's hand: they go where the link goes, in the world and in its mirrors, and touch nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from errors_kit import raises_code, raises_problems
from specs import panda

import hal
from hal.config import load
from hal.drivers.pybullet.world import PyBulletWorld
from hal.errors import CommandError, ConfigError
from hal.geometry import Pose
from hal.specs import BodySpec, WorldSpec, from_json, to_json

IN_HAND = Pose([0.03, 0.0, 0.19], [0.5, 0.5, 0.5, 0.5])


def held(name: str = "board", robot: str | None = "panda", link: str | None = "panda_hand") -> BodySpec:
    x, y, z = IN_HAND.position.tolist()
    a, b, c, d = IN_HAND.orientation.tolist()
    return BodySpec(
        name, (x, y, z), (a, b, c, d), "box", half_extents=(0.1, 0.1, 0.002), mass=5.0, robot=robot, link=link
    )


def pose_of(scene: PyBulletWorld, name: str, link: str | None = None) -> Pose:
    found = scene.pose(name, link)
    return Pose(found["position"], found["orientation"])


def off(scene: PyBulletWorld) -> tuple[float, float]:
    return pose_of(scene, "board").distance(pose_of(scene, "panda", "panda_hand") @ IN_HAND)


@pytest.fixture
def spec() -> WorldSpec:
    return WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (held(),), (panda(),))


@pytest.fixture
def scene(spec: WorldSpec) -> Iterator[PyBulletWorld]:
    made = PyBulletWorld(spec)
    yield made
    made.close()


def bend(scene: PyBulletWorld, steps: int = 60) -> None:
    """Let the arm fall: its motors hold nothing any more."""
    body = scene.body("panda")
    for joint in body.movable:
        scene.client.setJointMotorControl2(body.id, joint, scene.client.VELOCITY_CONTROL, force=0.0)
    for _ in range(steps):
        scene.step()


def test_follows_its_link_through_steps_and_resets(scene: PyBulletWorld, spec: WorldSpec) -> None:
    assert max(off(scene)) < 1e-6
    start = pose_of(scene, "board")
    bend(scene)
    assert pose_of(scene, "board").distance(start)[0] > 0.05, "it moved"
    assert max(off(scene)) < 1e-6
    scene.reset("panda")
    assert max(off(scene)) < 1e-6
    bend(scene)
    scene.reset()
    assert pose_of(scene, "board").distance(start)[0] < 1e-6


def test_has_no_weight_and_no_contacts(spec: WorldSpec) -> None:
    def fall(bodies: tuple[BodySpec, ...]) -> np.ndarray:
        with closing(PyBulletWorld(replace(spec, bodies=bodies))) as scene:
            bend(scene)
            assert all("board" not in (c["a"], c["b"]) for c in scene.contacts())
            return np.array(scene.pose("panda", "panda_hand")["position"])

    obstacle = BodySpec("box", (0.35, 0.0, 0.1), (0, 0, 0, 1), "box", half_extents=(0.01, 0.01, 0.1), fixed=True)
    assert np.array_equal(fall((obstacle,)), fall((held(), obstacle)))


def test_mirror_world_shows_it(scene: PyBulletWorld, spec: WorldSpec) -> None:
    with closing(PyBulletWorld(from_json(WorldSpec, to_json(spec)), mirror=True)) as mirror:
        bend(scene)
        mirror.show(scene.snapshot())
        assert max(off(mirror)) < 1e-6
        assert pose_of(mirror, "board").distance(pose_of(scene, "board"))[0] < 1e-6


def test_is_added_and_removed_but_not_placed(scene: PyBulletWorld) -> None:
    scene.add(held("second", link="panda_link7"))
    scene.step()
    expected = pose_of(scene, "panda", "panda_link7") @ IN_HAND
    assert pose_of(scene, "second").distance(expected)[0] < 1e-6
    for act in (scene.set_pose, scene.reset):
        with raises_code(CommandError, "is_attached"):
            act("second", pose={"position": [0, 0, 0]})
    scene.remove("second")
    bend(scene, 10)
    assert max(off(scene)) < 1e-6


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"robot": "pandas"}, "unknown_device"),
        ({"link": "panda_hnad"}, "unknown_link"),
        ({"robot": "board"}, "unknown_device"),
    ],
)
def test_missing_arm_or_link_is_refused_and_changes_nothing(scene, wrong, code):
    with raises_problems(code):
        scene.add(held("second", **wrong))
    assert scene.names() == ["board", "panda"]
    bend(scene, 10)
    assert max(off(scene)) < 1e-6


HELD = "{file: charuco_board, attached: {robot: panda, link: panda_hand, pose: [0.03, 0, 0.19, 0.5, 0.5, 0.5, 0.5]}}"


def test_rig_file_attaches_an_object() -> None:
    overrides = ["cameras={}", f"objects=[{HELD}]"]
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=overrides) as opened:
        arm = opened.robots["panda"]
        opened.clock.sleep(0.1)
        arm.move_to(arm.home + 0.2)
        expected = opened.world.pose("panda", "panda_hand") @ IN_HAND
        assert opened.world.pose("charuco_board").distance(expected)[0] < 1e-6


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        ("{file: charuco_board, attached: {robot: pandas, link: hand}}", "unknown_device"),
        ("{file: charuco_board, attached: {robot: panda}}", "missing_key"),
        ("{name: p, shape: plane, attached: {robot: panda, link: panda_hand}}", "conflict"),
    ],
)
def test_wrong_attachment_in_a_rig_is_refused(entry: str, code: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load("panda_table", sim=True, overrides=[f"objects=[{entry}]"])
    assert [problem.code for problem in caught.value.problems] == [code]


P = "[0.1, 0.2, 0.3, 0, 0, 0.6, 0.8]"


def test_camera_is_attached_by_its_pose() -> None:
    place = f"cameras.wrist.attached={{robot: panda, link: hand, pose: {P}}}"
    plan = load("panda_table", sim=True, overrides=[place]).resolve()
    view = next(camera.view for camera in plan.cameras if camera.name == "wrist")
    assert (view.robot, view.link) == ("panda", "panda_hand")
    assert view.position == (0.1, 0.2, 0.3)
    assert view.orientation == pytest.approx((0, 0, 0.6, 0.8))


@pytest.mark.parametrize("more", ["target", "translation"])
def test_camera_with_two_places_is_refused(more: str) -> None:
    place = f"cameras.wrist.attached={{robot: panda, link: hand, pose: {P}, {more}: [0, 0, 1]}}"
    with pytest.raises(ConfigError) as caught:
        load("panda_table", sim=True, overrides=[place])
    assert [(problem.key, problem.code) for problem in caught.value.problems] == [
        ("cameras.wrist.attached", "conflict")
    ]
