"""A simulated arm, without its physics engine: how it takes set-points, holds, and fails on demand."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import CommandError, ConnectionLost, Fault
from hal.following import Following
from hal.specs import RobotSpec

from .disturbances import Disturbances
from .world import SimulatedWorld

HOLD_TIME = 0.020
"""Time for which torques are held without new ones, s: the same as a Franka's."""
FOLLOWING, PATIENCE = 0.1, 0.1
"""A joint that is farther from its set-point than this, rad, for longer than this, s, does not follow."""

Floats = Sequence[float]
W = TypeVar("W", bound=SimulatedWorld)  # type: ignore[type-arg]  # of any kind of body


class SimulatedRobot(RobotDriver, Generic[W]):
    """Base class of the driver of one robot in a simulated world.

    Its joints follow positions by motors that an engine implements: at the end of the step before which a set-point was
    written the arm is there, so the next reading has no lag, and the arm does not sag. The motors' torques are limited
    to those of the rig, or of the URDF where the rig has none, and their speeds too, so that a set-point that jumps
    cannot move a joint faster.

    A joint that something keeps away from its set-point is a fault, as on a real arm: the arm then holds where it is.

    A set-point with torques switches the motors off, and adds its torques to the compensation of gravity; one without
    switches them on again. The last torques are held for 20 ms without new ones, then the motors hold the arm.

    With the latencies and the noise of ``rig.world.randomize``, motors get a set-point later and not exactly, and a
    reading has what was measured some time before, at its ``t_device``. ``q_commanded`` is what the arm has accepted.
    """

    modes: ClassVar[frozenset[str]] = frozenset({"position", "velocity", "torque"})
    simulated: ClassVar[bool] = True
    WORLD: ClassVar[type[SimulatedWorld]]  # type: ignore[type-arg]
    """The class of world that the arm must stand in."""

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        if not isinstance(world, self.WORLD):
            text = f"{spec.name}: a simulated device needs its simulated world, not {world!r}"
            raise CommandError(text, code="world_missing")
        self.scene: W = world  # type: ignore[assignment]  # of that class
        self._open = False
        self._connected = True
        self._frozen: Reading | None = None
        self._freeze = False
        self._fault: Fault | None = None
        """The injected fault."""
        self._following = Following(spec.joints, [FOLLOWING] * len(spec.joints), patience=PATIENCE)
        self._away: Fault | None = None
        """The fault of a joint that does not follow; kept until recover()."""
        self._q: Floats | None = None
        self._dq: Floats | None = None
        self._tau: Floats | None = None
        """Torques that drive the arm, Nm; None while the motors follow positions."""
        self._received = 0
        """The step before which the last torques arrived."""
        noise = "position_noise", "velocity_noise", "torque_noise"
        self._disturbances = Disturbances(world, f"robots.{spec.name}", noise)
        self._arrived: tuple[Floats, Floats] | None = None
        """What the motors follow, which newer set-points that are under way are not; None before the first one."""

    # --- what an engine implements -----------------------------------------------------------------------------------

    @abstractmethod
    def find_device(self) -> None:
        """Find the robot in the world; raises DeviceNotFound."""

    @abstractmethod
    def read_state(self) -> tuple[Floats, Floats, Floats]:
        """Return positions (n,), velocities (n,), and the torques (n,) that the motors applied in the last step."""

    @abstractmethod
    def follow_setpoint(self, q: Floats, dq: Floats) -> None:
        """Let the motors bring the joints to ``q`` with the velocities ``dq`` by the end of the next step."""

    @abstractmethod
    def hold_at(self, q: Floats) -> None:
        """Switch the motors on, if they are off, and let them hold the joints at ``q``."""

    @abstractmethod
    def release_motors(self) -> None:
        """Switch the motors off, because torques follow."""

    @abstractmethod
    def apply_torques(self, tau: Floats) -> None:
        """Apply torques (n,) on top of the compensation to the next step, in place of those applied to it before."""

    # --- the driver --------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Find the robot in the world; raises DeviceNotFound."""
        self.find_device()
        if not self._open:
            self.scene.on_reset(self.spec.name, self._was_reset)
            self.scene.keep(self.spec.name, self._save, self._restore)
        self._open = True

    def read(self, now: float) -> Reading:
        """Return the joints after the last physics step; ``tau`` is what the motors applied in it, Nm."""
        if not self._open or not self._connected:
            raise self._lost()
        world = self.scene
        self._disturbances.update()
        if self._tau is not None:
            self._keep_torques(self._tau)
        if self._freeze and self._frozen is not None:
            return self._frozen
        q, dq, tau = self.read_state()
        if self._tau is None and self._q is not None and self._dq is not None and world.fault is None:
            away = self._following.check(world.t, q, *(self._arrived or (self._q, self._dq)))
            if away is not None:
                self._away = self._away or away
                self._hold(q)
        fault = self._fault or self._away or world.fault
        t, (q, dq, tau) = self._disturbances.measure(q, dq, tau)
        reading = Reading(now, t, world.steps, q, dq, tau, self._q, self._dq, None, None, fault)
        self._frozen = reading
        return reading

    def write(self, setpoint: Setpoint) -> None:
        """Apply a set-point; a robot with a fault ignores it, which its ``q_commanded`` shows."""
        if not self._open or not self._connected:
            raise self._lost()
        if self._fault is not None or self._away is not None:
            return
        if self._disturbances.active:
            self._disturbances.send(partial(self._carry_out, setpoint))
        else:
            self._carry_out(setpoint)
        self._q, self._dq = setpoint.q, setpoint.dq

    def _carry_out(self, setpoint: Setpoint) -> None:
        """Let the motors do what a set-point says that has arrived."""
        q, dq, tau = setpoint.q, setpoint.dq, setpoint.tau
        if tau is not None:
            if self._tau is None:
                self.release_motors()
            self._tau, self._received = tau, self.scene.steps
            self._keep_torques(tau)
        else:
            if self._tau is not None:
                self.hold_at(q)  # puts the motors' speed limits back
                self._tau = None
            self.follow_setpoint(self._blur(q) if self._disturbances.active else q, dq)
        self._arrived = q, dq

    def _blur(self, q: Floats) -> Floats:
        """Return what the motors get of a set-point: with noise, which takes no joint over its limits."""
        blurred, limits = self._disturbances.blur_command(q), self.spec.limits
        ranges = zip(blurred, q, limits.lower, limits.upper, strict=True)
        return [min(max(each, min(low, own)), max(high, own)) for each, own, low, high in ranges]

    def _keep_torques(self, tau: Floats) -> None:
        """Apply torques to each step and compensate gravity, as an arm's own controller does between commands."""
        if (self.scene.steps - self._received) * self.scene.dt > HOLD_TIME:
            self._hold(self._positions())
        else:
            self.apply_torques(tau)

    def halt(self) -> None:
        """Hold the last set-point; an arm that is driven by torques holds its present position."""
        if not self._open or self._q is None:
            return
        if self._tau is None and self._disturbances.active:  # after the set-points that are under way
            self._dq = [0.0] * len(self._q)
            self._disturbances.send(partial(self._carry_out, Setpoint(self._q, self._dq, self._dq)))
        else:
            self._hold(self._q if self._tau is None else self._positions())

    def recover(self) -> None:
        """Clear every fault; an arm that did not follow, or to which commands are under way, holds where it is."""
        if self._away is not None or (self._open and self._disturbances.commands.steps):
            self._hold(self._positions())
        self._connected, self._freeze, self._fault, self._away = True, False, None, None

    def inject(self, **faults: object) -> None:
        """Switch injected faults on or off. Raises CommandError for another one.

        ``freeze=True``: every reading repeats the last one, including its stamps. ``disconnect=True``: the robot does
        not answer. ``fault="text"``: the robot reports that fault, holds its position and ignores set-points;
        ``fault=None`` ends it.
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
        self._fault = Fault("injected", str(cause), "nothing to repair: a simulated fault") if cause else None
        if self._fault is not None and self._open:
            self._hold(self._positions())

    def close(self) -> None:
        """Disconnect; the motors hold the last set-point for as long as the world exists.

        With a latency that is where the arm is: what is under way does not arrive any more.
        """
        if self._open and self._q is not None and self._disturbances.commands.steps:
            self._hold(self._positions())
        else:
            self.halt()
        if self._open:
            self.scene.off_reset(self.spec.name, self._was_reset)
        self._open = False

    def _lost(self) -> ConnectionLost:
        return ConnectionLost(f"{self.spec.name} {'does not answer (injected)' if self._open else 'is not open'}")

    def _hold(self, q: Floats) -> None:
        self.hold_at(q)
        self._q, self._dq = list(q), [0.0] * len(q)
        self._arrived, self._tau = (self._q, self._dq), None
        self._disturbances.commands.clear()

    def _positions(self) -> Floats:
        return self.read_state()[0]

    def _save(self) -> dict[str, Any]:
        q, dq = self._arrived or (self._q, self._dq)  # commands that are under way are lost
        parts = {"q": q, "dq": dq, "tau": self._tau}
        state: dict[str, Any] = {name: None if part is None else list(part) for name, part in parts.items()}
        return state | {"age": self.scene.steps - self._received}

    def _restore(self, state: dict[str, Any]) -> None:
        self._frozen = self._arrived = None
        self._disturbances.forget()
        self._q, self._dq, self._tau = state["q"], state["dq"], state["tau"]
        if self._q is not None and self._dq is not None:
            self._arrived = self._q, self._dq
        self._received = self.scene.steps - state["age"]
        self._away = None
        self._following.forget()

    def _was_reset(self) -> None:
        self._frozen = None
        self._disturbances.forget()
        self._q, self._dq = self._positions(), [0.0] * len(self.spec.joints)
        self._arrived = self._q, self._dq
        self._tau = self._away = None
        self._following.forget()
