"""Controllers: how an arm follows the servo's set-point. The records that a program passes, and their laws.

A set-point is the same whichever controller follows it: limits, dead-man, deadlines and stops act before. A law makes
torques of the set-point and of the reading, on top of those that carry the arm's own weight. With q, dq the measured
and q_s, dq_s, ddq_s the set-point's positions, speeds and accelerations, M the joint-space inertia and c the Coriolis
torques, :class:`JointImpedance` applies

    tau = K (q_s - q) + D (dq_s - dq) + M ddq_s + c,

and :class:`OperationalSpace`, with the tcp's Jacobian J and the pose error e (m, and the rotation vector in rad),

    tau = J' (K e + D J (dq_s - dq)) + N' tau_0 + M ddq_s + c,   N' = 1 - J' L J M^-1,   L = (J M^-1 J')^-1,

where the posture's torques tau_0 act in the null space of the task only (Khatib, "A unified approach for motion and
force control of robot manipulators: the operational space formulation", IEEE J. Robotics and Automation 3(1), 1987).

D follows from a damping ratio: in the modes in which K and the inertia are both diagonal, mode i has the damping
``2 ratio sqrt(k_i m_i)`` ("double diagonalization": Albu-Schaeffer, Ott, Frese, Hirzinger, "Cartesian impedance control
of redundant robots", ICRA 2003). A rate r (1/s2) in place of a stiffness is multiplied by the inertia: K = r L.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import dist, hypot, inf, sqrt
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import choice, number, vector
from ..errors import CommandError
from ..types import ControlMode
from .torque_bounds import RATE, ArmInMotion, Inertia, TcpInMotion

if TYPE_CHECKING:
    from ..dynamics import Dynamics
    from ..kinematics.arm import Kinematics
    from ..specs import RobotSpec

Array = NDArray[np.float64]
Floats = Sequence[float]
Gain: TypeAlias = float | tuple[float, ...]

_STIFFEST = 1e5
"""Greatest stiffness, N/m and Nm/rad, and greatest rate, 1/s2."""
_SOFTEST = 1e-3
"""Smallest stiffness and rate, in the same units."""


@dataclass(frozen=True, slots=True)
class Position:
    """The arm's own position controller follows the set-point: as stiff and as exact as the arm is. The default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointImpedance:
    """Each joint follows its set-point like a spring with a damper.

    Args:
        stiffness: Nm/rad, one number or one for each joint. By default four times the joint's torque limit per rad, at
            most 200 Nm/rad, and all softer by one factor where the arm's inertia at the servo's rate allows no more.
        damping_ratio: 1 for critical damping: as fast as possible without overshoot.
        rate: Instead of ``stiffness``: 1/s2, times the inertia. Every joint then answers equally fast, and a joint of
            little inertia, such as a wrist's, with next to no force.
    """

    stiffness: Gain | None = None
    damping_ratio: float = 1.0
    rate: Gain | None = None

    def __post_init__(self) -> None:
        _check_gains(self, ("stiffness", "rate"), None)
        if self.stiffness is not None and self.rate is not None:
            raise CommandError("pass a stiffness or a rate, not both", code="bad_controller")


@dataclass(frozen=True, slots=True, kw_only=True)
class OperationalSpace:
    """The tcp follows its set-point like a body on springs and dampers; the other joints keep a posture.

    Args:
        stiffness: Of the tcp's position, N/m: one number, or three along x, y and z. 1000 N/m by default.
        rotation_stiffness: Of its orientation, Nm/rad: one number, or three about x, y and z. 50 Nm/rad by default.
            Where both are left out, both are softer by one factor if the arm's inertia at the servo's rate allows no
            more.
        damping_ratio: 1 for critical damping: as fast as possible without overshoot.
        frame: Axes of the gains: those of the arm's ``base``, or of the ``tcp`` itself.
        position_only: Leave the orientation free; only the posture's stiffness holds it.
        posture: Joint positions (n,), rad, that the null space moves towards; the set-point's own by default.
        posture_stiffness: Nm/rad of each joint, in the null space only. 10 Nm/rad by default, or less likewise.
        rate: Instead of ``stiffness``: 1/s2, times the inertia at the tcp, as robosuite's ``kp``.
        rotation_rate: The same for the orientation. Pass both rates or none.
    """

    stiffness: Gain | None = None
    rotation_stiffness: Gain | None = None
    damping_ratio: float = 1.0
    frame: Literal["base", "tcp"] = "base"
    position_only: bool = False
    posture: tuple[float, ...] | None = None
    posture_stiffness: float | None = None
    rate: Gain | None = None
    rotation_rate: Gain | None = None

    def __post_init__(self) -> None:
        _check_gains(self, ("stiffness", "rotation_stiffness", "rate", "rotation_rate"), 3)
        choice("frame", self.frame, ("base", "tcp"), "bad_controller")
        if self.posture_stiffness is not None:
            number("posture_stiffness", self.posture_stiffness, "Nm/rad", least=0.0, most=_STIFFEST)
        if self.posture is not None:
            object.__setattr__(self, "posture", tuple(vector("posture", self.posture).tolist()))
        rates = (self.rate is not None, self.rotation_rate is not None)
        if any(rates):
            if self.stiffness is not None or self.rotation_stiffness is not None:
                raise CommandError("pass stiffnesses or rates, not both", code="bad_controller")
            if not all(rates) and not (rates[0] and self.position_only):
                raise CommandError("pass both rate and rotation_rate", code="bad_controller")


Controller: TypeAlias = Position | JointImpedance | OperationalSpace


def _check_gains(record: Any, names: Sequence[str], size: int | None) -> None:
    """Check the gains of a record, and store each as a float or as a tuple."""
    for name in names:
        value = getattr(record, name)
        if value is None:
            continue
        if np.ndim(value) == 0:
            gain: Gain = number(name, value, least=_SOFTEST, most=_STIFFEST)
        else:
            gain = tuple(number(name, x, least=_SOFTEST, most=_STIFFEST) for x in vector(name, value, size).tolist())
        object.__setattr__(record, name, gain)
    number("damping_ratio", record.damping_ratio, least=0.0, above=True, most=5.0)


_KINDS: dict[str, type[Controller]] = {kind.__name__: kind for kind in (Position, JointImpedance, OperationalSpace)}


def controller_data(controller: Controller) -> dict[str, Any] | None:
    """Return a controller as plain data, for the process of the servo; None for :class:`Position`."""
    return None if isinstance(controller, Position) else {"kind": type(controller).__name__, **asdict(controller)}


def controller_of(data: dict[str, Any] | None) -> Controller:
    """Return the controller that :func:`controller_data` described."""
    if data is None:
        return Position()
    values: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in data.items()}
    kind: type[Any] = _KINDS[values.pop("kind")]
    made: Controller = kind(**values)
    return made


_GAINS = ("stiffness", "rotation_stiffness", "rate", "rotation_rate")
_FASTEST = 1.0
"""Greatest product of a mode's natural frequency and the servo's period: beyond it no damping is stable."""
_FASTEST_POSTURE = 0.6
"""The same for the default posture at a damping ratio of 1, which is stable up to 0.82."""
_DAMPED = 0.9
"""Most that a damper may take of a speed in one period of the servo."""


def resolve(
    controller: object, spec: RobotSpec, kinematics: Kinematics, rate_hz: float, simulated: bool = False
) -> Controller:
    """Return a controller with a value for every gain, checked against an arm that takes torques.

    Raises:
        CommandError: A wrong number of gains, a posture beyond the limits, or gains that are too stiff for the arm's
            inertia at this rate (``code`` is ``bad_controller``).
        NotSupported: The arm's URDF lacks inertias (``code`` is ``wrong_inertials``).
    """
    from ..dynamics import Dynamics

    if isinstance(controller, Position):
        return controller
    n = len(spec.joints)
    if isinstance(controller, JointImpedance):
        resolved: Controller = _resolve_joints(controller, spec, n)
    elif isinstance(controller, OperationalSpace):
        resolved = _resolve_task(controller, spec, n)
    else:
        raise CommandError(
            f"controller must be hal.Position(), hal.JointImpedance() or hal.OperationalSpace(), not {controller!r}",
            code="bad_controller",
        )
    dynamics = Dynamics.of(spec)
    mass = np.array(dynamics.mass_matrix(spec.home)) + np.diag(dynamics.damping) * (simulated / rate_hz)
    inverse, jacobian = np.asarray(np.linalg.inv(mass), np.float64), kinematics.jacobian(spec.home)
    if isinstance(resolved, OperationalSpace) and resolved.posture_stiffness is None:
        most = _stiffest_posture(resolved.position_only, inverse, jacobian, rate_hz)
        resolved = replace(resolved, posture_stiffness=min(10.0, most))
    fastest = ControllerLaw(resolved, n, 1.0 / rate_hz).fastest(inverse, jacobian) / rate_hz
    if fastest <= _FASTEST:
        return resolved
    divisor = 1.1 * (fastest / _FASTEST) ** 2
    names = [name for name in _GAINS if getattr(resolved, name, None) is not None]
    if all(getattr(controller, name) is None for name in names):
        softer: dict[str, Any] = {name: tuple(x / divisor for x in getattr(resolved, name)) for name in names}
        return replace(resolved, **softer)
    gains = " and ".join(f"{name} {max(getattr(resolved, name)):g}" for name in names)
    raise CommandError(
        f"{spec.name}: {gains} are too stiff for the inertia of {spec.model} at {rate_hz:g} Hz: divide them by "
        f"{divisor:.1f}, or run the servo at {1.05 * rate_hz * fastest / _FASTEST:.0f} Hz (simulation.physics_hz)",
        code="bad_controller",
    )


def _stiffest_posture(position_only: bool, inverse: Array, jacobian: Array, rate_hz: float) -> float:
    """Return the greatest stiffness of the posture, Nm/rad, that is damped well in the null space at this rate."""
    rows = jacobian[: 3 if position_only else 6]
    task = np.linalg.pinv(rows @ inverse @ rows.T, rcond=1e-9, hermitian=True)
    ease = inverse - inverse @ rows.T @ task @ rows @ inverse
    return (_FASTEST_POSTURE * rate_hz) ** 2 / max(float(np.linalg.eigvalsh(ease)[-1]), _SLOWEST)


def _resolve_joints(controller: JointImpedance, spec: RobotSpec, n: int) -> JointImpedance:
    if controller.rate is not None:
        return replace(controller, rate=_spread("rate", controller.rate, n))
    stiffness = controller.stiffness
    if stiffness is None:
        assert spec.limits.torque is not None
        stiffness = tuple(min(200.0, 4.0 * most) for most in spec.limits.torque)
    return replace(controller, stiffness=_spread("stiffness", stiffness, n))


def _resolve_task(controller: OperationalSpace, spec: RobotSpec, n: int) -> OperationalSpace:
    if controller.posture is not None:
        posture = vector("posture", controller.posture, n)
        if (posture < spec.limits.lower).any() or (posture > spec.limits.upper).any():
            raise CommandError(f"{spec.name}: the posture is outside the joint limits", code="bad_controller")
    if controller.rate is not None:
        rotation = None if controller.rotation_rate is None else _spread("rotation_rate", controller.rotation_rate, 3)
        return replace(controller, rate=_spread("rate", controller.rate, 3), rotation_rate=rotation)
    return replace(
        controller,
        stiffness=_spread("stiffness", 1000.0 if controller.stiffness is None else controller.stiffness, 3),
        rotation_stiffness=_spread(
            "rotation_stiffness", 50.0 if controller.rotation_stiffness is None else controller.rotation_stiffness, 3
        ),
    )


def _spread(name: str, gain: Gain, count: int) -> tuple[float, ...]:
    """Return ``count`` gains: the same one for all if there is only one."""
    gains = (gain,) * count if isinstance(gain, (int, float)) else gain
    if len(gains) != count:
        raise CommandError(f"{name} must be one number or {count}, not {len(gains)}", code="bad_controller")
    return gains


_FIXED = ("frame", "position_only")


def replace_gains(controller: Controller, gains: dict[str, ArrayLike]) -> Controller:
    """Return a controller with other gains.

    Raises:
        CommandError: No such gain, one that stays as it is within a session, or a stiffness in place of a rate
            (``code`` is ``bad_controller``).
    """
    known = set(asdict(controller)) - set(_FIXED)
    for name in gains:
        if name not in known:
            text = f"{type(controller).__name__} has no gain {name!r} to change; gains: {', '.join(sorted(known))}"
            raise CommandError(text, code="bad_controller")
        if name in _GAINS and getattr(controller, name) is None:
            text = f"{name}: a session that began with stiffnesses takes no rates, nor the other way round"
            raise CommandError(text, code="bad_controller")
    changed: Controller = replace(controller, **gains)  # type: ignore[arg-type]  # checked by the record
    return changed


# The laws.

RAMP = 0.2
"""Time in which new gains take effect, s."""
_HEAVIEST = np.array([200.0] * 3 + [20.0] * 3)
"""Greatest inertia at the tcp that is taken into account, kg and kg m2: near a singularity it is infinite."""
_SLOWEST = 1e-9
"""Smallest square of a natural frequency, 1/s2, for the rounding of those that are 0."""
_TURN = 3.0
"""Speed that the tcp must not turn faster than when it is let go, rad/s."""
_RELEASED = 0.7
"""Share of this speed, and of the joints', that a spring may reach."""
_SAME_INERTIA = 0.02
"""The damping is computed again when the joints have moved this far, rad."""
_LET_GO = 1.0 / np.e
_POSTURE_LEAD = 0.2
"""A posture that is farther away pulls no harder, rad."""


class ControllerLaw:
    """Makes torques of set-points and readings, by one controller.

    Args:
        controller: A :class:`JointImpedance` or :class:`OperationalSpace` with all its gains (see :func:`resolve`).
        n: Number of joints.
        dt: Period of the servo, s.
        velocity: Greatest joint speeds (n,), rad/s; not needed to ask for :meth:`fastest`.
        dynamics: The arm's dynamics, for the Coriolis torques; without it there are none.
        friction: Viscous friction (n,) of the joints that is to be compensated, Nm s/rad; None for none.
        reach: Greatest speed of the tcp at joint speeds of length 1, m/rad.
    """

    _tcp: TcpInMotion
    _turn: Array

    def __init__(
        self,
        controller: Controller,
        n: int,
        dt: float,
        velocity: Floats = (),
        dynamics: Dynamics | None = None,
        friction: Floats | None = None,
        reach: float = inf,
    ) -> None:
        self._dt = dt
        self._reach = reach if isinstance(controller, JointImpedance) else 1.0
        self._most = 1.5 * (_FASTEST / dt) ** 2
        """Greatest square of a mode's natural frequency, 1/s2: a faster one is softened."""
        self._dynamics = dynamics
        self._friction = np.array(friction) if friction is not None and any(friction) else None
        self.in_joints = isinstance(controller, JointImpedance)
        """Whether the springs are those of the joints; else they are those of the tcp."""
        self.mode = ControlMode.JOINT_IMPEDANCE if self.in_joints else ControlMode.OPERATIONAL_SPACE
        self.controller = controller
        task = controller if isinstance(controller, OperationalSpace) else None
        self.position_only = task is not None and task.position_only
        """Whether the orientation of the tcp is free."""
        self._rows = n if task is None else 3 if task.position_only else 6
        released = np.array(velocity if task is None else [inf] * 3 + [_TURN] * (self._rows - 3))
        self._release = np.e * _RELEASED * released
        """Length of each spring, times its natural frequency, that is not exceeded, rad/s."""
        self._slowest_release = min(self._release.tolist(), default=0.0)
        self._along_tcp = task is not None and task.frame == "tcp"
        self._redundant = task is not None and n > self._rows
        self._ease = 0.0 if task is None else np.diag(1.0 / _HEAVIEST[: self._rows])
        self._by_rate = getattr(controller, "rate", None) is not None
        import eigenpy

        self._eigen: Any = eigenpy.SelfAdjointEigenSolver(np.eye(self._rows))
        self._llt: Any = eigenpy.LLT(np.eye(self._rows))
        self._eigen_mass: Any = eigenpy.SelfAdjointEigenSolver(np.eye(n))
        self._lengths = np.zeros((2, self._rows))
        """Lengths of the springs of turn and of position, m and rad."""
        self._tuned_at: Floats = ()
        """Joint positions of what follows, rad; empty if the gains are different now."""
        self._stiffness = self._damping = np.zeros((0, 0))
        """Of the springs (k, k); lengths times the first are forces, and the second times speeds."""
        self._posture_damping = np.zeros((0, 0))
        """Of the posture (n, n), Nm s/rad."""
        self._squares = self._modal_squares = self._frequencies = np.ones(1)
        """Squares of the natural frequencies of each spring alone, of the modes, 1/s2, and their roots."""
        self._fastest = 0.0
        self._modes: Array | None = None
        """The modes: columns, each multiplied by the root of the stiffness; None for those of the springs alone."""
        self._most_gain = inf
        """Greatest speed of the tcp, m/s, that springs of length 1 may still add."""
        self._tau = np.zeros((2, n))
        self._stretched: Array = np.zeros(3)
        """Lengths (k,) of the springs in the last call."""
        self._goal = self._from = self._now = self._numbers(controller)
        self._ramped = 1.0
        self._apply(self._goal)
        self._set_posture(controller)

    def _numbers(self, controller: Controller) -> Array:
        """Return all gains as one vector: those of the task or of the joints, the damping ratio, the posture's."""
        if isinstance(controller, JointImpedance):
            gains = controller.rate if controller.rate is not None else controller.stiffness
            return np.array([*_tuple(gains), controller.damping_ratio, 0.0])
        assert isinstance(controller, OperationalSpace)
        by_rate = controller.rate is not None
        first = controller.rate if by_rate else controller.stiffness
        second = controller.rotation_rate if by_rate else controller.rotation_stiffness
        gains = (*_tuple(first), *(() if controller.position_only else _tuple(second)))
        assert controller.posture_stiffness is not None, "resolve a controller first"
        return np.array([*gains, controller.damping_ratio, controller.posture_stiffness])

    def set_gains(self, controller: Controller) -> None:
        """Change the gains, within :data:`RAMP` s; ``controller`` is of the same kind."""
        self.controller = controller
        self._from, self._goal = self._now, self._numbers(controller)
        self._ramped = 0.0
        self._set_posture(controller)

    def _set_posture(self, controller: Controller) -> None:
        posture = getattr(controller, "posture", None)
        self._posture = None if posture is None else np.array(posture)

    def _apply(self, numbers: Array) -> None:
        self._now = numbers
        self._gains, self._ratio, self._posture_stiffness = numbers[:-2], float(numbers[-2]), float(numbers[-1])
        self._roots = np.sqrt(self._gains)
        self._weights = np.outer(self._roots, self._roots)
        self._tuned_at = ()

    def fastest(self, inverse_mass: Array, jacobian: Array) -> float:
        """Return the fastest mode's natural frequency, rad/s, at an inverse inertia (n, n) and a Jacobian (6, n)."""
        if self._by_rate:
            return float(self._roots.max())
        if self.in_joints:
            ease = inverse_mass
        else:
            rows = jacobian[: self._rows]
            ease = rows @ inverse_mass @ rows.T
        return sqrt(float(np.linalg.eigvalsh(ease * self._weights).max()))

    def torques(self, arm: ArmInMotion, tcp: TcpInMotion, setpoint: tuple[Array, Array, Array], error: Floats) -> Array:
        """Return the torques of one period, on top of those that carry the arm's weight.

        Args:
            arm: Measured state.
            tcp: That of the tcp.
            setpoint: Positions, speeds and accelerations (n,) of the set-point.
            error: Twist (6,) from the tcp's pose to the set-point's within 1 s, m and rad
                (:func:`hal.geometry.difference`).

        Returns:
            Two rows (2, n), Nm, whose sum is the controller's. The second is what the springs of the tcp's position
            exert, or those of the joints; the first is all the rest, which alone makes the tcp as fast as the
            set-point, and no faster. They are valid until the next call.
        """
        if self._ramped < 1.0:
            self._ramped = min(1.0, self._ramped + self._dt / RAMP)
            self._apply(self._from + self._ramped * (self._goal - self._from))
        q_set, dq_set, ddq_set = setpoint
        inertia, lag = arm.inertia, dq_set - tcp.dq
        tuned = len(self._tuned_at) > 0 and dist(arm.q, self._tuned_at) <= _SAME_INERTIA
        self._tcp = tcp
        rest: Array = inertia.moved.dot(ddq_set)
        if self._friction is not None:
            rest += self._friction * tcp.dq
        if self._dynamics is not None:
            rest += self._dynamics.coriolis(tcp.q, tcp.dq)
        if self.in_joints:
            if not tuned:
                self._tune(arm.q, inertia.inverse, inertia)
            self._stretched = lengths = self._shorten(q_set - tcp.q)
            self._tau[0], self._tau[1] = self._damping.dot(lag), lengths.dot(self._stiffness)
        else:
            task = tcp.jacobian[: self._rows]
            if self._along_tcp:
                self._turn = turn = _rotation(tcp.pose[3:])
                task, error = _rotate(turn.T, task), _rotate(turn.T, np.array(error)).tolist()
            eased = inertia.solve(task.T)  # M^-1 J'
            ease = task.dot(eased)
            ease += self._ease
            if not tuned:
                self._tune(arm.q, ease, inertia)
            force = self._force(lag, task, error)
            if self._redundant:
                rest += self._posture_torques(q_set, lag, eased, ease, force)
            force.dot(task, self._tau)
        self._tau[0] += rest
        return self._tau

    def _force(self, lag: Array, jacobian: Array, error: Floats) -> Array:
        """Return the forces (2, k) of the tcp's springs and dampers: those of its position's springs are the second."""
        lengths = self._lengths
        lengths[1, :3] = error[:3]
        if self._rows == 6:
            lengths[0, 3:] = error[3:]
            self._shorten(lengths[0])
        force: Array = lengths.dot(self._stiffness)
        force[0] += self._damping.dot(jacobian.dot(lag))
        self._stretched = lengths[1]
        return force

    def _posture_torques(self, q_set: Array, lag: Array, eased: Array, ease: Array, force: Array) -> Array:
        """Return the torques (n,) of the posture, and take what they would move the tcp with off ``force`` (2, k)."""
        away = (q_set if self._posture is None else self._posture) - self._tcp.q
        if away.dot(away) > _POSTURE_LEAD * _POSTURE_LEAD:
            np.clip(away, -_POSTURE_LEAD, _POSTURE_LEAD, out=away)
        posture: Array = self._posture_damping.dot(lag)
        away *= self._posture_stiffness
        posture += away
        self._llt.compute(ease)
        force[0] -= self._llt.solve(posture.dot(eased))
        return posture

    @property
    def most_gain(self) -> float:
        """Upper bound of the length of :meth:`gain`, m/s."""
        return self._most_gain * hypot(*self._stretched.tolist())

    def gain(self) -> Array:
        """Return the velocity (3,) of the tcp, m/s, that the springs may add if all torques are removed from now on.

        A mode with the natural frequency w gains no more than a critically damped one that is let go: its acceleration
        for 1 / (e w).
        """
        lengths, most = self._stretched, float(np.abs(self._tau[1]).max())
        seconds = np.minimum(2.0 * self._dt + most * (0.5 / RATE), _LET_GO / self._frequencies)
        if self._modes is None:
            velocity = lengths * self._modal_squares * seconds
        else:
            velocity = self._modes.dot(lengths.dot(self._modes) * self._modal_squares * seconds) / self._gains
        if self.in_joints:
            return np.asarray(self._tcp.jacobian[:3].dot(velocity), np.float64)
        return np.asarray(self._turn.dot(velocity[:3]) if self._along_tcp else velocity[:3], np.float64)

    def _shorten(self, lengths: Array) -> Array:
        """Cut the lengths (k,) of springs, in place, so that none moves what it holds too fast when let go.

        A critically damped spring of length x that is let go reaches the speed w x / e.
        """
        if sqrt(lengths.dot(lengths)) * self._fastest > self._slowest_release:
            most = self._release / np.sqrt(self._squares)
            np.minimum(np.maximum(lengths, -most, out=lengths), most, out=lengths)
        return lengths

    def _tune(self, q: Floats, ease: Array, inertia: Inertia) -> None:
        """Compute stiffness, damping and modes of the springs for an inertia.

        In the modes of the matrix sqrt(K) A sqrt(K), A being the inverse inertia, each spring of unit stiffness moves a
        mass of 1 / w^2, so that a damper of 2 ratio / w damps it by the ratio.

        Args:
            q: Joint positions (n,), rad.
            ease: Inverse of the inertia that the springs move (k, k).
            inertia: Inertia of the arm.
        """
        self._tuned_at = q
        if self._by_rate:
            heavy: Any = np.linalg.inv(ease)
            self._modes, self._frequencies = None, self._roots
            self._squares = self._modal_squares = self._gains
            self._stiffness = self._gains[:, None] * heavy
            self._damping = heavy * np.minimum(2.0 * self._ratio * self._roots, _DAMPED / self._dt)
        else:
            self._eigen.compute(ease * self._weights)
            squares: Array = np.maximum(self._eigen.eigenvalues(), _SLOWEST)
            self._modes = modes = self._roots[:, None] * self._eigen.eigenvectors()
            self._squares, self._modal_squares = self._gains * ease.diagonal(), squares
            self._frequencies = np.sqrt(squares)
            damping = np.minimum(2.0 * self._ratio / self._frequencies, (_DAMPED / self._dt) / squares)
            self._damping = (modes * damping).dot(modes.T)
            self._stiffness = np.diag(self._gains)
            if squares[-1] > self._most:  # where the arm is lighter than at home
                self._stiffness = (modes * np.minimum(1.0, self._most / squares)).dot(modes.T)
        self._fastest = float(self._frequencies.max())
        stiff = self._gains if self.in_joints else self._gains[:3]
        self._most_gain = self._reach * _LET_GO * self._fastest * sqrt(float(stiff.max() / stiff.min()))
        if self._redundant:
            # The damping is 2 ratio sqrt(k) M^(1/2), with a little of M. Along any motion z it is at most critical, as
            # z' M^(1/2) z <= sqrt(z' M z) for |z| = 1: the elbow's own motion may have a hundredth of the inertia of
            # the joints that take part in it.
            self._eigen_mass.compute(inertia.moved)
            squares, axes = self._eigen_mass.eigenvalues(), self._eigen_mass.eigenvectors()
            root = (axes * np.sqrt(np.maximum(squares, 0.0))).dot(axes.T)
            self._posture_damping = 2.0 * self._ratio * sqrt(self._posture_stiffness) * root + inertia.moved


def _tuple(gain: Gain | None) -> tuple[float, ...]:
    assert isinstance(gain, tuple), "resolve a controller first"
    return gain


def _rotate(turn: Array, values: Array) -> Array:
    """Return values (3, ...) or (6, ...) with each three of them turned by a matrix (3, 3)."""
    if len(values) == 3:
        return turn @ values
    return np.concatenate((turn @ values[:3], turn @ values[3:]))


def _rotation(quaternion: Floats) -> Array:
    x, y, z, w = quaternion
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
