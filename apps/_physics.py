"""Experiments in the simulated world whose results are known from theory: `hal check --physics`.

Each function is one experiment. It opens a rig with the objects, or the arm, that it needs, in lock-step, so that time
passes only in `rig.clock.sleep` and the like; it changes and measures the world through `rig.world`; and it yields rows
with what theory says beside what was measured. They use nothing but the public interface.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import hal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

ALLOWED = 0.03
"""Greatest difference from theory, as a share of it."""
G = 9.81
"""m/s2"""


class Row(NamedTuple):
    """One measured number beside what theory says."""

    name: str
    unit: str
    theory: float
    measured: float
    scale: float | None = None
    """What the difference is a share of; None for the theory."""

    @property
    def difference(self) -> float:
        """Difference from theory, as a share."""
        return (self.measured - self.theory) / (self.theory if self.scale is None else self.scale)


def run_experiments(engine: str, names: Sequence[str] = ()) -> Iterator[Row]:
    """Run the experiments of these names of :data:`EXPERIMENTS`, or all of them; yield their rows."""
    for name in names or EXPERIMENTS:
        yield from EXPERIMENTS[name](engine)


def open_world(engine: str, *objects: dict[str, Any]) -> hal.Rig:
    """Open a rig of objects only; they are written as in a rig's file."""
    return hal.open({"objects": objects}, sim=True, engine=engine, clock="lock_step")


def open_panda(engine: str, *objects: dict[str, Any]) -> hal.Rig:
    """Open a rig of a Panda and objects."""
    rig = {"robots": {"panda": {"model": "panda"}}, "objects": objects}
    return hal.open(rig, sim=True, engine=engine, clock="lock_step")


def box(name: str, size: Sequence[float], at: Sequence[float], mass: float, **more: Any) -> dict[str, Any]:
    """Return a box of these whole sides, m, with its middle there; one of mass 0 is fixed."""
    return {"name": name, "shape": "box", "half_extents": [s / 2 for s in size], "position": at, "mass": mass, **more}


def ball(name: str, radius: float, at: Sequence[float], mass: float) -> dict[str, Any]:
    """Return a ball."""
    return {"name": name, "shape": "sphere", "radius": radius, "position": at, "mass": mass}


FLOOR = {"name": "floor", "shape": "plane"}


# --- bodies alone ----------------------------------------------------------------------------------------------------


def free_fall(engine: str) -> Iterator[Row]:
    """Let a ball fall for a second: g t^2 / 2."""
    with open_world(engine, ball("ball", 0.05, (0, 0, 10), 0.3)) as rig:
        rig.clock.sleep(1.0)
        yield Row("free fall in 1 s", "m", 0.5 * G, 10.0 - rig.world.pose("ball").position[2])


def momentum(engine: str) -> Iterator[Row]:
    """Let a ball hit a heavier one, without gravity: no momentum is lost, and they part with e times their approach."""
    light, heavy, speed, e = 1.0, 3.0, 1.0, 0.5
    with open_world(engine, ball("light", 0.05, (-0.3, 0, 1), light), ball("heavy", 0.05, (0, 0, 1), heavy)) as rig:
        rig.world.set_gravity([0, 0, 0])
        rig.world.set_dynamics("light", restitution=e)  # that of a contact is the product of both
        rig.world.set_dynamics("heavy", restitution=1.0)
        rig.world.set_velocity("light", linear=[speed, 0, 0])
        rig.clock.sleep(0.6)
        a, b = (rig.world.velocity(name)[0][0] for name in ("light", "heavy"))
    yield Row("momentum of two balls after they hit", "kg m/s", light * speed, light * a + heavy * b)
    yield Row("speed of the struck ball", "m/s", light * speed * (1 + e) / (light + heavy), b)


def restitution(engine: str) -> Iterator[Row]:
    """Drop a ball: it comes back to e^2 of the height, and is there after (1 + e) times the time of the fall."""
    e, height, radius = 0.8, 1.0, 0.05
    with open_world(engine, FLOOR, ball("ball", radius, (0, 0, height + radius), 0.3)) as rig:
        rig.world.set_dynamics("floor", restitution=1.0)
        rig.world.set_dynamics("ball", restitution=e)
        rig.clock.sleep((1 + e) * math.sqrt(2 * height / G))
        yield Row(
            f"rebound from 1 m, restitution {e:g}", "m", e**2 * height, rig.world.pose("ball").position[2] - radius
        )


# --- friction --------------------------------------------------------------------------------------------------------


def tilted_plane(engine: str) -> Iterator[Row]:
    """Let a block slide down a ramp for a second: g (sin a - mu cos a), with the product of both frictions as mu."""
    tilt, size = math.radians(35.0), (0.2, 0.2, 0.05)
    turn = hal.Pose.from_rpy((0, 0, 0), (0, tilt, 0))
    for mu in (0.1, 0.3, 0.5):
        placed = {"orientation": turn.orientation.tolist()}
        start = turn @ hal.Pose((0, 0, size[2] / 2))
        ramp = box("ramp", (9, 1, 0.2), (turn @ hal.Pose((0, 0, -0.1))).position.tolist(), 0, **placed)
        with open_world(engine, ramp, box("block", size, start.position.tolist(), 1.0, **placed)) as rig:
            rig.world.set_dynamics("ramp", lateral_friction=1.0)
            rig.world.set_dynamics("block", lateral_friction=mu)
            rig.clock.sleep(1.0)
            way = (turn.inverse() @ rig.world.pose("block")).position[0]
        theory = G * (math.sin(tilt) - mu * math.cos(tilt))
        yield Row(f"acceleration on 35 degrees, friction {mu:g}", "m/s2", theory, 2 * way)


def friction_cone(engine: str) -> Iterator[Row]:
    """Push a block harder and harder, along a side and along a diagonal: it slides from mu m g on."""
    mu, mass = 0.4, 1.0
    for angle in (0.0, 45.0):
        way = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0.0])
        with open_world(engine, FLOOR, box("block", (0.2, 0.2, 0.05), (0, 0, 0.025), mass)) as rig:
            rig.world.set_dynamics("floor", lateral_friction=1.0)
            rig.world.set_dynamics("block", lateral_friction=mu)
            force, slid = 0.9 * mu * mass * G, 0.0
            while slid < 1e-3 and force < 10.0:
                force += 0.02
                before = rig.world.pose("block").position
                rig.world.apply_force("block", force * way, duration=0.3)
                rig.clock.sleep(0.3)
                slid = float((rig.world.pose("block").position - before) @ way)
        yield Row(f"force that moves a block, at {angle:g} degrees", "N", mu * mass * G, force)


def rolling(engine: str) -> Iterator[Row]:
    """Throw a ball that does not spin onto the floor: it ends with 5/7 of its speed, and keeps that."""
    speed, radius = 1.4, 0.05
    with open_world(engine, FLOOR, ball("ball", radius, (0, 0, radius), 0.3)) as rig:
        rig.world.set_velocity("ball", linear=[speed, 0, 0])
        rig.clock.sleep(1.0)
        first = rig.world.velocity("ball")[0][0]
        rig.clock.sleep(1.0)
        second = rig.world.velocity("ball")[0][0]
    yield Row("speed of a ball that slid, and rolls now", "m/s", 5 / 7 * speed, first)
    yield Row("the rolling ball 1 s later", "m/s", 5 / 7 * speed, second)


def stack(engine: str) -> Iterator[Row]:
    """Stack five boxes: each contact carries what is above it."""
    mass, side = 1.0, 0.1
    boxes = [box(f"box{k}", (side,) * 3, (0, 0, (k + 0.5) * side), mass) for k in range(5)]
    with open_world(engine, FLOOR, *boxes) as rig:
        rig.clock.sleep(2.0)
        for name, other, above in (("box0", "floor", 5), ("box4", "box3", 1)):
            force = sum(contact.force for contact in rig.world.contacts(name, other))
            yield Row(f"force under {above} box{'es' * (above > 1)} of a stack", "N", above * mass * G, force)
        top = rig.world.pose("box4").position
        yield Row("the upper box has moved aside in 2 s", "m", 0.0, float(np.hypot(*top[:2])), side)


def spring(engine: str) -> Iterator[Row]:
    """Let a ball swing on a soft contact: it sinks in by m g / k, with the period 2 pi sqrt(m / k)."""
    mass, stiffness, damping, radius = 2.0, 1000.0, 4.0, 0.05
    with open_world(engine, FLOOR, ball("ball", radius, (0, 0, radius), mass)) as rig:
        rig.world.set_dynamics("ball", contact_stiffness=stiffness, contact_damping=damping)
        times, heights = record(rig, 1.0, lambda: rig.world.pose("ball").position[2])
        rig.clock.sleep(6.0)
        rest = rig.world.pose("ball").position[2]
    omega = math.sqrt(stiffness / mass - (damping / mass / 2) ** 2)
    yield Row(f"a ball of 2 kg on {stiffness:g} N/m sinks in by", "m", mass * G / stiffness, radius - rest)
    yield Row("period of that ball", "s", 2 * math.pi / omega, period(times, heights - rest))


def record(rig: hal.Rig, seconds: float, read: Callable[[], float]) -> tuple[Array, Array]:
    """Return the times, s, and what ``read`` returned at them, after each step of the world."""
    rows = []
    while rig.clock.now() < seconds:
        rig.clock.sleep(1 / 240)
        rows.append((rig.clock.now(), read()))
    times, values = np.array(rows).T
    return times, values


def period(times: Array, values: Array) -> float:
    """Return the period of an oscillation about 0, s, from where it rises through 0."""
    at = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    risen = times[at] - values[at] * (times[at + 1] - times[at]) / (values[at + 1] - values[at])
    return float(np.diff(risen).mean())


# --- joints of objects -----------------------------------------------------------------------------------------------


def make_jointed(folder: str, joint: str, link: str) -> dict[str, Any]:
    """Write a URDF with one joint between its fixed base and a link; return the object, 1 m above the origin."""
    file = Path(folder) / "it.urdf"
    file.write_text(
        f'<robot name="it"><link name="base"/><link name="part">{link}</link><joint name="joint" {joint}<parent'
        ' link="base"/><child link="part"/><limit lower="-9" upper="9" velocity="99" effort="99"/></joint></robot>'
    )
    return {"name": "it", "urdf": str(file), "position": (0, 0, 1), "fixed": True}


def solid(mass: float, at: str, moments: tuple[float, float, float]) -> str:
    """Return the mass of a URDF's link, kg, its centre, and its moments of inertia about that, kg m2."""
    inertia = "".join(f' i{axis}{axis}="{value}"' for axis, value in zip("xyz", moments, strict=True))
    return f'<inertial><origin xyz="{at}"/><mass value="{mass}"/><inertia{inertia} ixy="0" ixz="0" iyz="0"/></inertial>'


def drawer(engine: str) -> Iterator[Row]:
    """Pull a drawer with friction and damping: it ends with the speed (F - friction) / damping."""
    pull, friction, damping = 5.0, 2.0, 10.0
    joint = f'type="prismatic"><axis xyz="1 0 0"/><dynamics friction="{friction}" damping="{damping}"/>'
    link = solid(1.0, "0 0 0", (0.01, 0.01, 0.01))
    with tempfile.TemporaryDirectory() as folder, open_world(engine, make_jointed(folder, joint, link)) as rig:
        rig.world.apply_force("it", [pull, 0, 0], link="part", duration=3.0)
        rig.clock.sleep(1.5)
        before = rig.world.joint_positions("it")["joint"]
        rig.clock.sleep(1.0)
        speed = rig.world.joint_positions("it")["joint"] - before
    yield Row("speed of a drawer that is pulled", "m/s", (pull - friction) / damping, speed)


def door(engine: str) -> Iterator[Row]:
    """Push a damped door at its handle for a moment: it turns by force, time and lever over the damping."""
    push, seconds, damping, width, mass = 10.0, 0.1, 2.0, 0.8, 10.0
    joint = f'type="revolute"><axis xyz="0 0 1"/><dynamics damping="{damping}"/>'
    link = solid(mass, f"{width / 2} 0 0", (mass / 12, mass * (1 + width**2) / 12, mass * width**2 / 12))
    with tempfile.TemporaryDirectory() as folder, open_world(engine, make_jointed(folder, joint, link)) as rig:
        rig.world.apply_force("it", [0, push, 0], [width, 0, 1], link="part", duration=seconds)
        rig.clock.sleep(12.0)
        angle = rig.world.joint_positions("it")["joint"]
    yield Row("angle by which a door turns after a push", "rad", push * seconds * width / damping, angle)


def pendulum(engine: str) -> Iterator[Row]:
    """Let a pendulum swing: 2 pi sqrt(I / (m g l)), longer by theta^2 / 16 for the amplitude theta."""
    length, mass, moment, angle = 0.5, 1.0, 0.001, 0.3
    joint = 'type="continuous"><axis xyz="0 1 0"/>'
    link = solid(mass, f"0 0 {-length}", (moment,) * 3)
    with tempfile.TemporaryDirectory() as folder, open_world(engine, make_jointed(folder, joint, link)) as rig:
        rig.world.set_joint_positions("it", {"joint": angle})
        times, angles = record(rig, 10.0, lambda: rig.world.joint_positions("it")["joint"])
    small = 2 * math.pi * math.sqrt((moment + mass * length**2) / (mass * G * length))
    yield Row("period of a pendulum", "s", small * (1 + angle**2 / 16), period(times, angles))
    yield Row("amplitude of the pendulum after 10 s", "rad", angle, float(np.abs(angles[times > 8.0]).max()))


# --- an arm ----------------------------------------------------------------------------------------------------------


def grip(engine: str) -> Iterator[Row]:
    """Hold a cube that nothing else carries: each finger presses with F, and it slips from a pull of 2 mu F on."""
    force, mu, side = 30.0, 0.5, 0.04
    with open_panda(engine, box("cube", (side,) * 3, (0.5, 0, 1.0), 0.1)) as rig:
        arm = rig.robots["panda"]
        rig.world.set_gravity([0, 0, 0])
        rig.world.set_dynamics("cube", lateral_friction=mu)
        for finger in ("panda_leftfinger", "panda_rightfinger"):
            rig.world.set_dynamics("panda", finger, lateral_friction=1.0)
        rig.world.set_pose("cube", arm.base @ arm.state().tcp)
        assert arm.gripper is not None
        arm.gripper.grasp(side, force=force)
        rig.clock.sleep(0.5)
        contacts = rig.world.contacts("panda", "cube")
        for finger in ("panda_leftfinger", "panda_rightfinger"):
            pressed = sum(contact.force for contact in contacts if finger in (contact.link_a, contact.link_b))
            yield Row(f"force of {finger}", "N", force, pressed)
        pull, slip = 0.8 * 2 * mu * force, 0.0
        while slip < 2e-4 and pull < 2 * force:
            pull += 0.1
            before = rig.world.pose("cube").position[2]
            rig.world.apply_force("cube", [0, 0, -pull], duration=0.1)
            rig.clock.sleep(0.1)
            slip = before - rig.world.pose("cube").position[2]
    yield Row("pull that moves a held cube, 2 mu F", "N", 2 * mu * force, pull)


def load_on_arm(engine: str) -> Iterator[Row]:
    """Hang a weight on a hand: the motors carry the arm's weight, and J^T F."""
    force = np.array([0.0, 0.0, -20.0])
    with open_panda(engine) as rig:
        arm = rig.robots["panda"]
        rig.clock.sleep(0.5)
        state = arm.state()
        assert state.tau is not None
        yield Row("torque of joint 2, arm alone", "Nm", arm.dynamics.gravity(state.q)[1], state.tau[1])
        rig.world.apply_force("panda", force, arm.state().tcp.position, link="panda_hand", duration=2.0)
        rig.clock.sleep(1.0)
        state = arm.state()
        assert state.tau is not None
        theory = arm.dynamics.gravity(state.q) - arm.kinematics.jacobian(state.q)[:3].T @ force
        yield Row("torque of joint 2, 20 N at the hand", "Nm", theory[1], state.tau[1])


def zero_torque(engine: str) -> Iterator[Row]:
    """Command no torque right after the start: the arm, whose weight is compensated, stays where it is."""
    with open_panda(engine) as rig:
        arm = rig.robots["panda"]
        start = arm.state().q
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.JointTorque([0.0] * arm.n))
                if tick.elapsed >= 10.0:
                    break
        drift = float(np.abs(arm.state().q - start).max())
    yield Row("drift of an arm in 10 s with no torque", "rad", 0.0, drift, 0.1)


def following(engine: str) -> Iterator[Row]:
    """Let an arm follow a sine: it is where its set-point is."""
    size, rate = 0.2, 0.5
    with open_panda(engine) as rig:
        arm = rig.robots["panda"]
        start, lag = arm.state().q, 0.0
        with arm.control(rate_hz=100) as control:
            for tick in rig.clock.rate(100):
                swing = size * (1 - math.cos(2 * math.pi * rate * tick.elapsed)) / 2
                control.send(hal.JointTarget(start + swing * np.array([1, 0, 0, 0, 0, 0, 0])))
                state = arm.state()
                lag = max(lag, float(np.abs(state.q - state.q_set).max()))
                if tick.elapsed >= 4.0:
                    break
        travel = size
    yield Row("error of an arm that follows a sine", "rad", 0.0, lag, travel)


EXPERIMENTS: dict[str, Callable[[str], Iterator[Row]]] = {
    experiment.__name__: experiment
    for experiment in (
        *(free_fall, momentum, restitution, tilted_plane, friction_cone, rolling, stack, spring),
        *(drawer, door, pendulum, grip, load_on_arm, zero_torque, following),
    )
}
