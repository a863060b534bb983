"""The mirror of a real arm in the simulated world of each engine: where the arm is, whatever is in its way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine, joint_positions
from errors_kit import raises_code
from specs import PANDA_HOME, box, cube, floor, panda

from hal.errors import CommandError
from hal.kinematics.arm import Kinematics
from hal.specs import BodySpec

REST = [0.0] * 7
JOINTS = tuple(f"panda_joint{k}" for k in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


def mirrored(engine: Engine, *things: BodySpec) -> Any:
    """Return a world with the mirror of a real arm."""
    return engine.world(*things, panda("arm", driver="franka"))


@pytest.fixture
def world(engine: Engine) -> Iterator[Any]:
    world = mirrored(engine, floor())
    yield world
    world.close()


def joints(world: Any, names: tuple[str, ...] = JOINTS) -> np.ndarray:
    found = joint_positions(world, "arm")
    return np.array([found[name] for name in names])


def run(world: Any, seconds: float) -> None:
    for _ in range(round(seconds / world.dt)):
        world.step()


def test_stays_at_its_start_until_the_first_state(world: Any) -> None:
    assert world.describe("arm")["robot"]
    run(world, 1.0)
    assert joints(world) == pytest.approx(PANDA_HOME, abs=1e-4)


def test_takes_the_state_of_the_arm_at_once(world: Any) -> None:
    q = [0.3, -0.2, 0.4, -1.5, 0.2, 1.2, -0.6]
    world.follow("arm", q, REST, 0.03)
    assert (joints(world), joints(world, FINGERS)) == (pytest.approx(q), pytest.approx(0.015))
    hand = Kinematics(replace(panda().kinematics, tcp_position=(0.0, 0.0, 0.0))).pose(q)
    assert world.pose("arm", "panda_hand")["position"] == pytest.approx(hand.position, abs=1e-5)


def test_neither_sags_nor_lags(world: Any) -> None:
    """After a step it is where the arm will be then."""
    q, dq = list(PANDA_HOME), [0.0] * 7
    for k in range(480):
        t = k * world.dt
        q[0], dq[0] = 0.5 * math.sin(2 * t), math.cos(2 * t)
        world.follow("arm", q, dq, 0.04)
        world.step()
        wanted = [0.5 * math.sin(2 * (t + world.dt)), *PANDA_HOME[1:]]
        assert joints(world) == pytest.approx(wanted, abs=5e-5)


@pytest.mark.parametrize("dq", [0.0, 1.0])
def test_without_new_states_it_stays(world: Any, dq: float) -> None:
    world.follow("arm", PANDA_HOME, [dq] * 7, 0.04)
    world.step()
    stopped = joints(world)
    assert np.abs(stopped - PANDA_HOME).max() == pytest.approx(dq * world.dt, abs=1e-4)
    run(world, 1.0)
    assert joints(world) == pytest.approx(stopped, abs=1e-4)


def test_pushes_objects_and_is_not_stopped_by_them(engine: Engine) -> None:
    """A cube of 50 kg in the way of the forearm, which swings about the first joint."""
    world = mirrored(engine, floor(), box("block", (0.33, 0.35, 0.3), (0.1, 0.1, 0.3), mass=50.0))
    q = [0.0, 0.6, 0.0, -2.2, 0.0, 2.0, 0.785]
    run_into = 0.9
    for k in range(round(run_into / 0.5 / world.dt)):
        q[0] = 0.5 * k * world.dt
        world.follow("arm", q, [0.5, *REST[1:]], 0.04)
        world.step()
    assert joints(world)[0] == pytest.approx(run_into, abs=2e-3)
    assert joints(world)[1:] == pytest.approx(q[1:], abs=1e-3)
    assert world.pose("block")["position"][1] > 0.40
    world.close()


def test_fingers_hold_a_simulated_object(engine: Engine) -> None:
    """The real fingers close on nothing; the copy's close as far as the cube, and carry it."""
    kinematics = Kinematics(panda().kinematics)
    here = tuple(kinematics.fk(PANDA_HOME)[:3])
    world = mirrored(engine, floor(), cube(here))
    world.set_dynamics("cube", mass=0.2)
    q = list(PANDA_HOME)
    for k in range(60):
        world.set_pose("cube", {"position": here})
        world.follow("arm", q, REST, 0.04 - 0.0005 * k)
        world.step()
    for k in range(240):
        q[0] = 0.5 * k * world.dt
        world.follow("arm", q, [0.5, *REST[1:]], 0.0)
        world.step()
    assert joints(world, FINGERS) == pytest.approx(0.015, abs=1e-3)
    tcp = kinematics.fk(q)[:3]
    assert world.pose("cube")["position"] == pytest.approx(tcp, abs=0.01)
    assert math.dist(tcp, here) > 0.1
    world.close()


def test_unknown_width_leaves_the_fingers_alone(world: Any) -> None:
    world.follow("arm", PANDA_HOME, REST, 0.02)
    run(world, 0.1)
    world.follow("arm", PANDA_HOME, REST, None)
    run(world, 0.1)
    assert joints(world, FINGERS) == pytest.approx(0.01, abs=1e-4)


def test_reset_leaves_it_at_the_real_arm(world: Any) -> None:
    q = [0.5, *PANDA_HOME[1:]]
    world.follow("arm", q, REST, 0.04)
    world.reset()
    assert joints(world) == pytest.approx(q)
    with raises_code(CommandError, "is_mirrored"):
        world.reset("arm")
    with raises_code(CommandError, "is_robot"):
        world.set_pose("arm", {"position": [0, 0, 1]})
