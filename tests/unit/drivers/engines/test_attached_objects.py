"""Objects attached to a link of an arm, on each engine: they follow the link, and touch nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine
from errors_kit import raises_code, raises_problems
from specs import PANDA_HOME, panda

import hal
from hal.config import load
from hal.driver import Setpoint
from hal.errors import CommandError, ConfigError
from hal.geometry import Pose
from hal.specs import BodySpec

IN_HAND = Pose([0.03, 0.0, 0.19], [0.5, 0.5, 0.5, 0.5])


def held(name: str = "board", robot: str | None = "panda", link: str | None = "panda_hand") -> BodySpec:
    x, y, z = IN_HAND.position.tolist()
    a, b, c, d = IN_HAND.orientation.tolist()
    return BodySpec(
        name, (x, y, z), (a, b, c, d), "box", half_extents=(0.1, 0.1, 0.002), mass=5.0, robot=robot, link=link
    )


def pose_of(scene: Any, name: str, link: str | None = None) -> Pose:
    found = scene.pose(name, link)
    return Pose(found["position"], found["orientation"])


def off(scene: Any) -> tuple[float, float]:
    return pose_of(scene, "board").distance(pose_of(scene, "panda", "panda_hand") @ IN_HAND)


@pytest.fixture
def scene(engine: Engine) -> Iterator[Any]:
    made = engine.world(held(), panda())
    yield made
    made.close()


def bend(engine: Engine, scene: Any, steps: int = 60) -> None:
    """Lower the arm at its shoulder, by 0.3 rad in 60 steps."""
    arm = engine.robot(scene)
    arm.open()
    q = list(PANDA_HOME)
    for step in range(steps):
        q[1] = PANDA_HOME[1] + 0.005 * (step + 1)
        arm.write(Setpoint(q, [0.0] * 7, [0.0] * 7))
        scene.step()
    arm.close()


def test_follows_its_link_through_steps_and_resets(engine: Engine, scene: Any) -> None:
    assert max(off(scene)) < 1e-6
    start = pose_of(scene, "board")
    bend(engine, scene)
    assert pose_of(scene, "board").distance(start)[0] > 0.05, "it moved"
    assert max(off(scene)) < 1e-6
    scene.reset("panda")
    assert max(off(scene)) < 1e-6
    bend(engine, scene)
    scene.reset()
    assert pose_of(scene, "board").distance(start)[0] < 1e-6


def test_has_no_weight_and_no_contacts(engine: Engine) -> None:
    def lowered(*bodies: BodySpec) -> np.ndarray:
        with closing(engine.world(*bodies, panda())) as scene:
            bend(engine, scene)
            assert all("board" not in (c["a"], c["b"]) for c in scene.contacts())
            return np.array(scene.pose("panda", "panda_hand")["position"])

    obstacle = BodySpec("box", (0.35, 0.0, 0.1), (0, 0, 0, 1), "box", half_extents=(0.01, 0.01, 0.1), fixed=True)
    assert np.array_equal(lowered(obstacle), lowered(held(), obstacle))


def test_is_added_and_removed_but_not_placed(engine: Engine, scene: Any) -> None:
    scene.add(held("second", link="panda_link7"))
    scene.step()
    expected = pose_of(scene, "panda", "panda_link7") @ IN_HAND
    assert pose_of(scene, "second").distance(expected)[0] < 1e-6
    for act in (scene.set_pose, scene.reset):
        with raises_code(CommandError, "is_attached"):
            act("second", pose={"position": [0, 0, 0]})
    scene.remove("second")
    bend(engine, scene, 10)
    assert max(off(scene)) < 1e-6


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"robot": "pandas"}, "unknown_device"),
        ({"link": "panda_hnad"}, "unknown_link"),
        ({"robot": "board"}, "unknown_device"),
    ],
)
def test_missing_arm_or_link_is_refused_and_changes_nothing(engine, scene, wrong, code):
    with raises_problems(code):
        scene.add(held("second", **wrong))
    assert scene.names() == ["board", "panda"]
    bend(engine, scene, 10)
    assert max(off(scene)) < 1e-6


HELD = "{file: charuco_board, attached: {robot: panda, link: panda_hand, pose: [0.03, 0, 0.19, 0.5, 0.5, 0.5, 0.5]}}"


def test_rig_file_attaches_an_object(engine: Engine) -> None:
    overrides = ["cameras={}", f"objects=[{HELD}]"]
    with hal.open(
        "panda_table", sim=True, engine=engine.name, clock="lock_step", pad="none", overrides=overrides
    ) as opened:
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
