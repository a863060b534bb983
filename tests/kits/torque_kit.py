"""An arm that is driven by torques, for tests: a servo and the driver under it, ticked by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from engines_kit import Engine
from numpy.typing import NDArray
from servo_kit import HandTicked
from specs import panda

from hal.commands import Kind, Session
from hal.driver import Reading, Setpoint
from hal.drivers.mock.robot import MockRobot
from hal.servo.controllers import Controller, controller_data, resolve
from hal.servo.servo import Servo
from hal.specs import WorkspaceSpec
from hal.types import RobotStatus, Trip

N = 7
NOTHING = (0.0,) * N


class Driven(HandTicked):
    """One arm under its servo. Its dead-man is held, unless it has none; the app and the pad are alive."""

    def __init__(
        self,
        driver: Any,
        world: Any = None,
        *,
        rate_hz: float = 240.0,
        speed: float = 0.3,
        tcp_speed: float = 0.25,
        deadman: bool = True,
        mass_matrix: Callable[[Sequence[float]], Any] | None = None,
        controller: Controller | None = None,
    ) -> None:
        self.driver, self.world = driver, world
        super().__init__(driver.spec, rate_hz, 20.0, deadman)
        self.servo = Servo(self.spec, self.dt, None, mass_matrix or driver.mass_matrix)
        self.silent = False
        """Whether the device does not answer."""
        self.tamper: Callable[[Reading], Reading] = lambda reading: reading
        """Changes a reading on its way to the servo."""
        self.setpoint: Setpoint | None = None
        self.given: list[Setpoint] = []
        """Set-points that the driver got."""
        self.readings: list[Reading] = []
        driver.open()
        self.reading: Reading = driver.read(self.now)
        self.servo.anchor(self.reading.q)
        chosen = None
        if controller is not None:
            chosen = controller_data(resolve(controller, self.spec, self.servo.kinematics, rate_hz))
        self.servo.open_session(Session(1, speed, tcp_speed, deadman, controller=chosen), self.inbox())
        self.tick()
        if deadman:
            self.press()

    @property
    def tau(self) -> Sequence[float]:
        """Torques that the driver got last, Nm."""
        assert self.setpoint.tau is not None
        return self.setpoint.tau

    @property
    def by_torques(self) -> bool:
        return self.setpoint is not None and self.setpoint.tau is not None

    @property
    def state(self) -> tuple[RobotStatus, Trip]:
        return self.servo.report.status, self.servo.report.trip

    @property
    def q(self) -> NDArray[np.float64]:
        return np.array(self.reading.q)

    @property
    def dq(self) -> NDArray[np.float64]:
        return np.array(self.reading.dq)

    @property
    def tcp_speed(self) -> float:
        """Measured speed of the tcp, m/s."""
        return float(np.linalg.norm((self.servo.kinematics.jacobian(self.q) @ self.dq)[:3]))

    def send(self, values: Sequence[float], kind: Kind = Kind.JOINT_TORQUE, deadline: float = 0.1) -> int:
        return super().send(kind, values, deadline)

    def tick(self) -> Setpoint | None:
        self.now += self.dt
        if self.world is not None:
            self.world.step()
        self.reading = self.driver.read(self.now)
        self.readings.append(self.reading)
        if self.silent:
            self.setpoint = self.servo.device_lost(self.now, self.inbox())
        else:
            self.setpoint = self.servo.tick(self.now, self.tamper(self.reading), self.inbox())
        self.limited |= self.servo.report.limited
        if self.setpoint is not None and not self.silent:
            self.driver.write(self.setpoint)
            self.given.append(self.setpoint)
            self.audit.add_setpoint(self.setpoint)
        return self.setpoint

    def drive(self, seconds: float, tau: Sequence[float] = NOTHING) -> None:
        """The same torques again and again."""
        for _ in range(round(seconds / self.dt)):
            self.send(tau)
            self.tick()

    def until_held(self, most: float = 1.0) -> float:
        """Tick until positions hold the arm; returns how long that took, s."""
        begun = self.now
        while self.by_torques or not self.servo._is_at_rest():
            self.tick()
            assert self.now < begun + most, "positions did not take over"
        return self.now - begun


def one(joint: int, tau: float) -> list[float]:
    """A torque on one joint, none on the others."""
    return [tau if k == joint else 0.0 for k in range(N)]


def wheels(box: WorkspaceSpec | None = None, **how: Any) -> Driven:
    """The mock: seven wheels, which nothing couples, on the Panda's model."""
    rate_hz = how.get("rate_hz", 240.0)
    return Driven(MockRobot(replace(panda(driver="mock"), rate_hz=rate_hz, workspace=box)), **how)


def simulated(
    engine: Engine, initial: Sequence[float] | None = None, box: WorkspaceSpec | None = None, **how: Any
) -> Driven:
    """A simulated Panda, which has had the time to settle."""
    rate_hz = how.get("rate_hz", 240.0)
    spec = replace(panda(), rate_hz=rate_hz, workspace=box)
    if initial is not None:
        spec = replace(spec, initial=tuple(initial))
    world = engine.world(spec, physics_hz=rate_hz)
    for _ in range(60):
        world.step()
    return Driven(engine.robot(world), world, **how)
