"""The motors of all arms and fingers: torques that bring each joint to its set-point by the end of a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = Sequence[float]

STIFFNESS = 72.0
"""Rate at which a position error decays, 1/s: the same as with PyBullet."""
BOOST = 0.25
"""Share of the speed that a joint lacks after a step that is added to what is wanted from then on."""
_TARGET, _FEED, _Q, _DQ, _WANTED, _BOOST = range(6)


class Motors:
    """Computes the torques of all driven joints before each step.

    A motor wants its joint to have the speed ``feed + STIFFNESS (target - feed dt - q)`` in the step, within its speed
    limit, so that a joint which keeps up is at the target at the end. The torques that do it follow from the inertia of
    the arms and the forces that act on them: gravity, Coriolis and centrifugal forces. A load or a contact that is not
    in this model makes a joint lag. What it lacks is added up and compensated (:data:`BOOST`), so that an arm carries
    an object without sagging, and fingers press with their full force. Torques stay within the motors' limits.

    The driven joints are the first ``n`` degrees of freedom of the model, with one position each.

    Args:
        n: Number of driven joints.
        dt: Length of the world's step, s.
        h: Length of MuJoCo's step, s.
    """

    def __init__(self, n: int, dt: float, h: float) -> None:
        self.n = n
        self.h = h
        self.state = state = np.zeros((6, n))
        """Of each joint: target (rad or m), feed (per s), position, speed, wanted speed, and boost (per s)."""
        self.target, self.feed, self.wanted, self.boost = (state[k] for k in (_TARGET, _FEED, _WANTED, _BOOST))
        self._results, self._speeds = state[_WANTED:], state[_DQ:]
        self.efforts = np.zeros(n)
        """Greatest torque or force of each motor, Nm or N."""
        self.speeds = np.zeros(n)
        """Greatest speed of each joint, rad/s or m/s."""
        self.arms: dict[str, NDArray[np.intp]] = {}
        """Places of the joints of each arm, without its fingers."""
        self.torques: dict[str, tuple[Any, Array, Floats]] = {}
        """Arms that are driven by torques instead: places of their joints, torques on top of gravity, Nm, and these as
        they were given."""
        self.damping = np.zeros(n)
        """Damping of each joint in the URDF, Nm s/rad. It acts only on arms that are driven by torques."""
        gain = min(STIFFNESS, 1.0 / dt)
        self._law = np.array([[gain, 1.0 - gain * dt, -gain, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -BOOST, BOOST, 1.0]])
        self._next = np.zeros((2, n))
        self._most = np.zeros((2, n))
        self._least = np.zeros((2, n))
        self._shares = np.zeros(n)
        """Share of each motor's limit that is applied."""
        self._to_acceleration = np.array([-1.0, 1.0, 1.0]) / h

    def bind(self, mujoco: Any, model: Any, data: Any) -> None:
        n = self.n
        self._mujoco = mujoco
        self._at_rest: Any = None
        """Data of the same positions at rest, for gravity alone; made when torques drive an arm."""
        self._gravity = np.zeros(model.nv)
        self._mulm, self._model, self._data = mujoco.mj_mulM, model, data
        self._q, self._dq, self._bias = data.qpos[:n], data.qvel[:n], data.qfrc_bias[:n]
        self.applied = data.qfrc_applied[:n]
        """What acts in the step, Nm or N."""
        self._acceleration, self._force = np.zeros(model.nv), np.zeros(model.nv)
        self._driven_acceleration, self._driven_force = self._acceleration[:n], self._force[:n]
        self._ease = self.h * model.dof_invweight0[:n]
        self._alone = self._ease.copy()
        """Change of a finger's speed in a step by each N; 0 for the joints of arms."""
        for arm in self.arms.values():
            self._alone[arm] = 0.0
        self.limit()
        for at, *_ in self.torques.values():
            model.dof_damping[at] = self.damping[at]
        # The inertia of the driven joints: where each entry of MuJoCo's sparse lower triangle is in the full matrix.
        rows = np.repeat(np.arange(n), model.M_rownnz[:n])
        columns = model.M_colind[: len(rows)]
        self._dense = np.zeros((n, n))
        self._dense_entries = self._dense.reshape(-1)
        self._where = np.append(rows * n + columns, columns * n + rows)
        self._entries = np.append(np.arange(len(rows)), np.arange(len(rows)))

    def limit(self) -> None:
        self._most[0], self._most[1] = self.speeds, self.efforts * self._ease
        np.negative(self._most, out=self._least)
        with np.errstate(divide="ignore"):
            self._effort_shares = 1.0 / self.efforts

    def rest(self, at: Any, q: Floats | float) -> None:
        """Hold some joints at positions, and forget what their motors compensated."""
        self.target[at] = q
        self.feed[at] = self.wanted[at] = self.boost[at] = 0.0

    def drive_by_torques(self, name: str, at: Any, tau: Floats) -> None:
        """Drive an arm by torques (n,), Nm, on top of gravity; its joints are at the places ``at``.

        Its joints then have the damping of the URDF, which MuJoCo integrates implicitly.
        """
        known = self.torques.get(name)
        if known is None:
            self._model.dof_damping[at] = self.damping[at]
        elif known[2] is tau:
            return
        self.torques[name] = (at, np.array(tau, float), tau)

    def drive_by_motors(self, name: str) -> bool:
        """Let the motors of an arm follow positions again; return whether torques drove it."""
        found = self.torques.pop(name, None)
        if found is not None:
            self._model.dof_damping[found[0]] = 0.0
        return found is not None

    def drive(self) -> None:
        """Set the torques of the next step; to be called when inertia and forces are those of the present state."""
        state, new = self.state, self._next
        state[_Q] = self._q
        state[_DQ] = self._dq
        self._law.dot(state, new)
        np.maximum(new, self._least, out=new)
        np.minimum(new, self._most, out=self._results)
        self._to_acceleration.dot(self._speeds, self._driven_acceleration)
        for at, *_ in self.torques.values():
            self._driven_acceleration[at] = 0.0
        self._mulm(self._model, self._data, self._force, self._acceleration)
        applied = self.applied
        np.add(self._driven_force, self._bias, out=applied)
        if self.torques:
            self._drive_by_torques()
        np.multiply(applied, self._effort_shares, out=self._shares)
        if not self._shares.dot(self._shares) <= 1.0:  # else all of them are within their limits
            self._cut()

    def _cut(self) -> None:
        applied, force = self.applied, self._driven_force
        np.copyto(force, applied)
        np.maximum(force, -self.efforts, out=applied)
        np.minimum(applied, self.efforts, out=applied)
        np.subtract(applied, force, out=force)
        if force.dot(force) > 0.0:
            self._share(force)

    def _drive_by_torques(self) -> None:
        """Put the torques of :attr:`torques`, and those that carry their arms, in place of those of the motors."""
        mujoco, model = self._mujoco, self._model
        if self._at_rest is None:
            self._at_rest = mujoco.MjData(model)
            self._places = [(getattr(self._at_rest, name), getattr(self._data, name)) for name in ("cdof", "cinert")]
        for at_rest, now in self._places:
            np.copyto(at_rest, now)
        mujoco.mj_rne(model, self._at_rest, 0, self._gravity)
        for at, torques, _ in self.torques.values():
            self.applied[at] = torques + self._gravity[: self.n][at]

    def _share(self, excess: Array) -> None:
        """Expect less of motors whose torques lack ``excess``, Nm or N, and choose those of their arms' other joints.

        A joint at its limit moves less than wanted, which changes what the others need to move as wanted.
        """
        self.wanted += excess * self._alone
        for name, arm in self.arms.items():
            if name in self.torques or not excess[arm].any():
                continue
            inertia, most = self.inertia(self._data, arm), self.efforts[arm]
            wanted = self._acceleration[arm]
            rest = self.applied[arm] - excess[arm] - inertia @ wanted
            acceleration, limited, signs = wanted.copy(), np.zeros(len(arm), bool), np.zeros(len(arm))
            for _ in range(4 * len(arm)):  # it ends after as many turns as joints are at their limit, mostly
                acceleration[~limited] = wanted[~limited]
                if limited.any():
                    own = inertia[np.ix_(limited, limited)]
                    given = signs[limited] * most[limited] - rest[limited]
                    given -= inertia[np.ix_(limited, ~limited)] @ wanted[~limited]
                    acceleration[limited] = np.linalg.solve(own, given)
                torques = rest + inertia @ acceleration
                too_much = signs * (acceleration - wanted)  # it needs less than its limit
                if too_much.max() > 1e-9:
                    joint = int(too_much.argmax())
                    limited[joint], signs[joint] = False, 0.0
                    continue
                over = np.where(limited, 0.0, np.abs(torques) - most)
                joint = int(over.argmax())
                if over[joint] <= 1e-9:
                    break
                limited[joint], signs[joint] = True, np.sign(torques[joint])
            self.applied[arm] = np.clip(torques, -most, most)
            self.wanted[arm[limited]] = self._dq[arm[limited]] + self.h * acceleration[limited]
            self.boost[arm[limited]] = 0.0  # a contact would wind it up, also away from the target

    def inertia(self, data: Any, at: slice | NDArray[np.intp]) -> Array:
        """Return the joint-space inertia (k, k), kg m2, of the joints at these places, of the state in ``data``."""
        self._dense_entries[self._where] = data.M[self._entries]
        block: Array = self._dense[at][:, at]
        return block
