"""A simulated arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import CommandError, ConnectionLost, Fault
from hal.specs import RobotSpec

from .motors import JointTorques, hold, position_gain
from .world import PyBulletWorld

__all__ = ["PyBulletRobot"]

HOLD_TIME = 0.020
"""Time for which torques are held without new ones, s: the same as a Franka's."""


class PyBulletRobot(RobotDriver):
    """The driver of one robot in a :class:`~hal.drivers.pybullet.world.PyBulletWorld`.

    Each motor is a velocity constraint with a torque limit: in a physics step it brings its joint to the speed
    ``dq + gain (p - q) / dt``, as far as its torque allows. With ``p = q_set - dq_set dt`` the joint is at the
    set-point at the end of the step in which it was written, so the next reading has no lag. The constraint carries
    gravity too, so the arm does not sag. The torque limits are the rig's, or the URDF's where it has none; each motor
    has its speed limit, so that a set-point that jumps cannot move a joint faster.

    A set-point with torques switches these motors off, and adds its torques to the compensation of gravity; one without
    switches them on again. The last torques are held for 20 ms without new ones, then the motors hold the arm.
    """

    modes: ClassVar[frozenset[str]] = frozenset({"position", "velocity", "torque"})
    simulated: ClassVar[bool] = True

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self._world = _world_of(spec.name, world)
        self._open = False
        self._connected = True
        self._frozen: Reading | None = None
        self._freeze = False
        self._fault: Fault | None = None
        self._q: Sequence[float] | None = None
        self._dq: Sequence[float] | None = None
        self._tau: Sequence[float] | None = None
        """Torques that drive the arm, Nm; None while the motors follow positions."""
        self._t_received = self._t_applied = 0.0
        """When the last torques arrived, and the step to which torques were applied last, in simulated s."""

    def open(self) -> None:
        """Find the robot in the world; raises DeviceNotFound."""
        world = self._world
        self._body = world.body(self.spec.name)
        self._joints = [self._body.joints[name] for name in self.spec.joints]
        self._efforts = [self._body.efforts[joint] for joint in self._joints]
        self._position_gains = [position_gain(world.dt)] * len(self._joints)
        self._velocity_gains = [1.0] * len(self._joints)
        self._read = world.client.getJointStates
        self._write = world.client.setJointMotorControlArray
        self._mode = world.client.POSITION_CONTROL
        self._torques = JointTorques(world.client, self._body, self._joints)
        if not self._open:
            world.on_reset(self.spec.name, self._was_reset)
        self._open = True

    def read(self, now: float) -> Reading:
        """Return the joints after the last physics step; ``tau`` is what the motors applied in it, Nm."""
        if not self._open or not self._connected:
            raise self._lost()
        if self._tau is not None:
            self._apply_torques(self._tau)
        if self._freeze and self._frozen is not None:
            return self._frozen
        world = self._world
        q, dq, _, tau = zip(*self._read(self._body.id, self._joints), strict=True)
        if self._tau is not None:
            tau = tuple(self._torques.last_applied)
        reading = Reading(now, world.t, world.steps, q, dq, tau, self._q, self._dq, None, None, self._fault)
        self._frozen = reading
        return reading

    def write(self, setpoint: Setpoint) -> None:
        """Apply a set-point; a robot with a fault ignores it, which its ``q_commanded`` shows."""
        if not self._open or not self._connected:
            raise self._lost()
        if self._fault is not None:
            return
        if setpoint.tau is not None:
            self._drive(setpoint, setpoint.tau)
            return
        if self._tau is not None:
            self._hold(setpoint.q)  # puts the motors' speed limits back
        q, dq = setpoint.q, setpoint.dq
        dt = self._world.dt
        self._write(
            self._body.id,
            self._joints,
            self._mode,
            [a - b * dt for a, b in zip(q, dq, strict=True)],  # and their velocities, forces and gains, by position:
            dq,  # names would double the time of the call
            self._efforts,
            self._position_gains,
            self._velocity_gains,
        )
        self._q, self._dq = q, dq

    def _drive(self, setpoint: Setpoint, tau: Sequence[float]) -> None:
        """Apply torques to the next step, in place of the motors."""
        if self._tau is None:
            self._torques.take_over()
            self._t_applied = self._world.t
        self._tau, self._t_received = tau, self._world.t
        self._apply_torques(tau)
        self._q, self._dq = setpoint.q, setpoint.dq

    def _apply_torques(self, tau: Sequence[float]) -> None:
        """Apply torques to each step and compensate gravity, as an arm's own controller does between commands."""
        t = self._world.t
        if t - self._t_received > HOLD_TIME:
            self._hold(self._positions())
            return
        if t != self._t_applied:
            self._torques.next_step()
            self._t_applied = t
        self._torques.apply(tau)

    def mass_matrix(self, q: Sequence[float]) -> list[list[float]]:
        """Return the joint-space inertia of the simulated arm (n, n) at ``q``, kg m2."""
        return self._torques.mass_matrix(q)

    def halt(self) -> None:
        """Hold the last set-point; an arm that is driven by torques holds its present position."""
        if self._open and self._q is not None:
            self._hold(self._q if self._tau is None else self._positions())

    def recover(self) -> None:
        """Clear every injected fault."""
        self._connected, self._freeze, self._fault = True, False, None

    def inject(self, **faults: object) -> None:
        """Switch injected faults on or off.

        Args:
            **faults: ``freeze=True``: every reading repeats the last one, including its stamps. ``disconnect=True``:
                the robot does not answer. ``fault="text"``: the robot reports that fault, holds its position and
                ignores set-points; ``fault=None`` ends it.

        Raises:
            CommandError: No such fault.
        """
        known = {"freeze", "disconnect", "fault"}
        if not set(faults) <= known:
            raise CommandError(
                f"{', '.join(sorted(set(faults) - known))}: unknown fault; faults: freeze, disconnect, fault",
                code="unknown_fault",
            )
        self._freeze = bool(faults.get("freeze", self._freeze))
        self._connected = not faults.get("disconnect", not self._connected)
        if not self._connected and self._open and self._tau is not None:
            self._hold(self._positions())  # the arm's own controller notices, and it is not read any more
        if "fault" not in faults:
            return
        cause = faults["fault"]
        self._fault = Fault("injected", str(cause), "call recover() on the arm") if cause else None
        if self._fault is not None and self._open:
            self._hold(self._positions())

    def close(self) -> None:
        """Disconnect; the motors hold the last set-point for as long as the world exists."""
        self.halt()
        if self._open:
            self._world.off_reset(self.spec.name, self._was_reset)
        self._open = False

    def _lost(self) -> ConnectionLost:
        return ConnectionLost(f"{self.spec.name} {'does not answer (injected)' if self._open else 'is not open'}")

    def _hold(self, q: Sequence[float]) -> None:
        hold(self._world.client, self._body, dict(zip(self._joints, q, strict=True)), self._world.dt)
        self._q, self._dq = list(q), [0.0] * len(q)
        self._tau = None

    def _positions(self) -> list[float]:
        return [state[0] for state in self._read(self._body.id, self._joints)]

    def _was_reset(self) -> None:
        self._q, self._dq = self._positions(), [0.0] * len(self._joints)
        self._tau = None


def _world_of(name: str, world: Any) -> PyBulletWorld:
    if not isinstance(world, PyBulletWorld):
        raise CommandError(f"{name}: a simulated device needs its simulated world, not {world!r}", code="world_missing")
    return world
