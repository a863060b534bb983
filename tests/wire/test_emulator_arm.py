"""The emulated arm's rules, without a network: how motions end, what is refused when, what the state shows."""

from __future__ import annotations

import struct
from math import inf, nan, sqrt

import numpy as np
import pytest

from hal.drivers.franka.flags import FLAGS, flag_index
from hal_emulators.franka.motion import at_rest
from hal_emulators.franka.plant import FLANGE_TO_HAND, IdealPlant, LaggingPlant, Plant, RigidBody, arm_only
from hal_emulators.franka.protocol import Generator

from .arm_kit import HOME, URDF, ZERO, Bench

IMPEDANCE = struct.pack("<7d", *[3000.0] * 7)


def test_a_motion_that_is_stopped_brakes_within_the_limits_and_the_next_waits_for_that() -> None:
    bench = Bench()
    assert bench.move(Generator.JOINT_VELOCITY) == 1
    bench.speed_up()
    speed = bench.arm.sample.dq[0]
    assert speed > 0.2
    assert bench.ask("StopMove") == 2  # the Move is answered first: preempted
    assert [(reply.name, reply.body[0]) for reply in bench.replies[-2:]] == [("Move", 2), ("StopMove", 0)]
    bench.requests.handle("Move", 8, struct.pack("<II6d", 0, 1, *[1.0] * 6) + bytes(57))
    cycles = 0
    while bench.arm.motion is None:
        before = bench.arm.sample.dq[0]
        bench.idle()
        assert abs(bench.arm.sample.dq[0] - before) <= 0.01 + 1e-12
        cycles += 1
        assert cycles < 100
    assert cycles == pytest.approx(speed / 0.01, abs=2)
    assert bench.replies[-1].body[0] == 1


def test_the_values_of_a_finished_command_do_not_count() -> None:
    bench = Bench()
    bench.move()
    bench.command()
    bench.command(finished=True)  # its positions are not even numbers
    assert (bench.replies[-1].name, bench.replies[-1].body[0]) == ("Move", 0)
    assert bench.arm.plant.q == HOME


@pytest.mark.parametrize("bad", [nan, inf])
def test_a_command_that_is_no_number_ends_the_motion_without_a_reflex(bad: float) -> None:
    bench = Bench()
    bench.move()
    bench.command()
    bench.command(q=(bad, *HOME[1:]))
    assert bench.replies[-1].body[0] == 10
    assert bench.arm.errors == frozenset()
    assert bench.arm.plant.q == HOME


def test_before_the_first_command_nothing_is_lost_and_after_it_everything() -> None:
    bench = Bench()
    bench.move()
    bench.idle(200)
    assert bench.state("control_command_success_rate") == (0.0,)
    bench.command()
    bench.idle(19)
    assert bench.arm.motion.success_rate == pytest.approx(0.81)
    bench.idle()
    assert [FLAGS[flag] for flag in bench.arm.errors] == ["communication_constraints_violation"]
    assert bench.replies[-1].body[0] == 8


def test_a_lost_torque_command_is_repeated() -> None:
    bench = Bench()
    bench.move(Generator.NONE, external=True)
    for k in range(5):
        bench.command(tau=(0.5 * k, *ZERO[1:]))
    bench.idle(3)
    assert bench.arm.motion.torques[0] == 2.0
    assert bench.state("tau_J_d")[0] == 2.0


def test_torques_that_jump_and_an_arm_that_is_driven_into_its_stop() -> None:
    bench = Bench()
    bench.move(Generator.NONE, external=True)
    bench.command(tau=(1.1, *ZERO[1:]))
    assert [FLAGS[flag] for flag in bench.arm.errors] == ["controller_torque_discontinuity"]
    bench = Bench()
    bench.arm.place((2.85, *HOME[1:]))
    bench.move(Generator.NONE, external=True)
    for k in range(1000):
        bench.command(tau=(min(20.0, 0.5 * k), *ZERO[1:]))
        if bench.arm.motion is None:
            break
    assert [FLAGS[flag] for flag in bench.arm.errors] == ["joint_position_limits_violation"]
    assert bench.ask("AutomaticErrorRecovery") == 3


def test_what_is_refused_while_a_motion_runs() -> None:
    bench = Bench()
    bench.move()
    assert bench.ask("SetJointImpedance", IMPEDANCE) == 1
    assert bench.ask("AutomaticErrorRecovery") == 1
    assert bench.move() == 5
    with pytest.raises(ValueError, match="motion"):
        bench.arm.guiding(True)
    with pytest.raises(ValueError, match="motion"):
        bench.arm.place(None)
    assert bench.arm.motion is not None


def test_what_is_refused_while_the_arm_is_led_by_hand_and_in_a_reflex() -> None:
    bench = Bench()
    bench.arm.guiding(True)
    assert bench.state("robot_mode") == (3,)
    assert (bench.move(), bench.ask("AutomaticErrorRecovery")) == (5, 1)
    bench.arm.guiding(False)
    bench.arm.reflex(flag_index("joint_reflex"))
    assert bench.state("robot_mode") == (4,)
    assert bench.state("errors")[6] == bench.state("reflex_reason")[6] == 1
    assert (bench.move(), bench.ask("StopMove")) == (5, 1)
    assert bench.ask("AutomaticErrorRecovery") == 0
    assert (bench.state("errors")[6], bench.state("reflex_reason")[6]) == (0, 1)  # the reason stays to be read
    assert bench.move() == 1
    assert bench.state("reflex_reason")[6] == 0


def test_an_impossible_move_is_an_invalid_argument() -> None:
    bench = Bench()
    rest = bytes(57)
    for modes in ((3, 0), (0, 5), (0, 4)):  # no such controller, no such generator, neither positions nor torques
        assert bench.ask("Move", struct.pack("<II6d", *modes, *[1.0] * 6) + rest) == 7
    assert bench.ask("Move", struct.pack("<II6d", 0, 0, nan, *[1.0] * 5) + rest) == 7
    slow = struct.pack("<B7d", 1, *ZERO)
    assert bench.ask("Move", struct.pack("<II6d", 0, 0, *[1.0] * 6) + slow) == 7
    assert bench.arm.motion is None


def test_modes_in_the_state() -> None:
    bench = Bench()
    assert (bench.state("motion_generator_mode"), bench.state("controller_mode"), bench.state("robot_mode")) == (
        (0,),
        (3,),
        (1,),
    )
    bench.move(Generator.JOINT_VELOCITY)
    assert (bench.state("motion_generator_mode"), bench.state("controller_mode"), bench.state("robot_mode")) == (
        (2,),
        (0,),
        (2,),
    )


def test_what_a_panda_has_besides() -> None:
    bench = Bench(version=5, library=b"\x7fELF")
    bench.requests.handle("GetCartesianLimit", 1, struct.pack("<I", 0))
    assert bench.replies[-1].body == bytes(154)
    bench.requests.handle("LoadModelLibrary", 2, bytes(2))
    assert bench.replies[-1].body == b"\0\x7fELF"
    assert bench.ask("LoadModelLibrary", b"\2\0") != 0, "the client runs on another processor"
    assert bench.ask("SetFilters", struct.pack("<5d", *[100.0] * 5)) == 0
    # Its torque control asks for velocities as well, which stay 0.
    assert bench.move(Generator.JOINT_VELOCITY, external=True) == 1
    for k in range(100):
        bench.command(tau=(min(5.0, 0.5 * k), *ZERO[1:]))
    assert bench.arm.plant.q[0] > 0.005
    bench.command(finished=True)
    assert bench.replies[-1].body[0] == 0


def test_poses_that_are_no_poses_are_refused() -> None:
    bench = Bench()
    good = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0.1, 1]
    assert bench.ask("SetNEToEE", struct.pack("<16d", *good)) == 0
    for k, value in ((0, 1.1), (0, -1.0), (3, 0.1), (15, 0.0), (12, nan)):
        bad = list(good)
        bad[k] = value
        assert bench.ask("SetNEToEE", struct.pack("<16d", *bad)) == 2
    flange_to_tip = bench.arm.settings.F_T_EE
    assert flange_to_tip == pytest.approx((*FLANGE_TO_HAND[:14], 0.2034, 1.0))


# What moves.


def by_denavit_and_hartenberg(q: tuple[float, ...]) -> np.ndarray:
    """The flange's pose by the table of Franka's documentation (Craig's convention)."""
    rows = [
        (0, 0.333, 0),
        (0, 0, -np.pi / 2),
        (0, 0.316, np.pi / 2),
        (0.0825, 0, np.pi / 2),
        (-0.0825, 0.384, -np.pi / 2),
        (0, 0, np.pi / 2),
        (0.088, 0, np.pi / 2),
        (0, 0.107, 0),
    ]
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(rows, (*q, 0.0), strict=True):
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array(
            [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    return pose


def test_the_flange_is_where_the_documents_table_puts_it() -> None:
    body = RigidBody(URDF)
    random = np.random.default_rng(1)
    for _ in range(20):
        q = tuple(random.uniform(-2.5, 2.5, 7).tolist())
        assert body.flange(q) == pytest.approx(by_denavit_and_hartenberg(q), abs=1e-9)


def test_the_urdf_that_goes_to_the_client_has_franka_s_names_and_no_hand() -> None:
    text = arm_only(URDF.read_text(encoding="utf-8"))
    for name in ("link0", "link8", "joint1", "joint7"):
        assert f'name="{name}"' in text
    assert text.count("position_based_velocity_limits") == 7
    for absent in ("hand", "finger", "mesh", "collision"):
        assert absent not in text


def settle(plant: Plant, goal: tuple[float, ...], cycles: int) -> None:
    for _ in range(cycles):
        plant.follow(at_rest(goal))


def test_a_lagging_plant_comes_after() -> None:
    plant = LaggingPlant(RigidBody(URDF), HOME)
    goal = (0.1, *HOME[1:])
    settle(plant, goal, 10)
    assert plant.q[0] == pytest.approx(0.1 * (1 - np.exp(-1.0)), rel=1e-6)
    assert plant.dq[0] > 1.0
    settle(plant, goal, 200)
    assert plant.q == pytest.approx(goal, abs=1e-8)


def test_energy_of_a_free_swing_is_not_made_of_nothing() -> None:
    """Without torques, friction brings a moving arm to rest."""
    plant = IdealPlant(RigidBody(URDF), HOME)
    for _ in range(100):
        plant.push((10.0, *ZERO[1:]))
    fastest = abs(plant.dq[0])
    assert fastest > 0.2
    for _ in range(6000):
        plant.push(ZERO)
    assert sqrt(sum(value * value for value in plant.dq)) < 0.01 * fastest
