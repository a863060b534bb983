"""Saved and restored states of the simulated world, and simulations that become unstable."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine, need_engine
from errors_kit import raises_code
from specs import PANDA_HOME, box, cube, floor, iiwa, panda

import hal
from hal.driver import Setpoint
from hal.errors import CommandError
from hal.learning.episode import reset_scene
from hal.world import WorldState


class SimulatedBench:
    """A stack of two boxes, a falling one, and an arm that moves while its gripper closes."""

    def __init__(self, engine: Engine) -> None:
        lid = box("lid", (0.5, -0.2, 0.09), (0.03, 0.03, 0.03), mass=0.5)
        falling = box("falling", (0.2, 0.5, 0.6), (0.03, 0.02, 0.01), mass=0.2, orientation=(0.1, 0.2, 0.3, 0.927))
        self.world = engine.world(floor(), cube((0.5, -0.2, 0.03)), lid, falling, panda())
        self.robot, self.gripper = engine.robot(self.world), engine.gripper(self.world)
        self.robot.open()
        self.gripper.open()

    def run(self, steps: int, torque: bool | None = None) -> list[Any]:
        """Step, and return every state; the arm moves, or is driven by torques, unless ``torque`` is None."""
        seen = []
        for k in range(steps):
            q = [home + 0.1 * math.sin(0.02 * k) for home in PANDA_HOME]
            dq = [0.1 * 0.02 * 240 * math.cos(0.02 * k)] * 7
            if torque is not None:
                tau = [0.3 * math.sin(0.1 * k)] * 7 if torque else None
                self.robot.write(Setpoint(q, dq, [0.0] * 7, tau))
            self.world.step()
            reading, grip = self.robot.read(0.0), self.gripper.read(0.0)
            commanded = [*(reading.q_commanded or ()), *(reading.dq_commanded or ())]
            seen.append(
                [
                    self.world.snapshot(),
                    reading.q,
                    reading.dq,
                    commanded,
                    grip[3:],
                    sorted(map(str, self.world.contacts())),
                ]
            )
        return seen


@pytest.fixture
def bench(engine: Engine) -> Iterator[SimulatedBench]:
    made = SimulatedBench(engine)
    yield made
    made.world.close()


def test_contacts_that_the_solver_remembers_change_nothing_after_a_restore(engine: Engine) -> None:
    where: Any = {"engine": engine.name, "clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with hal.open("panda_table", sim=True, **where) as rig:
        reset_scene(rig, rig.robots["panda"], random=np.random.default_rng(1))  # the duck comes to rest on its mesh
        state = rig.world.save()
        rig.clock.sleep(0.5)
        there = rig.world.poses().poses
        rig.world.restore(state)
        rig.clock.sleep(0.5)
        assert rig.world.poses().poses == there


def test_a_state_survives_bytes_and_another_order_of_its_keys(bench: SimulatedBench) -> None:
    bench.run(20, False)
    bench.world.apply_force("falling", [0.5, 0.0, 0.0], duration=0.2)
    state = WorldState(bench.world.save())
    first = bench.run(60)
    copy = WorldState.from_bytes(state.to_bytes())
    assert copy == state
    for again in (copy, json.loads(json.dumps(state, sort_keys=True)), _reversed(state)):
        bench.world.restore(again)
        assert bench.run(60) == first, "the force too"
    for wrong in (b"", b"no state", state.to_bytes()[:-9], zlib.compress(b"[1]")):
        with raises_code(CommandError, "wrong_state"):
            WorldState.from_bytes(wrong)


def _reversed(part: Any) -> Any:
    if isinstance(part, dict):
        return {key: _reversed(part[key]) for key in reversed(part)}
    return [_reversed(one) for one in part] if isinstance(part, list) else part


def test_an_open_session_waits_at_the_restored_set_point_for_a_new_command(engine: Engine) -> None:
    where: Any = {"engine": engine.name, "clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with hal.open("panda_table", sim=True, **where) as rig:
        arm = rig.robots["panda"]
        with arm.control(rate_hz=20) as control:

            def stream(command: Any, times: int, grip: float | None = None) -> None:
                for _ in range(times):
                    control.send(command, grip=grip)
                    rig.clock.sleep(0.05)

            stream(hal.Twist(linear=[0.0, 0.1, 0.0]), 4)
            state = rig.world.save()
            held, before = arm.state().q_set, rig.clock.now()
            stream(hal.Twist(linear=[0.0, 0.0, 0.1]), 10, grip=1.0)
            assert np.abs(arm.state().q - held).max() > 0.02
            rig.world.restore(state)
            assert rig.clock.now() > before, "time goes on"
            rig.clock.sleep(0.1)
            assert np.abs(arm.state().q - held).max() < 2e-3, "the old command is gone"
            stream(hal.Twist(linear=[0.0, 0.0, 0.1]), 10, grip=1.0)
            assert np.abs(arm.state().q - held).max() > 0.02, "the session follows a new one"
            assert arm.gripper is not None
            assert arm.gripper.state().width < 0.06, "and so do the fingers, which the restored state has open"


@pytest.mark.parametrize("torque", [False, True])
def test_the_steps_after_a_restore_repeat_those_after_the_save(engine, bench, torque):
    bench.run(20, torque)
    bench.gripper.grasp(0.03, 0.05, 20.0, 0.01, 0.01)
    bench.run(30, torque)
    state = json.loads(json.dumps(bench.world.save()))
    first = bench.run(120, torque), bench.run(60)  # then its motors, or the last torques, hold it
    assert np.abs(np.subtract(first[0][-1][0], first[0][0][0])).max() > 0.01
    bench.gripper.move(0.08, 0.1, 20.0)
    bench.run(40, not torque)
    for world in (bench, other := SimulatedBench(engine)):
        steps = world.world.steps
        world.world.restore(state)
        assert world.world.steps == steps, "time goes on"
        assert (world.run(120, torque), world.run(60)) == first
    other.world.close()


def test_fingers_have_the_forces_of_the_restored_state_before_the_next_step(bench: SimulatedBench) -> None:
    """Until then an engine may have those of its last step, by which fingers at rest would count as busy."""
    bench.run(120, False)
    idle, there = bench.gripper.read(0.0), bench.world.save()
    first = bench.run(30, False)
    bench.gripper.grasp(0.0, 0.2, 20.0, 0.01, 0.01)
    bench.run(2, False)
    pressing, held = bench.gripper.read(0.0), bench.world.save()
    assert abs(pressing.force - idle.force) > 1.0
    bench.world.restore(there)
    assert bench.gripper.read(0.0)[3:] == idle[3:]
    assert bench.run(30, False) == first
    bench.world.restore(held)
    assert bench.gripper.read(0.0)[3:] == pressing[3:]
    bench.world.reset()
    assert bench.gripper.read(0.0).force == 0.0


def test_a_restore_changes_what_cameras_see_and_a_state_of_other_bodies_is_refused(bench: SimulatedBench) -> None:
    world = bench.world
    state, version = world.save(), world.version
    world.restore(state)
    assert world.version != version
    for wrong in (None, {}, {**state, "engine": "other"}, {**state, "bodies": []}, {**state, "state": {}}):
        with raises_code(CommandError, "wrong_state"):
            world.restore(wrong)
    before = world.snapshot()
    world.remove("falling")
    with pytest.raises(CommandError, match="no falling") as refused:  # it names what differs
        world.restore(state)
    assert refused.value.code == "wrong_state"
    world.add(box("falling", (0.2, 0.5, 0.6), (0.03, 0.02, 0.01), mass=0.2))
    with raises_code(CommandError, "wrong_state"):
        world.restore(state)  # in another order
    assert len(world.snapshot()) == len(before)


def test_a_state_with_wrong_parts_is_refused_and_changes_nothing(bench: SimulatedBench) -> None:
    bench.run(5, False)
    world = bench.world
    state, before = world.save(), world.snapshot()
    arm = state["drivers"]["panda"]
    for wrong in ({}, {**arm, "q": [0.0]}, {**arm, "q": [math.nan] * 7}, None):
        drivers = {**state["drivers"], "panda": wrong} if wrong is not None else None
        with raises_code(CommandError, "wrong_state"):
            world.restore({**state, "drivers": drivers})
    for bodies in (None, {}, state["bodies"][:-1], [["lid", 0, False], *state["bodies"][1:]]):
        with raises_code(CommandError, "wrong_state"):
            world.restore({**state, "bodies": bodies})
    assert world.snapshot() == before


def test_a_state_does_not_loosen_the_limits_of_an_arm() -> None:
    world = need_engine("mujoco").world(panda())
    arm = world.motors.arms["panda"]
    efforts, speeds = world.motors.efforts[arm].copy(), world.motors.speeds[arm].copy()
    state = world.save()
    rows, *limits = state["state"]["motors"]
    state["state"]["motors"] = [rows, *([1e6] * len(row) for row in limits)]
    world.restore(state)
    assert np.array_equal(world.motors.efforts[arm], efforts)
    assert np.array_equal(world.motors.speeds[arm], speeds)


def test_a_state_reaches_the_bodies_of_its_names_or_is_refused(engine: Engine) -> None:
    places = {"one": (0.5, 0.0, 0.5), "two": (0.5, 0.3, 0.5), "three": (0.5, -0.3, 0.5)}
    boxes = {name: box(name, place, (0.02, 0.02, 0.02), mass=0.1) for name, place in places.items()}
    first, second = engine.world(*boxes.values()), engine.world(boxes["two"], boxes["three"])
    first.remove("one")
    for world in (first, second):
        world.add(boxes["one"])
        world.step()
    before = second.snapshot()
    with suppress(CommandError):
        second.restore(first.save())
    assert second.snapshot() == pytest.approx(before, abs=1e-6)


def test_a_state_of_an_arm_that_stands_elsewhere_is_refused(engine: Engine) -> None:
    here, there = engine.world(panda()), engine.world(panda(base_position=(0.1, 0.0, 0.0)))
    with raises_code(CommandError, "wrong_state"):
        there.restore(here.save())


@pytest.mark.parametrize(
    "wrong",
    [{"half_extents": (0.0, 1.0, 1.0)}, {"mass": -1.0}, {"mass": math.nan}, {"position": (math.inf, 0.0, 0.0)},
     {"orientation": (0.0, 0.0, 0.0, 0.0)}, {"name": "a/b"}, {"shape": "sphere", "radius": 0.0}],
)  # fmt: skip
def test_an_impossible_object_is_refused_and_changes_nothing(engine: Engine, wrong: dict[str, Any]) -> None:
    world = engine.world()
    with pytest.raises(CommandError):
        world.add(replace(box("box", (0.0, 0.0, 0.5), (0.1, 0.1, 0.1), mass=1.0), **wrong))
    assert world.names() == []


@pytest.mark.parametrize("speed", [1e200, 1e3])
def test_an_arm_whose_numbers_mean_nothing_reports_a_fault_until_the_world_is_reset(speed: float) -> None:
    bench = SimulatedBench(need_engine("pybullet"))
    sound = bench.run(1, False)[-1][1]
    state, before = bench.world.save(), bench.world.snapshot()
    body = bench.world.body("panda")
    bench.world.client.resetJointState(body.id, 3, 0.0, speed)
    bench.world.step()
    reading = bench.robot.read(7.0)
    assert reading.fault is not None
    assert (reading.fault.code, reading.t, reading.q, reading.dq) == ("simulation_unstable", 7.0, sound, [0.0] * 7)
    assert math.isfinite(bench.gripper.read(7.0).width)
    bench.world.set_dynamics("lid", mass=0.7)
    bench.world.reset()
    bench.run(60)
    reading = bench.robot.read(8.0)
    assert reading.fault is None
    assert reading.q == pytest.approx(PANDA_HOME, abs=1e-3), "its motors hold it"
    assert math.isfinite(bench.gripper.read(8.0).force)
    assert bench.world.dynamics("lid")["mass"] == pytest.approx(0.7)
    bench.world.restore(state)
    assert bench.world.snapshot() == pytest.approx(before, abs=1e-9)
    bench.world.close()


@pytest.mark.parametrize("how", ["reset", "restore"])
def test_torques_of_an_unstable_simulation_do_not_act_after_a_reset(how: str) -> None:
    """Its numbers are NaN: the damping of the iiwa's joints is computed from their speeds."""
    engine = need_engine("pybullet")
    world = engine.world(iiwa())
    robot = engine.robot(world)
    robot.open()
    still = [0.0] * 7
    q = robot.read(0.0).q
    robot.write(Setpoint(q, still, still, still))
    world.step()
    state = world.save()
    world.client.resetJointState(world.body("iiwa").id, 3, 0.0, 1e200)
    robot.write(Setpoint(q, still, still, still))
    world.step()
    assert robot.read(0.0).fault is not None
    world.reset() if how == "reset" else world.restore(state)
    for _ in range(5):
        world.step()
        reading = robot.read(0.0)
        assert reading.fault is None
        assert np.abs(reading.dq).max() < 0.01
    assert reading.q == pytest.approx(q, abs=1e-4)
    world.close()
