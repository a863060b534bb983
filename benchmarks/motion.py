"""Straight lines of the Panda: in the simulated world, and possible ones among random ones.

Each table is a function that returns its numbers, so that the tests run the same with small counts.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hal
from hal.commands import NO_INBOX, PathSection, Session
from hal.config import load
from hal.driver import Reading
from hal.geometry import apply_rotation, difference
from hal.kinematics.arm import Kinematics
from hal.motion.lines import tcp_lines
from hal.motion.planning import STEP, PathPlanner
from hal.servo.audit import SetpointAudit
from hal.servo.path import JointPath
from hal.servo.servo import Servo
from hal.specs import LimitsSpec, RobotSpec

from .kit import ENGINES, Table, compare

PATHS = ("hal/motion", "hal/servo/planned.py", "hal/servo/path.py")

Array = NDArray[np.float64]
TCP_SPEED = 0.25
DENSER = 20
OVERRIDES = {"cameras": {}, "objects": ["objects/floor.yaml", "objects/table.yaml"], "collisions.boxes": ["table"]}


def panda() -> RobotSpec:
    """Return the record of a Panda at the origin."""
    return load({"robots": {"arm": {"model": "panda"}}}, sim=True, driver="mock").resolve().robots[0]


def random_goal(numbers: np.random.Generator, start: list[float], turn: float = 0.5) -> list[float]:
    """Return a pose (7,) 5 to 50 cm from ``start`` (7,), turned by up to ``turn`` rad."""
    way, axis = numbers.normal(size=3), numbers.normal(size=3)
    way *= numbers.uniform(0.05, 0.5) / np.linalg.norm(way)
    axis *= numbers.uniform(0.0, turn) / np.linalg.norm(axis)
    return [*(np.array(start[:3]) + way).tolist(), *apply_rotation(start[3:], axis.tolist())]


def off_line(start: list[float], goal: list[float], poses: list[list[float]]) -> tuple[float, float]:
    """Return the greatest distance of poses (7,) from a line, m, and from the orientation that belongs there, rad."""
    (line,) = tcp_lines([start, goal], 0.0)
    way = np.subtract(goal[:3], start[:3])
    away = turned = 0.0
    for pose in poses:
        share = float(np.clip(np.subtract(pose[:3], start[:3]) @ way / (way @ way), 0.0, 1.0))
        error = difference(pose, line.at(share * line.length))
        away, turned = max(away, np.linalg.norm(error[:3])), max(turned, np.linalg.norm(error[3:]))
    return float(away), float(turned)


def optimal_time(path: JointPath, arm: Kinematics, limits: LimitsSpec, tcp_speed: float, steps: int = 400) -> float:
    """Return the least time for a path within the limits of speed and acceleration; no limit of jerk, so a lower bound.

    Numerical integration in the phase plane (reachable sets, as in Pham and Pham, "A New Approach to Time-Optimal Path
    Parameterization Based on Reachability Analysis", IEEE T-RO 34(3), 2018), with x = v^2 and u = dv/dt.
    """
    s = np.linspace(0.0, path.length, steps + 1)
    at = [path.at(x) for x in s]
    first, second = np.array([row[1] for row in at]), np.array([row[2] for row in at])
    rates = np.array([np.linalg.norm(arm.jacobian(q)[:3] @ dq) for q, dq, _ in at])
    A, V = np.array(limits.acceleration), np.array(limits.velocity)
    most = np.minimum((V / np.maximum(np.abs(first), 1e-12)).min(axis=1), tcp_speed / np.maximum(rates, 1e-12)) ** 2
    step = s[1] - s[0]
    size = np.maximum(np.abs(first), 1e-12)

    def accelerations(k: int, x: float) -> tuple[float, float]:
        centre = -second[k] * x * np.sign(first[k]) / size[k]
        return float((centre - A / size[k]).max()), float((centre + A / size[k]).min())

    def allowed(k: int, x: float, target: float) -> bool:
        low, high = accelerations(k, x)
        return low <= high and x + 2.0 * step * low <= target and x + 2.0 * step * high >= 0.0

    reach = np.zeros(steps + 1)
    for k in range(steps - 1, -1, -1):
        low, high = 0.0, float(most[k])
        if allowed(k, high, reach[k + 1]):
            low = high
        for _ in range(30 if low < high else 0):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if allowed(k, middle, reach[k + 1]) else (low, middle)
        reach[k] = low
    x = np.zeros(steps + 1)
    for k in range(steps):
        x[k + 1] = min(reach[k + 1], x[k] + 2.0 * step * accelerations(k, x[k])[1])
    v = np.sqrt(x)
    return float((2.0 * step / np.maximum(v[1:] + v[:-1], 1e-9)).sum())


def lines(count: int = 200, engine: str = "pybullet", seed: int = 1, controller: Any = None) -> dict[str, Any]:
    """Follow random lines of 5 to 50 cm at 0.25 m/s in the simulated world, each from where the last one ended."""
    numbers = np.random.default_rng(seed)
    rows: dict[str, list[float]] = {"off_set": [], "off": [], "tilt": [], "ratio": [], "length": []}
    refused = 0
    with hal.open("panda_table", sim=True, clock="lock_step", engine=engine, overrides=OVERRIDES) as rig:
        arm = rig.robots["panda"]
        audit = SetpointAudit(arm.limits, 1.0 / rig._local.spec.rate_hz)
        dt = 1.0 / rig._local.spec.rate_hz
        tries = 0
        while len(rows["off"]) < count:
            tries += 1
            if tries > 30:  # the last line ended in a corner
                arm.move_to(arm.home, speed=0.5)
                tries = 0
            audit.reset()
            q = arm.state().q_set
            start = list(arm.kinematics.fk(q))
            goal = random_goal(numbers, start)
            planner = arm._planner()
            try:
                (section,) = planner.plan_poses(q, [goal]).sections
                pose, terms = hal.Pose(goal[:3], goal[3:]), {"speed": 1.0, "tcp_speed": TCP_SPEED}
                motion = arm.start_move_to(pose, straight=True, controller=controller, **terms)
            except (hal.Unreachable, hal.CollisionError):
                refused += 1
                continue
            tries = 0
            begun = rig.clock.now()
            sets, measured = [], []
            while not motion.done:
                rig.clock.sleep(dt)
                state = arm.state()
                audit.add(state.q_set)
                sets.append(list(arm.kinematics.fk(state.q_set)))
                measured.append(list(arm.kinematics.fk(state.q)))
            assert motion.wait(), motion.result
            took = rig.clock.now() - begun
            least = optimal_time(JointPath(section), arm.kinematics, arm.limits, TCP_SPEED)
            (away, turned), (real, tilt) = off_line(start, goal, sets), off_line(start, goal, measured)
            found = {"off_set": away, "off": real, "tilt": max(turned, tilt), "ratio": took / least}
            for name, value in (found | {"length": float(np.linalg.norm(np.subtract(goal[:3], start[:3])))}).items():
                rows[name].append(value)
            assert max(audit.peaks().values()) <= 1.0, audit.peaks()
    worst = {name: max(values) for name, values in rows.items()}
    slow = sum(ratio > 1.3 for ratio in rows["ratio"])
    return worst | {
        "ratio_median": float(np.median(rows["ratio"])), "ratio_over_1.3": slow, "refused": refused, "count": count,
    }  # fmt: skip


def follow(spec: RobotSpec, arm: Kinematics, sections: tuple[PathSection, ...], most: float = 300.0) -> dict[str, Any]:
    """Follow a path with a servo at 240 Hz whose device takes every set-point; returns whether it stopped underway."""
    dt = 1.0 / 240.0
    servo = Servo(spec, dt, arm)
    q = list(sections[0].q[0])
    servo.anchor(q)
    servo.open_session(Session(1, 1.0, TCP_SPEED, False, path=sections), NO_INBOX._replace(t_app=10.0))
    audit = SetpointAudit(spec.limits, dt)
    now, rests, history = 10.0, 0, []
    while not servo.report.arrived and now < 10.0 + most:
        now += dt
        setpoint = servo.tick(now, Reading(now, now, 0, q, [0.0] * len(q)), NO_INBOX._replace(t_app=now))
        assert setpoint is not None
        rests += not servo.report.arrived and not any(setpoint.dq)
        q = list(setpoint.q)
        audit.add(q)
        history.append(q)
    peaks = audit.peaks()
    held = bool(servo.report.held_back)
    return {"arrived": servo.report.arrived, "rests": rests, "peak": max(peaks.values()), "held": held, "q": history}


def checks(count: int = 1000, seed: int = 1) -> dict[str, Any]:
    """Plan random lines from anywhere; follow those that are possible, and check the others more densely."""
    spec, numbers = panda(), np.random.default_rng(seed)
    arm = Kinematics(spec.kinematics)
    limits = spec.limits
    planner = PathPlanner(arm, limits.lower, limits.upper)
    dense = PathPlanner(arm, limits.lower, limits.upper, step=STEP / DENSER)
    began = stopped = refused = confirmed = off = 0
    worst = peak = 0.0
    reasons: Counter[str] = Counter()
    times = []
    for _ in range(count):
        q = numbers.uniform(limits.lower, limits.upper)
        start = list(arm.fk(q))
        goal = random_goal(numbers, start)
        before = time.perf_counter()
        try:
            plan = planner.plan_poses(q, [goal])
        except hal.Unreachable as error:
            times.append(time.perf_counter() - before)
            refused += 1
            reasons[error.code] += 1
            confirmed += not possible(dense, q, goal)
            continue
        times.append(time.perf_counter() - before)
        began += 1
        found = follow(spec, arm, plan.sections)
        stopped += not found["arrived"] or found["rests"] > 0 or found["held"]
        away, turned = off_line(start, goal, [list(arm.fk(x)) for x in found["q"]])
        worst, peak = max(worst, away), max(peak, found["peak"])
        off += away > 5e-4 or turned > 5e-3
    return {
        "began": began, "stopped_underway": stopped, "refused": refused, "confirmed": confirmed / max(1, refused),
        "reasons": dict(reasons), "worst_off": worst, "off": off, "peak_of_limits": peak,
        "plan_median_s": float(np.median(times)), "plan_p99_s": float(np.percentile(times, 99)),
    }  # fmt: skip


def possible(planner: PathPlanner, q: Array, goal: list[float]) -> bool:
    """Return whether a line can be followed; one that needs too many knots to be sent can."""
    try:
        planner.plan_poses(q.tolist(), [goal])
    except hal.Unreachable:
        return False
    except hal.CommandError:
        pass
    return True


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    found = {engine: lines(1 if quick else 200, engine) for engine in ENGINES}
    yield compare("random lines of 5 to 50 cm at 0.25 m/s; m, rad, and shares of the optimal time", found)
    yield compare("random lines from anywhere", {"": checks(3 if quick else 1000)})
