"""Controllers: rest errors, tracking, contact, and steps per second; also on emulated Frankas.

All but the steps per second run in lock-step and repeat exactly.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

import hal
from hal import JointImpedance, JointTarget, OperationalSpace

from .kit import ENGINES, Table, emulated_franka, median, per_second, run_in_turns

PATHS = ("hal/servo/controllers.py", "hal/servo/compliance.py", "hal/servo/torque.py", "drivers/franka")
SETTLE = 1.5
"""Time from the rest of the set-point to the measurement, s."""
LONGEST = 15.0
"""Longest time for a way; an arm that runs into itself or into the table takes longer, s."""
TASK = OperationalSpace(stiffness=1000.0, rotation_stiffness=50.0)
JOINTS = JointImpedance(stiffness=(200.0,) * 4 + (50.0,) * 3)
CONTROLLERS = {"OperationalSpace": TASK, "JointImpedance": JOINTS}
HOST = "127.0.8.3"


def open_rig(model: str, *more: str, engine: str | None = None, pad: str = "none", hz: float = 240.0) -> hal.Rig:
    """Open a simulated arm in lock-step, without cameras."""
    config = "iiwa_table" if model == "iiwa" else "panda_table"
    overrides = ["cameras={}", f"simulation.physics_hz={hz}", *more]
    overrides += ["robots.panda.model=fr3"] if model == "fr3" else []
    return hal.open(config, sim=True, engine=engine, clock="lock_step", pad=pad, overrides=overrides)


@contextlib.contextmanager
def open_emulated(robot: str, pad: str = "none") -> Iterator[hal.Rig]:
    """Open an emulated Franka in lock-step, which needs no pace."""
    overrides = [f"robots.arm.real.host={HOST}", f"robots.arm.model={robot}", "robots.arm.gripper.enabled=false"]
    overrides += ["robots.arm.workspace=null", "cameras={}"]
    with (
        emulated_franka(robot, HOST, "--no-hand", "--lockstep", "--unpaced"),
        hal.open("franka_emulator", clock="lock_step", pad=pad, overrides=overrides) as rig,
    ):
        yield rig


def arm_of(rig: hal.Rig) -> hal.Robot:
    """Return the arm of a rig with one."""
    return next(iter(rig.robots.values()))


def follow(rig: hal.Rig, control: hal.Control, goal: Any, seconds: float) -> list[hal.RobotState]:
    """Stream joint targets towards ``goal`` (n,), rad; return the state after each."""
    arm, states, begun = control.robot, [], rig.clock.now()
    for tick in rig.clock.rate(50.0):
        if tick.t - begun >= seconds:
            break
        q_set = arm.state().q_set
        control.send(JointTarget(q_set + np.clip(goal - q_set, -0.09, 0.09)))
        states.append(arm.state())
    return states


def random_goals(arm: hal.Robot, count: int, seed: int) -> list[Any]:
    """Return joint positions (n,) of random poses of the tcp in front of the arm, above its base."""
    rng = np.random.default_rng(seed)
    goals: list[Any] = []
    while len(goals) < count:
        position = rng.uniform((0.3, -0.35, 0.2), (0.65, 0.35, 0.7))
        turn = rng.normal(size=4) * 0.25
        orientation = arm.fk(arm.home).orientation + turn
        with contextlib.suppress(hal.Unreachable):
            goals.append(arm.ik(hal.Pose(position, orientation / np.linalg.norm(orientation)), arm.home))
    return goals


REST = ("", "reached", "mm, median", "most", "rad, median", "most")


def rest(rig: hal.Rig, controller: Any, count: int, seed: int = 1) -> tuple[Any, ...]:
    """Return the cells of a row: how far from their set-points an arm rests at random poses."""
    arm, errors = arm_of(rig), []
    for goal in random_goals(arm, count, seed):
        with (
            contextlib.suppress(hal.MotionStopped),
            arm.control(controller=controller, unattended=arm.spec.attended) as control,
        ):
            begun = rig.clock.now()
            while np.abs(arm.state().q_set - goal).max() > 1e-4 and rig.clock.now() < begun + LONGEST:
                follow(rig, control, goal, 0.02)
            if rig.clock.now() < begun + LONGEST:
                follow(rig, control, goal, SETTLE)
                errors.append(arm.state().tcp.distance(arm.fk(goal)))
                continue
        if rig.world is not None:  # from where it was stopped, the way to the next one may be blocked as well
            rig.world.reset()
            rig.clock.sleep(0.2)
    (mm, rad), (most_mm, most_rad) = np.median(errors, axis=0), np.max(errors, axis=0)
    return len(errors), 1e3 * mm, 1e3 * most_mm, rad, most_rad


def tour(rig: hal.Rig, controller: Any, seconds: float) -> tuple[float, float]:
    """Return rms and greatest distance of the tcp from its set-point over the tour, mm."""
    arm, pad = arm_of(rig), next(iter(rig.gamepads.values()))
    teleop = hal.Teleop(arm)
    found: list[float] = []
    begun = last = rig.clock.now()
    with arm.control(deadman=pad.hold("l2"), controller=controller) as control:
        for tick in rig.clock.rate(50.0):
            command, _ = teleop.step(pad.state(), tick.dt)
            control.send(command)
            states = [state for state in arm.states(last) if state.tau_set is not None]
            found += [state.tcp.distance(state.tcp_set)[0] for state in states if np.abs(state.dq_set).max() > 1e-3]
            last = tick.t
            if tick.t - begun > seconds:
                break
    distances = 1e3 * np.array(found)
    return float(np.sqrt((distances**2).mean())), float(distances.max())


def table(rig: hal.Rig, stiffness: float = 500.0, depth: float = 0.02) -> tuple[float, float]:
    """Return the force after 1 s with the set-point inside the table, and how it changes from 0.5 s on, N."""
    arm = arm_of(rig)
    controller = OperationalSpace(stiffness=stiffness)
    box = rig.world.aabb("table")
    surface = box[1][2] - arm.base.position[2]
    start = arm.state().tcp_set
    above = hal.Pose([start.position[0] + 0.1, start.position[1] + 0.15, surface + 0.05], start.orientation)
    arm.move_to(above)
    begun, touch, forces = None, -np.inf, []
    with arm.control(controller=controller) as control:
        height = surface + 0.05
        for tick in rig.clock.rate(50.0):
            height = max(touch - depth, height - 0.05 * 0.02)
            control.send(hal.CartesianTarget(hal.Pose([*above.position[:2], height], above.orientation)))
            newtons = sum(each.force for each in rig.world.contacts(arm.name, "table"))
            forces.append((tick.t, newtons))
            if newtons > 0.2 and touch == -np.inf:
                touch = arm.state().tcp.position[2]  # the fingertips reach a little beyond the tcp
            if begun is None and height == touch - depth:
                begun = tick.t
            if begun is not None and tick.t - begun > 1.0:
                break
    after = [newtons for t, newtons in forces if begun is not None and t > begun + 0.5]
    return forces[-1][1], max(after) - min(after)


def steps(controller: Any, engine: str, seconds: float) -> float:
    """Return the steps per second of a 20 Hz policy that moves the tcp, at 500 Hz physics."""
    with open_rig("panda", engine=engine, hz=500.0) as rig:
        arm = arm_of(rig)
        with arm.control(controller=controller, rate_hz=20.0) as control:
            ticks = rig.clock.rate(20.0)

            def step() -> None:
                t = next(ticks).elapsed
                control.send(hal.Twist([0.05 * np.sin(t), 0.05 * np.cos(t), 0.0]))
                arm.state()

            step()
            return per_second(step, seconds)


def on_simulation(
    engines: Sequence[str], models: Sequence[str], rates: Sequence[float], count: int, seconds: float
) -> Iterator[Table]:
    """Yield the tables of simulated arms."""
    rests = Table(f"at rest, {count} random poses", REST)
    pressed = Table("set-point 2 cm inside the table at 500 N/m", ("", "N after 1 s", "change in the last 0.5 s, N"))
    tours = Table("distance from the set-point on the recorded tour, mm", ("", "rms", "most"))
    for engine, model in itertools.product(engines, models):
        for name, controller in CONTROLLERS.items():
            with open_rig(model, engine=engine) as rig:
                rig.clock.sleep(0.2)
                rests.add(f"{engine}, {model}, {name}", *rest(rig, controller, count))
        name = "iiwa" if model == "iiwa" else "panda"
        with open_rig(model, f"robots.{name}.workspace=null", "collisions.boxes=[]", engine=engine) as rig:
            rig.clock.sleep(0.2)
            pressed.add(f"{engine}, {model}", *table(rig))
    for engine, model in itertools.product(engines, models[:2]):
        for hz, (name, controller) in itertools.product(rates, CONTROLLERS.items()):
            with open_rig(model, engine=engine, pad="demo", hz=hz) as rig:
                tours.add(f"{engine}, {model}, {hz:g} Hz, {name}", *tour(rig, controller, seconds))
    yield from (rests, pressed, tours)


def on_emulator(robot: str, counts: tuple[int, int]) -> Iterator[Table]:
    """Yield the tables of an emulated Franka."""
    rests = Table(f"emulated {robot}, at rest", REST)
    tours = Table(f"emulated {robot}: distance from the set-point on the recorded tour, mm", ("", "rms", "most"))
    for (name, controller), count in zip(CONTROLLERS.items(), counts, strict=True):
        with open_emulated(robot) as rig:
            rests.add(name, *rest(rig, controller, count))
        with open_emulated(robot, "demo") as rig:
            tours.add(name, *tour(rig, controller, 27.0))
    yield from (rests, tours)


def speeds(engine: str, rounds: int, seconds: float) -> Table:
    """Return the steps per second of a 20 Hz policy over 500 Hz physics, in turns."""
    controllers = {"position control": None, **CONTROLLERS}
    measures = {name: partial(steps, each, engine, seconds) for name, each in controllers.items()}
    table = Table(f"{engine}: steps/s of a 20 Hz policy over 500 Hz physics", ("", "steps/s"))
    for name, rates in run_in_turns(measures, rounds).items():
        table.add(name, median(rates))
    return table


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    if quick:
        yield from on_simulation(ENGINES[:1], ("panda",), (240.0,), 1, 1.0)
    else:
        yield from on_simulation(ENGINES, ("panda", "fr3", "iiwa"), (240.0, 1000.0), 100, 27.0)
    for engine in ENGINES[: 1 if quick else None]:
        yield speeds(engine, *((1, 0.1) if quick else (3, 5.0)))
    if not quick:
        yield from on_emulator("fr3", (100, 20))
        yield from on_emulator("panda", (20, 20))
