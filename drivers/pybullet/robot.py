"""A simulated arm."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf, isfinite
from typing import Any

from hal.drivers.scene.robot import SimulatedRobot

from .motors import JointTorques, hold, position_gain
from .world import PyBulletWorld

Floats = Sequence[float]

FASTEST = 99.0
"""Speed of an arm's joints together, rad/s, from which on a simulation counts as unstable: PyBullet cuts each speed to
100, so nothing becomes faster, and no arm is nearly as fast."""


class PyBulletRobot(SimulatedRobot[PyBulletWorld]):
    """The driver of one robot in a :class:`~hal.drivers.pybullet.world.PyBulletWorld`.

    Each motor is a velocity constraint with a torque limit: in a physics step it brings its joint to the speed
    ``dq + gain (p - q) / dt``, as far as its torque allows. With ``p = q_set - dq_set dt`` the joint is at the
    set-point at the end of the step in which it was written, so the next reading has no lag. The constraint carries
    gravity too, so the arm does not sag.
    """

    WORLD = PyBulletWorld

    def find_device(self) -> None:
        world = self.scene
        self.body = world.body(self.spec.name)
        self._joints = [self.body.joints[name] for name in self.spec.joints]
        self._efforts = [self.body.efforts[joint] for joint in self._joints]
        self._position_gains = [position_gain(world.dt)] * len(self._joints)
        self._velocity_gains = [1.0] * len(self._joints)
        self._read = world.client.getJointStates
        self._write = world.client.setJointMotorControlArray
        self._mode = world.client.POSITION_CONTROL
        self._torques = JointTorques(world.client, self.body, self._joints, world.dt)
        self._t_applied = 0.0
        """The step to which torques were applied last, in simulated s."""

    def read_state(self) -> tuple[Floats, Floats, Floats]:
        q, dq, _, tau = zip(*self._read(self.body.id, self._joints), strict=True)
        if not (hypot(*dq) < FASTEST and isfinite(sum(tau))):
            fast = FASTEST <= hypot(*dq) < inf
            return self._unstable(f"joints are faster than {FASTEST:g} rad/s" if fast else "a number is not finite")
        return q, dq, tau if self._tau is None else tuple(self._torques.last_applied)

    def _unstable(self, reason: str) -> tuple[Floats, Floats, Floats]:
        """Report that the simulation has become unstable; return the arm's last sound position, at rest."""
        self.scene.note_unstable(reason)
        home = [self.body.home[joint] for joint in self._joints]
        nothing = [0.0] * len(home)
        return home if self._frozen is None else self._frozen.q, nothing, nothing

    def follow_setpoint(self, q: Floats, dq: Floats) -> None:
        dt = self.scene.dt
        self._write(
            self.body.id,
            self._joints,
            self._mode,
            [a - b * dt for a, b in zip(q, dq, strict=True)],  # and their velocities, forces and gains, by position:
            dq,  # names would double the time of the call
            self._efforts,
            self._position_gains,
            self._velocity_gains,
        )

    def _end_torques(self) -> None:
        """Withdraw torques that the coming step would have; the joints are damped again."""
        if self._tau is not None and self._t_applied == self.scene.t:
            self._torques.withdraw()
        self._torques.end()

    def hold_at(self, q: Floats) -> None:
        self._end_torques()
        hold(self.scene.client, self.body, dict(zip(self._joints, q, strict=True)), self.scene.dt)

    def release_motors(self) -> None:
        self._torques.take_over([0.0] * len(self._joints) if self._dq is None else self._dq)
        self._t_applied = self.scene.t

    def apply_torques(self, tau: Floats) -> None:
        t = self.scene.t
        if t != self._t_applied:
            self._torques.next_step()
            self._t_applied = t
        self._torques.apply(tau)

    def _was_reset(self) -> None:
        self._end_torques()
        super()._was_reset()

    def _save(self) -> dict[str, Any]:
        return super()._save() | {"torques": self._torques.save()}

    def _restore(self, state: dict[str, Any]) -> None:
        if self._t_applied == self.scene.t:
            self._torques.withdraw()
        super()._restore(state)
        q, dq = self._q, self._dq
        self.hold_at(q if q is not None else [self.body.home[joint] for joint in self._joints])
        if self._tau is not None:
            self._torques.switch_off()
            self._torques.restore(state["torques"])
            self._t_applied = self.scene.t
        elif q is not None and dq is not None:
            self.follow_setpoint(q, dq)

    def mass_matrix(self, q: Sequence[float]) -> Any:
        return self._torques.mass_matrix(q)
