"""Collision shapes of arms, their distances, and motions that would collide."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmark_kit import load_benchmark

from hal.config import load
from hal.errors import CollisionError, CommandError, ConfigError, NotSupported
from hal.kinematics.collision_model import CollisionModel, PairBounds
from hal.kinematics.collisions import Collisions
from hal.specs import BoxSpec, CollisionSpec, RobotSpec

TABLE = BoxSpec("table", (0.55, 0.0, -0.025), (0.0, 0.0, 0.0, 1.0), (1.5, 1.0, 0.05))
FOLDED = (0.0, -0.5, 0.0, -2.2, 0.0, 0.1, -0.8)
"""A Panda whose hand is in its forearm."""


def arms(*models: str, apart: float = 1.0) -> tuple[RobotSpec, ...]:
    robots = {f"arm{k}": {"model": model, "base": {"position": [k * apart, 0, 0]}} for k, model in enumerate(models)}
    return load({"robots": robots}, sim=True, driver="mock").resolve().robots


@pytest.fixture(scope="module")
def panda() -> RobotSpec:
    return arms("panda")[0]


@pytest.fixture(scope="module")
def collisions(panda: RobotSpec) -> Collisions:
    return Collisions(panda, CollisionSpec(boxes=(TABLE,)))


def sampled(spec: RobotSpec, count: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(spec.limits.lower, spec.limits.upper, (count, len(spec.joints)))


def test_home_is_free_and_a_folded_hand_is_not(panda: RobotSpec, collisions: Collisions) -> None:
    assert collisions.check(panda.home) == []
    assert 0.01 < collisions.distance(panda.home) < 0.03
    folded = collisions.check(FOLDED, margin=0.0)
    assert ("panda_link5", "panda_hand") in {(pair.first, pair.second) for pair in folded}
    assert [pair.distance for pair in folded] == sorted(pair.distance for pair in folded)
    assert folded[0].distance == pytest.approx(collisions.distance(FOLDED))


def test_the_way_is_checked_as_densely_as_needed(panda: RobotSpec, collisions: Collisions) -> None:
    found = 0
    home = np.array(panda.home)
    for goal in sampled(panda, 12):
        share = next((s for s in np.linspace(0.0, 1.0, 151) if collisions.check(home + s * (goal - home))), None)
        found += share is not None
        if share is None:
            collisions.check_motion([home, goal])
        else:
            with pytest.raises(CollisionError) as caught:
                collisions.check_motion([home, goal])
            assert caught.value.along == pytest.approx(share, abs=0.008)
            assert caught.value.code == "collision"
            assert caught.value.distance <= collisions.margin
    assert 2 <= found <= 10


def test_the_first_colliding_sample_is_found_and_a_detour_is_free(panda: RobotSpec, collisions: Collisions) -> None:
    home = np.array(panda.home)
    down = home + [0.0, 1.6, 0.0, 0.3, 0.0, 0.0, 0.0]
    index, pair = collisions.first([home, home + 0.1 * (down - home), down, home]) or (-1, None)
    assert index == 2
    assert pair is not None
    assert pair.second == "table"
    assert collisions.first([home, home + 0.1, home]) is None
    with pytest.raises(CommandError):
        collisions.first([[0.0, 1.0]])


def test_an_arm_that_begins_inside_the_margin_may_leave_it(panda: RobotSpec, collisions: Collisions) -> None:
    inside = np.array(panda.home) + [0.0, 1.52, 0.0, 0.3, 0.0, 0.0, 0.0]
    assert collisions.check(inside)
    collisions.check_motion([inside, panda.home])
    with pytest.raises(CollisionError):
        collisions.check_motion([inside, inside + [0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0]])
    parted = inside - [0.0, 0.004, 0.0, 0.0, 0.0, 0.0, 0.0]  # and still inside
    assert collisions.check(parted)
    with pytest.raises(CollisionError):
        collisions.check_motion([inside, parted, inside])


def slides(folder: Path) -> str:
    """Return the model of an arm whose first joint turns what its second one slides far out."""
    box = "<collision><geometry><box size='0.1 0.1 0.1'/></geometry></collision>"
    joint = (
        "<joint name='{0}' type='{1}'><parent link='{2}'/><child link='{3}'/><axis xyz='{4}'/>"
        "<limit lower='-1.5' upper='1.5' effort='9' velocity='1'/></joint>"
    )
    links = "".join(f"<link name='{name}'>{box}</link>" for name in ("base", "turned", "tip"))
    joints = joint.format("turn", "revolute", "base", "turned", "0 0 1")
    joints += joint.format("slide", "prismatic", "turned", "tip", "1 0 0")
    (folder / "slides.urdf").write_text(f"<robot name='slides'>{links}{joints}</robot>")
    model = {"urdf": "slides.urdf", "joints": ["turn", "slide"], "tcp": {"link": "tip"}, "home": [0, 1]}
    file = folder / "slides.yaml"
    file.write_text(json.dumps(model | {"limits": {"acceleration": 1, "jerk": 1}}))
    return str(file)


@pytest.mark.parametrize("models", [("panda",), ("iiwa", "panda"), ("slides",)], ids="+".join)
def test_bounds_never_exceed_distances(models: Sequence[str], tmp_path: Path) -> None:
    robots = arms(*(slides(tmp_path) if model == "slides" else model for model in models), apart=0.7)
    model = CollisionModel(robots, CollisionSpec(boxes=(TABLE,)))
    lower = np.concatenate([r.limits.lower for r in robots])
    upper = np.concatenate([r.limits.upper for r in robots])
    rng = np.random.default_rng(5)
    for _ in range(10):
        start, end = rng.uniform(lower, upper, (2, model.n))
        for share in (1.0, 0.1):
            model.place(start)
            before = model.distances()
            model.place(start + share * (end - start))
            apart = np.abs(model.distances() - before)
            assert (apart <= model.levers @ np.abs(share * (end - start)) + 1e-6).all()


def test_near_pairs_are_those_that_a_full_computation_finds(panda: RobotSpec) -> None:
    model = CollisionModel([panda], CollisionSpec(boxes=(TABLE,)))
    bounds = PairBounds(model)
    q = np.array(panda.home)
    rng = np.random.default_rng(2)
    seen = 0
    for _ in range(200):
        q = np.clip(q + rng.normal(0.0, 0.1, 7), panda.limits.lower, panda.limits.upper)
        near = set(bounds.near(q, np.zeros(7), model.margins))
        model.place(q)
        assert near == set(np.flatnonzero(model.distances() < model.margins).tolist())
        seen += len(near)
    assert seen > 0


def test_arms_of_one_robot_keep_off_its_body_once_whatever_their_tools(panda: RobotSpec, tmp_path: Path) -> None:
    other = tmp_path / "with_another_tool.urdf"
    other.write_bytes(Path(panda.kinematics.urdf).read_bytes())
    second = replace(panda, name="second", same=panda.name, kinematics=replace(panda.kinematics, urdf=str(other)))
    model = CollisionModel([panda, second], CollisionSpec())
    pairs = [model.pair(k, 0.0) for k in range(model.count)]
    between = [pair for pair in pairs if pair.first.partition("/")[0] != pair.second.partition("/")[0]]
    assert between
    assert not any("panda_link0" in str(pair) for pair in between)


def test_two_arms_see_each_other_where_they_are() -> None:
    left, right = arms("panda", "panda", apart=1.0)
    at = np.array(right.home)
    collisions = Collisions(left, CollisionSpec(), [(right, lambda: at)])
    stretched = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 1.8, 0.8])
    assert collisions.check(left.home) == []
    found = collisions.check(stretched)
    assert found
    assert found[0].first.startswith("arm0/")
    assert found[0].second.startswith("arm1/")
    at[:] = [2.5, -1.2, 0.0, -2.5, 0.0, 1.6, 0.8]
    assert collisions.check(stretched) == []
    assert not Collisions(left, CollisionSpec(arms=False), [(right, lambda: at)]).check(stretched)


def test_pairs_that_always_touch_are_left_out_and_named() -> None:
    (piper,) = arms("piper")
    collisions = Collisions(piper, CollisionSpec())
    assert any("base_link and link2" in note for note in collisions.notes)
    assert collisions.check(piper.home) == []


def test_verdicts_are_those_of_pybullet() -> None:
    pytest.importorskip("pybullet")
    found = load_benchmark("collisions").verdicts("panda", 40)
    assert found["colliding"] > 2
    assert found["of those, others by 1 mm or more"] == 0


def test_an_arm_without_shapes_is_refused(panda: RobotSpec, tmp_path: Path) -> None:
    bare = replace(panda, kinematics=replace(panda.kinematics, urdf=str(tmp_path / "bare.urdf")))
    text = re.sub("<collision>.*?</collision>", "", Path(panda.urdf).read_text(), flags=re.DOTALL)
    (tmp_path / "bare.urdf").write_text(text)
    with pytest.raises(NotSupported) as caught:
        Collisions(bare, CollisionSpec())
    assert caught.value.code == "no_shapes"


@pytest.mark.parametrize(
    ("given", "key", "code"),
    [
        ({"boxes": ["tabel"]}, "collisions.boxes.0", "unknown_object"),
        ({"boxes": ["cube"]}, "collisions.boxes.0", "wrong_shape"),
        ({"boxes": ["duck"]}, "collisions.boxes.0", "wrong_shape"),
        ({"boxes": [{"name": "wall", "position": [0, 0, 0]}]}, "collisions.boxes.0", "missing_key"),
        ({"margin": -1}, "collisions.margin", "out_of_range"),
        ({"itself": True}, "collisions.itself", "unknown_key"),
    ],
)
def test_wrong_keys_are_named(given: dict[str, object], key: str, code: str) -> None:
    objects = ["table", "cube", "duck"]
    with pytest.raises(ConfigError) as caught:
        load({"robots": {"arm": {"model": "panda"}}, "objects": objects, "collisions": given}, sim=True).resolve()
    assert [(problem.key, problem.code) for problem in caught.value.problems] == [(key, code)]


def test_a_fixed_object_is_given_by_its_name() -> None:
    rig = {"robots": {"arm": {"model": "panda"}}, "objects": ["table"], "collisions": {"boxes": ["table"]}}
    (box,) = load(rig, sim=True).resolve().collisions.boxes
    assert (box.name, box.size, box.position) == ("table", (1.5, 1.0, 0.05), (0.0, 0.0, 0.575))
