"""A simulated gripper on each engine: width, speed and force, both fingers together, and a grasp that holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine, joint_positions
from errors_kit import raises_code, raises_problems
from specs import PANDA_HOME, box, cube, data, floor, iiwa, panda

from hal import registry
from hal.driver import GripperReading, Setpoint
from hal.errors import CommandError
from hal.geometry import Pose
from hal.specs import GripperSpec

FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


class Bench:
    """A Panda over a floor, with its hand open."""

    def __init__(self, engine: Engine, hz: float = 240.0) -> None:
        self.world = engine.world(floor(), panda(), physics_hz=hz)
        self.arm, self.hand = engine.robot(self.world), engine.gripper(self.world)
        self.arm.open()
        self.hand.open()
        hand = self.world.pose("panda", "panda_hand")["position"]
        self.tcp = np.array(hand) - [0.0, 0.0, 0.1034]

    def run(self, seconds: float, each: Callable[[float], None] | None = None) -> list[GripperReading]:
        """Step; ``each`` is called before every step with the seconds since the start."""
        readings = []
        for tick in range(round(seconds / self.world.dt)):
            if each is not None:
                each(tick * self.world.dt)
            self.world.step()
            readings.append(self.hand.read(self.world.t))
        return readings

    def fingers(self) -> tuple[float, float]:
        """Return the positions of both fingers, m."""
        found = joint_positions(self.world, "panda")
        return found[FINGERS[0]], found[FINGERS[1]]

    def put_cube(self) -> None:
        """The 2 kg cube between the fingers, on a stand."""
        x, y, z = self.tcp
        half = (z - 0.03) / 2.0
        self.world.add(box("stand", (x, y, half), (0.1, 0.1, half)))
        self.world.add(cube((x, y, z)))

    def put_duck(self, yaw: float) -> None:
        """The duck of the built-in rigs between the fingers, on a stand, turned by ``yaw`` rad."""
        turned = Pose([0, 0, 0], [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]) @ Pose(
            [0, 0, 0], [0.7071068, 0, 0, 0.7071068]
        )
        duck = {"name": "duck", "shape": "urdf", "urdf": data("duck_vhacd.urdf"), "scale": 0.8}
        self.world.add({**duck, "position": [0, 0, 0], "orientation": turned.orientation.tolist()})
        lower, upper = (np.array(corner) for corner in self.world.aabb("duck").values())
        place = self.tcp - (lower + upper) / 2.0
        self.world.set_pose("duck", {"position": place.tolist(), "orientation": turned.orientation.tolist()})
        x, y, z = self.tcp
        half = (z - (upper - lower)[2] / 2.0) / 2.0
        self.world.add(box("stand", (x, y, half), (0.1, 0.1, half)))

    def lift(self, t: float) -> None:
        """Turn the shoulder back by 0.35 rad within a second, with no jerk at either end."""
        s = min(t, 1.0)
        share, rate = s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * s * s * (1.0 - s) ** 2
        q, dq = np.array(PANDA_HOME), np.zeros(7)
        q[1] -= 0.35 * share
        dq[1] -= 0.35 * rate
        self.arm.write(Setpoint(q.tolist(), dq.tolist(), [0.0] * 7))


@pytest.fixture
def bench(engine: Engine) -> Iterator[Bench]:
    made = Bench(engine)
    yield made
    made.world.close()


class TestMoving:
    def test_widths_and_speeds_are_clipped(self, bench: Bench) -> None:
        bench.hand.move(-1.0, 99.0, 20.0)
        readings = bench.run(1.5)
        widths = np.array([reading.width for reading in readings])
        assert (readings[-1].width_target, widths[-1]) == (0.0, pytest.approx(0.0, abs=1e-4))
        assert np.abs(np.diff(widths)).max() / bench.world.dt <= 0.1 * 1.02
        bench.hand.move(1.0, 0.1, 20.0)
        assert bench.run(1.5)[-1].width == pytest.approx(0.08, abs=1e-4)

    def test_reset_opens_it(self, bench: Bench) -> None:
        bench.hand.move(0.0, 0.1, 20.0)
        assert bench.run(1.0)[-1].width < 0.01
        bench.world.reset()
        reading = bench.run(0.5)[-1]
        assert reading.width == pytest.approx(0.08, abs=1e-4)
        assert reading.width_target == pytest.approx(0.08)
        assert not reading.moving


class TestCoupling:
    @pytest.mark.parametrize("speed", [0.02, 0.1])
    def test_a_finger_that_is_blocked_holds_back_the_other(self, bench: Bench, speed: float) -> None:
        hand = bench.world.pose("panda", "panda_hand")["position"]
        bench.world.add(box("block", (hand[0], hand[1] - 0.01, hand[2] - 0.1), (0.008, 0.008, 0.008)))
        bench.hand.move(0.0, speed, 20.0)
        apart: list[float] = []
        bench.run(0.06 / speed + 0.5, lambda t: apart.append(abs(np.subtract(*bench.fingers()))))
        touching = {
            link for contact in bench.world.contacts("panda", "block") if (link := contact["link_a"]) is not None
        }
        assert touching == {"panda_leftfinger"}  # the right one touches nothing
        assert 0.005 < min(bench.fingers()) < 0.03  # both moved, and neither closed
        assert max(apart) < 5e-4

    def test_a_push_against_one_of_two_idle_fingers_moves_both(self, bench: Bench) -> None:
        """A hand that idles is uncoupled, and coupled again before its motors give way, read 20 times a second."""
        bench.hand.move(0.04, 0.1, 20.0)
        bench.run(1.0)
        world = bench.world
        force, apart = 0.0, []
        for tick in range(240):
            force = 0.25 * tick  # N, up to 60
            world.apply_force("panda", (0.0, force, 0.0), link="panda_leftfinger")
            world.step()
            if tick % 12 == 0:
                bench.hand.read(world.t)
            apart.append(abs(np.subtract(*bench.fingers())))
        assert max(apart) < 5e-4
        assert max(bench.fingers()) < 0.01, "both gave way in the end"

    def test_fingers_move_together(self, bench: Bench) -> None:
        bench.hand.move(0.0, 0.1, 20.0)
        apart: list[float] = []
        readings = bench.run(1.5, lambda t: apart.append(abs(np.subtract(*bench.fingers()))))
        assert readings[-1].width < 1e-3
        assert max(apart) < 1e-5


class TestGrasping:
    @pytest.mark.parametrize(("force", "hz"), [(30.0, 240.0), (70.0, 240.0), (70.0, 1000.0)])
    def test_the_cube_is_lifted_and_held(self, engine: Engine, force: float, hz: float) -> None:
        bench = Bench(engine, hz)
        bench.put_cube()
        bench.hand.move(0.0, 0.1, force)
        gripped = bench.run(1.0)[-1]
        assert gripped.grasped
        assert gripped.width == pytest.approx(0.03, abs=0.003)
        assert gripped.force == pytest.approx(force, rel=0.2)
        before = np.array(bench.world.pose("cube")["position"])
        offset = distance(bench.world)
        assert bench.run(2.0, bench.lift)[-1].grasped
        after = np.array(bench.world.pose("cube")["position"])
        assert after[2] - before[2] > 0.08
        assert abs(distance(bench.world) - offset) < 1e-3
        bench.hand.stop()  # neither stop nor close lets go
        held = bench.run(0.5)[-1]
        assert held.grasped
        assert held.force == pytest.approx(force, rel=0.2)
        bench.hand.close()
        for _ in range(round(0.5 / bench.world.dt)):
            bench.world.step()
        assert abs(bench.world.pose("cube")["position"][2] - after[2]) < 1e-3

    def test_new_commands_to_close_leave_a_grasp_as_it_is(self, bench: Bench) -> None:
        """A policy and an analogue trigger send another width in every step."""
        bench.put_cube()
        readings = []
        for k in range(24):
            bench.hand.move(0.0 if k % 2 else 0.015, 0.1, 20.0)
            readings += bench.run(0.05)
        assert all(reading.grasped and not reading.moving for reading in readings[-120:])
        bench.hand.move(0.06, 0.1, 20.0)
        opened = bench.run(0.05)[-1]
        assert (opened.moving, opened.grasped) == (True, False)

    @pytest.mark.parametrize("yaw", [-2.9, 0.6, 2.0])
    def test_oscillating_fingers_count_as_at_rest(self, bench: Bench, yaw: float) -> None:
        bench.put_duck(yaw)
        bench.hand.grasp(0.03, 0.1, 70.0, 0.05, 0.05)
        readings = bench.run(2.0)[-120:]
        assert np.ptp([reading.width for reading in readings]) < 1e-3
        assert not any(reading.moving for reading in readings)
        assert all(reading.grasped for reading in readings)
        bench.hand.stop()
        assert all(reading.grasped for reading in bench.run(0.5)), "a stop keeps the force"
        bench.hand.move(0.08, 0.1, 70.0)
        assert bench.run(1.0)[-1].width > 0.07
        bench.hand.grasp(0.03, 0.1, 70.0, 0.05, 0.05)
        for _ in range(480):
            bench.world.step()
        assert bench.hand.read(0.0).grasped, "also where the fingers were not read on their way"

    def test_slow_motion_counts_as_moving(self, bench: Bench) -> None:
        bench.hand.move(0.075, 0.001, 20.0)
        readings = bench.run(3.0)
        assert all(reading.moving for reading in readings)
        assert readings[-1].width == pytest.approx(0.077, abs=5e-4)


def distance(world: Any) -> float:
    """From the hand to the cube, m."""
    hand, thing = world.pose("panda", "panda_hand")["position"], world.pose("cube")["position"]
    return float(np.linalg.norm(np.subtract(hand, thing)))


class TestBadInput:
    def test_a_world_is_needed(self, engine: Engine) -> None:
        with raises_code(CommandError, "world_missing"):
            registry.load(engine.name, "gripper")(GripperSpec("hand", engine.name, 0.08, 0.1, 20.0), None)

    def test_a_gripper_of_no_robot(self, engine: Engine) -> None:
        spec = GripperSpec("hand", engine.name, 0.08, 0.1, 20.0, FINGERS)
        gripper = registry.load(engine.name, "gripper")(spec, engine.world(iiwa()))
        with raises_problems("wrong_count"):
            gripper.open()

    def test_a_finger_that_the_urdf_lacks(self, engine: Engine) -> None:
        wrong = GripperSpec("hand", engine.name, 0.08, 0.1, 20.0, ("panda_finger_joint1", "panda_finger_joint9"))
        with raises_problems("unknown_joint"):
            engine.world(panda(gripper=wrong))
