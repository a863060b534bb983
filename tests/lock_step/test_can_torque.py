"""Torques and weight of an arm with Damiao motors, on the emulator's mechanics with gravity and friction."""

from __future__ import annotations

import numpy as np
import pytest
from stepped_can import SteppedEmulator, stepped_arm

from hal import JointTorque, RobotStatus
from hal.driver import Setpoint
from hal.drivers.can.damiao import DamiaoArm

NONE = JointTorque([0.0] * 6)
YAW = JointTorque([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_an_arm_without_torques_floats() -> None:
    with stepped_arm() as arm:
        start = arm.q
        assert arm.run(1.0, NONE) is None
        assert np.abs(arm.q - start).max() < 5e-3, "the driver adds the torques that carry the arm's weight"


def test_a_torque_turns_its_joint_by_the_mass_matrix() -> None:
    with SteppedEmulator("yam") as far:
        driver = DamiaoArm(far.spec)
        driver.open()
        zeros = (0.0,) * 6
        for k in range(60):
            far.advance(0.004)
            reading = driver.read(0.004 * k)
            if not driver.engaged:
                driver.engage()
            elif k >= 35:
                driver.write(Setpoint(reading.q, reading.dq, zeros, (2.0, *zeros[1:])))
        far.advance(0.004)
        motor = far.arm.motors[1].mechanics
        inertia = driver.mass_matrix(reading.q)[0][0] + motor.inertia
        speed = far.arm.plant.dq[0]
        expected = 0.1 * (2.0 - motor.coulomb - 0.5 * motor.viscous * speed) / inertia
        assert speed == pytest.approx(expected, rel=0.1), "Nm, kg m2 and rad/s agree"
        far.cut("on")
        driver.close()


def test_an_arm_is_held_after_torques() -> None:
    with stepped_arm() as arm:
        arm.run(0.3, YAW)
        assert arm.dq[0] > 0.2
        arm.control.close()
        arm.run(0.5)
        held = arm.q
        assert arm.robot.state().status is RobotStatus.IDLE
        assert np.abs(arm.dq).max() < 1e-3
        arm.run(0.5)
        assert arm.q == pytest.approx(held, abs=1e-3)
        assert arm.driver.engaged


def test_a_raised_arm_hangs_by_less_than_its_stiffness_alone_would_let_it() -> None:
    with stepped_arm() as arm:
        arm.run(0.5)
        weight = np.abs(arm.driver.dynamics.gravity(arm.far.spec.home))
        alone = (weight / [motor.kp for motor in arm.driver.chain.motors]).max()
        assert alone > 0.05
        assert np.abs(arm.q - arm.far.spec.home).max() < 5e-3
