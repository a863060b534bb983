"""A simulated parallel gripper, without its physics engine: two coupled fingers of limited speed and force."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

from hal.driver import GripperDriver, GripperReading
from hal.errors import CommandError, ConfigError, ConnectionLost, Problem
from hal.specs import GripperSpec, RobotSpec

from .disturbances import Disturbances
from .engine import SimulatedBody
from .world import SimulatedWorld

AT_TARGET = 0.001
"""Tolerance of the target width, m."""
SLOW = 0.002
"""Speed below which fingers at their target have arrived, m/s."""
STILL = 0.0005
"""A width that changes by less than this, m, counts as standing still. Pressed on a hard, uneven object, the joints of
the fingers oscillate fast while the width hardly moves, so their speed is no criterion."""
SETTLE = 0.1
"""Time of standing still after which a motion has ended at any width, s. Slow motions take longer."""
BLOCKED = 0.25
"""Share of the commanded speed below which fingers, long after the command, count as blocked."""
SMOOTH = 0.002
"""Share of the way of the fingers on each side over which the slope of a table of widths is averaged."""
PRESSING = 0.5
"""Share of the commanded force from which on the fingers count as pressing on something."""

_KEPT = ("target", "force", "stood", "settle", "resting", "speed", "driven", "engaged")
"""Attributes that a saved state has."""

W = TypeVar("W", bound=SimulatedWorld)  # type: ignore[type-arg]  # of any kind of body
B = TypeVar("B", bound=SimulatedBody)


class FingerTravel:
    """How the joints of a gripper's fingers make its width, and its force their torques.

    Each joint goes its way from closed to open in proportion to the others. Speeds and torques follow from those of the
    width by the slope of the table there: the force on what is held is the commanded one at every width.
    """

    def __init__(self, spec: GripperSpec) -> None:
        self._spec = spec
        if spec.opened:
            self._closed = list(spec.closed)
            self._ways = [far - shut for far, shut in zip(spec.opened, spec.closed, strict=True)]
        else:  # each slides by half the width
            self._closed, self._ways = [0.0] * len(spec.joints), [spec.width_max / 2.0] * len(spec.joints)
        self._slope = None if len(spec.travel) > 2 else spec.width_at(1.0) - spec.width_at(0.0)

    @property
    def varies(self) -> bool:
        """Whether the same speed and force of the width take others of the joints at other widths."""
        return self._slope is None

    def positions(self, width: float) -> list[float]:
        """Return the position of each joint at a width, rad or m."""
        share = self._spec.travel_at(width)
        return [shut + share * way for shut, way in zip(self._closed, self._ways, strict=True)]

    def speeds(self, speed: float, width: float) -> list[float]:
        """Return the greatest speed of each joint, rad/s or m/s, for one of the width, m/s, at a width, m."""
        share = speed / self._slope_at(self._spec.travel_at(width))
        return [share * abs(way) for way in self._ways]

    def efforts(self, force: float, width: float) -> list[float]:
        """Return the greatest torque or force of each joint, Nm or N, for a force of the fingers, N, at a width, m."""
        work = force * self._slope_at(self._spec.travel_at(width)) / len(self._ways)
        return [work / abs(way) for way in self._ways]

    def reading(
        self, positions: Sequence[float], speeds: Sequence[float], efforts: Sequence[float]
    ) -> tuple[float, float, float, float]:
        """Return what :meth:`SimulatedGripper.read_width` does, for what the joints have."""
        n, ways = len(positions), self._ways
        share = sum([(p - c) / way for p, c, way in zip(positions, self._closed, ways, strict=True)]) / n
        slope = self._slope_at(share)
        speed = slope * sum([v / way for v, way in zip(speeds, ways, strict=True)]) / n
        forces = [effort * way * n / slope for effort, way in zip(efforts, ways, strict=True)]
        return self._spec.width_at(share), speed, -max(forces), max(map(abs, forces))

    def _slope_at(self, share: float) -> float:
        """Return the change of the width per share of the way, m, around a share of it; the table is linear there."""
        if self._slope is not None:
            return self._slope
        low, high = max(share - SMOOTH, 0.0), min(share + SMOOTH, 1.0)
        if low >= high:  # fingers beyond their ends
            low, high = (0.0, SMOOTH) if share < 0.5 else (1.0 - SMOOTH, 1.0)
        return (self._spec.width_at(high) - self._spec.width_at(low)) / (high - low)


class SimulatedGripper(GripperDriver, Generic[W, B]):
    """Base class of the driver of the fingers of one robot in a simulated world.

    Each finger is driven by a position motor whose force is the grip force: on an object the motors press with that
    force, from both sides, until the next command. All fingers are one drive: none can be moved, or stopped, alone.

    With the latencies and the noise of ``rig.world.randomize`` the fingers begin a motion later, and what is reported
    was measured some time before, at its ``t_device``.
    """

    simulated: ClassVar[bool] = True
    WORLD: ClassVar[type[SimulatedWorld]]  # type: ignore[type-arg]
    """The class of world that the gripper must be in."""

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        if not isinstance(world, self.WORLD):
            text = f"{spec.name}: a simulated gripper needs its simulated world, not {world!r}"
            raise CommandError(text, code="world_missing")
        self.scene: W = world  # type: ignore[assignment]  # of that class
        self.travel = FingerTravel(spec)
        self._open = False
        self._target = spec.width_max
        self._force = spec.force
        self._stood = 0.0
        """Width near which the fingers have stayed, m."""
        self._stood_since = 0
        """The step since which they have stayed there."""
        self._settle = SETTLE
        self._resting = True
        self._seen = 0
        """The step after which the width was read last."""
        self._speed = spec.speed
        self._driven: tuple[float, float, float] | None = None
        """Width, m, force, N, and speed, m/s, of what the motors do; None while they hold since a reset."""
        self._engaged = True
        """Whether the fingers move or hold something."""
        self._placed = (0, 0.0, 0.0)
        """The step at which a reset or a restored state placed the fingers, and the force and the load (N) that are
        measured until the next one: the engine may still have those of before."""
        section = f"robots.{spec.arm}.gripper"
        self._disturbances = Disturbances(world, section, ("width_noise",))

    # --- what an engine implements -----------------------------------------------------------------------------------

    @abstractmethod
    def find_device(self) -> None:
        """Find the fingers of :attr:`body`."""

    @abstractmethod
    def read_width(self) -> tuple[float, float, float, float]:
        """Return the width, m, its speed, m/s (positive opens), the force of the weaker motor, N (positive closes), and
        the greatest force of a motor in either direction, N.
        """

    @abstractmethod
    def drive_fingers(self, width: float, force: float, speed: float) -> None:
        """Drive the fingers to a width, m, with a force, N; ``speed`` is that of the width, m/s.

        Where the travel :attr:`~FingerTravel.varies`, it is called before every step while the fingers move or hold
        something: what the joints need follows from the present width.
        """

    @abstractmethod
    def handle_fingers(self, active: bool) -> None:
        """Take notice whether the fingers move or hold something; else they need no coupling."""

    def resume_motors(self) -> None:  # optional
        """Let the motors do what they did when a state was saved, if the engine's states are without those of motors.

        They did :attr:`_driven`, or held at :attr:`_target` since a reset.
        """

    # --- the driver --------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Find the fingers in the world; raises ConfigError when they belong to no robot."""
        self.body: B = self._owner()
        self.find_device()
        self._was_reset()
        if not self._open:
            self.scene.on_reset(self.body.name, self._was_reset)
            self.scene.keep(f"{self.body.name}.gripper", self._save, self._restore)
            self.scene.before_steps(f"{self.body.name}.gripper", self._before_step)
        self._open = True

    def read(self, now: float) -> GripperReading:
        """Return the fingers after the last physics step; ``force`` is that of the weaker motor, N."""
        self._expect_open()
        self._disturbances.update()
        sensed = self._sense()
        t, (width, force, moving, grasped) = self._disturbances.measure(*sensed)
        moving = moving or sensed[2]  # what a command has begun is known at once
        return GripperReading(
            t=now,
            t_device=t,
            seq=self.scene.steps,
            width=width,
            width_target=self._target,
            moving=moving,
            grasped=grasped and not moving,
            force=force,
        )

    def _sense(self) -> tuple[float, float, bool, bool]:
        """Return the present width, m, the force, N, whether the fingers move, and whether they hold something."""
        width, speed, force, load = self._measure()
        if not math.isfinite(width + speed + force + load):  # the simulation is unstable, which its arms report
            width, speed, force, load = self._stood, 0.0, 0.0, 0.0
        moving = not self._is_at_rest(width, speed)
        pressing = force >= PRESSING * self._force
        idle = not moving and abs(width - self._target) <= AT_TARGET and load < PRESSING * self._force
        self._engage(not idle)
        return width, force, moving, not moving and pressing and width > self._target + AT_TARGET

    def _measure(self) -> tuple[float, float, float, float]:
        """Return what :meth:`read_width` returns, with the forces of the present state."""
        width, speed, force, load = self.read_width()
        step, *forces = self._placed
        if step == self.scene.steps:
            force, load = forces
        return width, speed, force, load

    def move(self, width: float, speed: float, force: float) -> None:
        """Start a motion to ``width``, clipped to the gripper's range; the newest command wins."""
        self._target = min(max(width, self.spec.width_min), self.spec.width_max)
        self._start(speed, force)

    def _engage(self, active: bool) -> None:
        """Take notice whether the fingers move or hold something."""
        self._engaged = active
        self.handle_fingers(active)

    def _before_step(self) -> None:
        self._disturbances.update()
        if self._disturbances.active:
            self._disturbances.measure(*self._sense())
        if self._engaged and self._driven is not None and self.travel.varies:
            self.drive_fingers(*self._driven)

    def _expect_open(self) -> None:
        if not self._open:
            raise ConnectionLost(f"{self.spec.name} is not open")

    def _start(self, speed: float, force: float) -> None:
        self._expect_open()
        width, _, pressed, _ = self._measure()
        blocked = abs(width - self._stood) <= STILL and pressed >= PRESSING * self._force
        blocked = blocked and bool(self.scene.contacts(self.body.name))  # the force is that of the last step
        if not blocked or force != self._force or self._target > width - AT_TARGET:  # else nothing moves
            self._resting, self._stood_since = False, self.scene.steps
        self._force = force
        self._speed = min(speed, self.spec.speed)
        self._settle = max(SETTLE, 2.0 * STILL / self._speed) + self._disturbances.commands.steps * self.scene.dt
        self._engage(True)
        self._send(self._speed)

    def _send(self, speed: float) -> None:
        """Let the fingers go to the target, with a speed of the width, m/s, when the command arrives."""
        self._disturbances.send(partial(self._carry_out, self._target, self._force, speed))

    def _carry_out(self, width: float, force: float, speed: float) -> None:
        self._driven = width, force, speed
        self.drive_fingers(width, force, speed)

    def _is_at_rest(self, width: float, speed: float) -> bool:
        """Return whether the fingers have arrived, or stand still elsewhere. To be called for every new width."""
        step, dt = self.scene.steps, self.scene.dt
        unseen, self._seen = (step - self._seen) * dt, step
        stood_long = (step - self._stood_since) * dt >= self._settle
        if abs(width - self._stood) > STILL:
            if unseen < self._settle:
                self._resting = self._resting and stood_long  # a creeping finger has stood long at every place
            else:  # in lock-step nothing is read while a program sleeps
                self._resting = abs(speed) <= BLOCKED * self._speed
            self._stood, self._stood_since = width, step
        elif stood_long:
            self._resting = True
        return self._resting or (abs(width - self._target) <= AT_TARGET and abs(speed) <= SLOW)

    def stop(self) -> None:
        """Stop the fingers where they are; on an object, they continue to press."""
        self._expect_open()
        width, speed, force, _ = self._measure()
        if force >= PRESSING * self._force and (abs(speed) <= SLOW or self._is_at_rest(width, speed)):
            return
        self._target = width
        self._engage(True)
        self._send(self.spec.speed)

    def close(self) -> None:
        if self._open:
            self.scene.off_reset(self.body.name, self._was_reset)
            self.scene.before_steps(f"{self.body.name}.gripper", None)
        self._open = False

    def _save(self) -> dict[str, Any]:
        now = self.scene.steps
        _, _, pressed, load = self._measure()
        more = {"stood_for": now - self._stood_since, "unseen_for": now - self._seen, "pressed": pressed, "load": load}
        return {name: getattr(self, f"_{name}") for name in _KEPT} | more

    def _restore(self, state: dict[str, Any]) -> None:
        for name in _KEPT:
            setattr(self, f"_{name}", state[name])
        now = self.scene.steps
        self._stood_since, self._seen = now - state["stood_for"], now - state["unseen_for"]
        self._placed = (now, state["pressed"] or 0.0, state["load"] or 0.0)
        self._disturbances.forget()
        self.resume_motors()

    def _was_reset(self) -> None:
        self._disturbances.forget()
        self._driven = None
        self._target = self._stood = self.read_width()[0]
        self._resting, self._stood_since = True, self.scene.steps
        self._force = self.spec.force
        self._placed = (self.scene.steps, 0.0, 0.0)

    def _owner(self) -> B:
        """Return the only robot in the world that has this gripper."""
        spec, bodies = self.spec, self.scene.bodies.values()
        owners: list[B] = [body for body in bodies if isinstance(body.spec, RobotSpec) and body.spec.gripper == spec]
        if len(owners) != 1 or not spec.joints:
            message = f"{len(owners)} robots have it" if spec.joints else "names no finger joints"
            message += "; it needs one robot and its finger joints"
            raise ConfigError(
                [Problem("grippers", spec.name, message, "wrong_count" if spec.joints else "missing_key")]
            )
        return owners[0]
