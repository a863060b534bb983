"""Controllers, measured: rest errors, tracking, compliance, contact, let-go, and steps per second.

    python benchmarks/controllers.py [rest tour force table held steps] [--count 100] [--models panda fr3 iiwa]
                                     [--engine pybullet] [--emulator fr3 --host 127.0.8.3]

rest    the tcp's distance from its set-point 1.5 s after the set-point came to rest, for random reachable poses
tour    rms distance between tcp and set-point while the recorded tour is driven, at 240 Hz and at 1 kHz
force   displacement by 10 N at the tcp along each axis, as a share of force over stiffness
table   force on the table with the set-point 2 cm inside it at 500 N/m, and the last bounce
held    greatest speed of a tcp that was held back by 30 N for 5 s, and is let go
steps   steps per second of a 20 Hz policy with 500 Hz physics, in lock-step; with ``--robosuite``, the path of an
        interpreter in whose environment robosuite is installed, also those of its task Lift, in turns

All but the last run in lock-step and repeat exactly. ``--emulator`` measures ``rest`` and ``tour`` on an emulated
Franka, through the vendor's own library, and needs it.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np

import hal
from hal import JointImpedance, JointTarget, OperationalSpace

ROWS = ("rest", "tour", "force", "table", "held", "steps")
SETTLE = 1.5
"""Time from the rest of the set-point to the measurement, s."""
LONGEST = 15.0
"""Longest time for a way; an arm that runs into itself or into the table takes longer, s."""
TASK = OperationalSpace(stiffness=1000.0, rotation_stiffness=50.0)
JOINTS = JointImpedance(stiffness=(200.0,) * 4 + (50.0,) * 3)
CONTROLLERS = (("task", TASK), ("joints", JOINTS))


def open_rig(model: str, *more: str, engine: str | None = None, pad: str = "none", hz: float = 240.0) -> hal.Rig:
    """Open a simulated arm in lock-step, without cameras."""
    config = "iiwa_table" if model == "iiwa" else "panda_table"
    overrides = ["cameras={}", f"simulation.physics_hz={hz}", *more]
    overrides += ["robots.panda.model=fr3"] if model == "fr3" else []
    return hal.open(config, sim=True, engine=engine, clock="lock_step", pad=pad, overrides=overrides)


@contextlib.contextmanager
def emulated(robot: str, host: str, pad: str = "none") -> Iterator[hal.Rig]:
    """Open an emulated Franka in lock-step, which needs no pace."""
    command = [sys.executable, "-m", "hal.drivers.franka.emulator", "--robot", robot, "--host", host, "--no-hand"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.PIPE}
    with subprocess.Popen([*command, "--lockstep", "--unpaced", "--quiet"], **quiet) as process:  # type: ignore[call-overload]
        try:
            deadline = time.monotonic() + 20.0
            while not _listens(host) and time.monotonic() < deadline:
                time.sleep(0.05)
            overrides = [f"robots.arm.real.host={host}", "cameras={}", "robots.arm.gripper.enabled=false"]
            overrides += [f"robots.arm.model={'fr3' if robot == 'fr3' else 'panda'}", "robots.arm.workspace=null"]
            with hal.open("franka_emulator", clock="lock_step", pad=pad, overrides=overrides) as rig:
                yield rig
        finally:
            process.terminate()
            process.wait(10.0)


def _listens(host: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host, 1339)) == 0


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


@dataclass
class Rest:
    """How far from their set-points an arm rested."""

    goals: list[Any]
    """Joint positions (n,) of the goals that were reached, rad."""
    errors: Any
    """Distances (reached, 2) from the set-point there, m and rad."""
    missed: list[str]
    """Why each of the other goals was not reached."""


def rest(rig: hal.Rig, controller: Any, count: int, seed: int = 1) -> Rest:
    """Return the rest errors of random poses."""
    arm, errors, missed, reached = arm_of(rig), [], [], []
    unattended = arm.spec.attended
    for number, goal in enumerate(random_goals(arm, count, seed)):
        limited = hal.Limited.NONE
        try:
            with arm.control(controller=controller, unattended=unattended) as control:
                begun = rig.clock.now()
                while np.abs(arm.state().q_set - goal).max() > 1e-4 and rig.clock.now() < begun + LONGEST:
                    limited = follow(rig, control, goal, 0.02)[-1].limited
                if rig.clock.now() < begun + LONGEST:
                    follow(rig, control, goal, SETTLE)
                    errors.append(arm.state().tcp.distance(arm.fk(goal)))
                    reached.append(goal)
                    continue
                missed.append(f"goal {number}: {limited}, {np.abs(goal - arm.state().q_set).max():.2f} rad away")
        except hal.MotionStopped as stop:
            missed.append(f"goal {number}: {stop}")
        if rig.world is not None:  # from where it was stopped, the way to the next one may be blocked as well
            rig.world.reset()
            rig.clock.sleep(0.2)
    return Rest(reached, np.array(errors), missed)


def left_by_friction(arm: hal.Robot, controller: Any, q: Any, friction: Any) -> Any:
    """Return how far (2,) from its set-point the tcp may rest because its joints stick, m and rad.

    An arm sticks as soon as the torque on every joint is below its friction. The distances are those of springs that
    exert just these torques, in the worst of their directions.

    Args:
        arm: The arm.
        controller: The controller, with one stiffness for all directions, or one for each joint.
        q: Where the arm rests (n,), rad.
        friction: Coulomb friction of each joint (n,), Nm.
    """
    jacobian = arm.kinematics.jacobian(q)
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=len(q)))) * friction
    if isinstance(controller, JointImpedance):
        errors = corners / np.array(controller.stiffness) @ jacobian.T
    else:
        eased = np.linalg.solve(arm.dynamics.mass_matrix(q), jacobian.T)
        stiffness = np.repeat([controller.stiffness, controller.rotation_stiffness], 3)
        errors = corners @ eased @ np.linalg.inv(jacobian @ eased) / stiffness
    return np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)


def tour(rig: hal.Rig, controller: Any, seconds: float) -> tuple[float, float, int]:
    """Return rms and greatest distance of the tcp from its set-point, m, and the number of states, over the tour."""
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
    distances = np.array(found)
    return float(np.sqrt((distances**2).mean())), float(distances.max()), len(found)


def push(rig: hal.Rig, arm: hal.Robot, force: Any, seconds: float) -> None:
    """Push the hand at its tcp with a force (3,), N."""
    point = (arm.base @ arm.state().tcp).position
    rig.world.apply_force(arm.name, force, point, link=arm.spec.kinematics.tcp_link, duration=seconds)


def force(rig: hal.Rig, controller: Any, newtons: float = 10.0) -> list[float]:
    """Return the displacement (3,) by a force along each axis, as a share of force over stiffness."""
    arm, shares = arm_of(rig), []
    for axis in range(3):
        with arm.control(controller=controller) as control:
            follow(rig, control, arm.home, 0.2)
            begin = arm.state().tcp.position[axis]
            push(rig, arm, [newtons * (k == axis) for k in range(3)], 2.5)
            state = follow(rig, control, arm.home, 2.0)[-1]
            shares.append((state.tcp.position[axis] - begin) / (newtons / controller.stiffness))
    return shares


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


def held(rig: hal.Rig, controller: Any, seconds: float = 5.0) -> tuple[float, float, float]:
    """Return the tcp's greatest speed after it is let go, that of the session, m/s, and the greatest lead, m."""
    arm = arm_of(rig)
    goal = arm.home.copy()
    goal[0] += 0.6
    fastest = lead = 0.0
    with arm.control(controller=controller) as control:
        follow(rig, control, arm.home, 0.2)
        for k in range(3):  # an arm at rest that 30 N hit at once would be faster than a session allows
            push(rig, arm, [0.0, -10.0, 0.0], seconds - 0.1 * k)
            follow(rig, control, arm.home, 0.1)
        seconds -= 0.3
        for state in follow(rig, control, goal, seconds - 0.02):
            lead = max(lead, state.tcp.distance(state.tcp_set)[0])
        for _ in range(150):
            last = rig.clock.now()
            follow(rig, control, goal, 0.02)
            fastest = max([fastest, *(float(np.linalg.norm(each.tcp_twist[:3])) for each in arm.states(last))])
        return fastest, control.tcp_speed, lead


@contextlib.contextmanager
def engine_timed() -> Iterator[list[float]]:
    """Collect the time that each physics step takes in the engine itself, s."""
    from hal.drivers.scene.world import SimulatedWorld

    spent: list[float] = []

    def timed(step: Callable[[Any], None]) -> Callable[[Any], None]:
        def timed_step(world: Any) -> None:
            begun = time.perf_counter()
            step(world)
            spent.append(time.perf_counter() - begun)

        return timed_step

    with contextlib.ExitStack() as stack:
        for kind in SimulatedWorld.__subclasses__():
            stack.enter_context(mock.patch.object(kind, "step", timed(kind.step)))
        yield spent


def steps(controller: Any, engine: str | None, seconds: float) -> tuple[float, float]:
    """Return the steps per second of a 20 Hz policy that moves the tcp, at 500 Hz physics.

    Also the median time of a physics step in the engine, s: what no program that uses it can save.
    """
    with open_rig("panda", engine=engine, hz=500.0) as rig, engine_timed() as spent:
        arm = arm_of(rig)
        with arm.control(controller=controller, rate_hz=20.0) as control:
            begun, start = 0.0, rig.clock.now()
            for done, tick in enumerate(rig.clock.rate(20.0)):
                t = tick.t - start
                control.send(hal.Twist([0.05 * np.sin(t), 0.05 * np.cos(t), 0.0]))
                arm.state()
                begun = begun or time.perf_counter()
                if time.perf_counter() - begun > seconds:
                    return done / (time.perf_counter() - begun), float(np.median(spent))
    raise AssertionError


ROBOSUITE = """
import json, os, sys, time
os.environ.setdefault("MUJOCO_GL", "egl")
import numpy as np, robosuite
env = robosuite.make("Lift", robots="Panda", has_renderer=False, control_freq=20, **json.loads(sys.argv[2]))
env.reset()
still = np.zeros_like(env.action_spec[0])
env.step(still)
start, steps = time.perf_counter(), 0
while time.perf_counter() - start < float(sys.argv[1]):
    env.step(still)
    steps += 1
print(steps / (time.perf_counter() - start))
"""


def steps_of_robosuite(python: str, seconds: float, **options: Any) -> float:
    """Return the steps per second of robosuite's task Lift (500 Hz physics, 20 Hz policy, its default controller).

    Args:
        python: Interpreter in whose environment robosuite is installed.
        seconds: Time to step, s.
        **options: Arguments of ``robosuite.make``; without any, nothing is drawn.
    """
    drawn = {"has_offscreen_renderer": False, "use_camera_obs": False} | options
    command = [python, "-c", ROBOSUITE, str(seconds), json.dumps(drawn)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    return float(done.stdout.split()[-1])


def show_steps(args: argparse.Namespace) -> None:
    """Measure and print the steps per second, in turns, so that a busy computer slows all of them alike."""
    rates: dict[str, list[float]] = {}
    engine: list[float] = []
    for _ in range(args.rounds):
        for name, controller in (("position", None), ("task", TASK), ("joints", JOINTS)):
            rate, spent = steps(controller, args.engine, args.turn)
            rates.setdefault(name, []).append(rate)
            engine.append(spent)
        if args.robosuite:
            rates.setdefault("robosuite", []).append(steps_of_robosuite(args.robosuite, args.turn))
    for name, found in rates.items():
        print(
            f"steps   {name:9s} {np.median(found):8.0f} steps/s at the median of {len(found)}, {max(found):.0f} at most"
        )
    print(f"        each has 25 physics steps, which take {1e6 * np.median(engine):.0f} us each in the engine itself")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", help="some of: rest tour force table held steps")
    parser.add_argument("--count", type=int, default=100, help="poses for 'rest'")
    parser.add_argument("--seconds", type=float, default=27.0, help="length of the tour that is driven, s")
    parser.add_argument("--models", nargs="*", default=["panda", "fr3", "iiwa"])
    parser.add_argument("--engine", default=None)
    parser.add_argument("--rounds", type=int, default=3, help="rounds of 'steps'")
    parser.add_argument("--turn", type=float, default=5.0, help="length of each turn of 'steps', s")
    parser.add_argument("--robosuite", default="", metavar="PYTHON", help="interpreter in whose environment it is")
    parser.add_argument("--emulator", choices=["fr3", "panda"], default=None)
    parser.add_argument("--host", default="127.0.8.3")
    args = parser.parse_args()
    rows = args.rows or list(ROWS)
    if unknown := set(rows) - set(ROWS):
        raise SystemExit(f"no row {', '.join(sorted(unknown))}; rows: {', '.join(ROWS)}")
    if args.emulator:
        on_emulator(rows, args)
        return
    for row in rows:
        if row == "steps":
            show_steps(args)
        elif row == "tour":
            for model in args.models[:2]:
                for hz in (240.0, 1000.0):
                    for name, controller in CONTROLLERS:
                        with open_rig(model, engine=args.engine, pad="demo", hz=hz) as rig:
                            show_tour(f"{model} {hz:.0f} Hz {name}", tour(rig, controller, args.seconds))
        else:
            for model in args.models:
                name = "iiwa" if model == "iiwa" else "panda"
                free = (f"robots.{name}.workspace=null",) if row == "table" else ()
                with open_rig(model, *free, engine=args.engine) as rig:
                    rig.clock.sleep(0.2)
                    on_simulation(row, model, rig, args.count)


def on_simulation(row: str, model: str, rig: hal.Rig, count: int) -> None:
    """Measure and print one row for one simulated arm."""
    if row == "table":
        newtons, bounce = table(rig)
        print(f"table   {model:6s} {newtons:.2f} N after 1 s, changes by {bounce:.2f} N in the last 0.5 s")
        return
    for name, controller in CONTROLLERS:
        rig.world.reset()
        rig.clock.sleep(0.2)
        if row == "rest":
            show_rest(f"{model} {name}", rest(rig, controller, count))
        elif row == "held":
            fastest, most, lead = held(rig, controller)
            print(f"held    {model:6s} {name:7s} at most {fastest:.3f} of {most:.3f} m/s, led by {1e3 * lead:.1f} mm")
        elif controller is TASK:
            shares = force(rig, OperationalSpace(stiffness=1000.0))
            print(f"force   {model:6s} {name:7s} " + " ".join(f"{share:.3f}" for share in shares) + " of F / k")


def on_emulator(rows: list[str], args: argparse.Namespace) -> None:
    """Measure and print what can be measured on an emulated Franka."""
    for name, controller in CONTROLLERS:
        if "rest" in rows:
            with emulated(args.emulator, args.host) as rig:
                found = rest(rig, controller, args.count)
                show_rest(f"emulated {args.emulator} {name}", found)
                show_friction(arm_of(rig), controller, found)
        if "tour" in rows:
            with emulated(args.emulator, args.host, "demo") as rig:
                show_tour(f"emulated {args.emulator} {name}", tour(rig, controller, args.seconds))


def show_rest(name: str, found: Rest) -> None:
    worst, median = np.max(found.errors, axis=0), np.median(found.errors, axis=0)
    print(
        f"rest    {name:22s} {len(found.goals)} reached; at most {1e3 * worst[0]:.3f} mm and {worst[1]:.5f} rad, "
        f"median {1e3 * median[0]:.3f} mm and {median[1]:.5f} rad; {_over(found.errors)} beyond the goal"
    )
    for text in found.missed:
        print(f"        {text}")


def show_friction(arm: hal.Robot, controller: Any, found: Rest) -> None:
    """Print what the emulated joints' friction alone may leave at the goals, and the most of it that was there."""
    from hal.drivers.franka.emulator.plant import COULOMB

    left = np.array([left_by_friction(arm, controller, goal, COULOMB) for goal in found.goals])
    (most, turn), (median, turn_median) = left.max(axis=0), np.median(left, axis=0)
    print(
        f"        friction may leave at most {1e3 * most:.3f} mm and {turn:.5f} rad, median {1e3 * median:.3f} mm and "
        f"{turn_median:.5f} rad, {_over(left)} beyond the goal; {(found.errors / left).max():.2f} of it is left at most"
    )


def _over(distances: Any) -> int:
    """Return how many of some distances (n, 2), m and rad, are beyond 1 mm or 0.005 rad."""
    return int((distances > (1e-3, 5e-3)).any(axis=1).sum())


def show_tour(name: str, found: tuple[float, float, int]) -> None:
    rms, most, count = found
    print(f"tour    {name:22s} {1e3 * rms:.3f} mm rms, {1e3 * most:.3f} mm at most, {count} states")


if __name__ == "__main__":
    main()
