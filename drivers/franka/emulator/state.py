"""Puts what the arm is and does into the state packet. Contacts, external forces and accelerometers are always 0."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.drivers.franka.limits import ELBOW_FLIP

from .layouts import FLAG_COUNT, StatePacket
from .samples import DT, Floats

if TYPE_CHECKING:
    from .arm import Arm

__all__ = ["StateWriter"]

_HAND_MASS = 0.73
_HAND_CENTRE = (-0.01, 0.0, 0.03)
_HAND_INERTIA = (0.001, 0.0, 0.0, 0.0, 0.0025, 0.0, 0.0, 0.0, 0.0017)
"""What a state of an arm with a Franka Hand shows as m_ee (kg), F_x_Cee (m) and I_ee (kg m2)."""


class StateWriter:
    """Keeps one packet and brings it up to date, writing only what may have changed."""

    def __init__(self, version: int) -> None:
        self.packet = StatePacket(version)
        self._settings: object = None
        self._changes = -1
        self._flags: object = None
        self._q: Floats | None = None
        self._q_d: Floats | None = None
        self._tau: Floats = (0.0,) * 7
        self.packet.put("O_ddP_O", (0.0, 0.0, -9.81))

    def write(self, arm: Arm) -> bytearray:
        """The packet as it stands after this cycle. The same buffer every time."""
        packet, plant, motion, sample = self.packet, arm.plant, arm.motion, arm.shown
        if arm.settings is not self._settings or arm.settings.changes != self._changes:
            self._write_settings(arm)
        packet.put("message_id", (arm.message_id,))
        q, tau = plant.q, plant.tau
        if q is not self._q or sample.q is not self._q_d:
            self._write_poses(arm)
        dtau = [(new - old) / DT for new, old in zip(tau, self._tau, strict=True)]
        self._tau = tau
        torques: Floats = motion.torques if motion is not None else (0.0,) * 7
        packet.put_joints((*tau, *torques, *dtau, *q, *sample.q, *plant.dq, *sample.dq, *sample.ddq))
        packet.put_motors((*q, *plant.dq))
        packet.put_modes(*arm.modes)
        flags = (arm.errors, arm.last_errors)
        if flags != self._flags:
            self._flags = flags
            for name, raised in (("errors", arm.errors), ("reflex_reason", arm.last_errors)):
                packet.put(name, [int(k in raised) for k in range(FLAG_COUNT)])
        packet.put("robot_mode", (arm.mode,))
        packet.put("control_command_success_rate", (motion.success_rate if motion is not None else 0.0,))
        return packet.buffer

    def _write_poses(self, arm: Arm) -> None:
        q, q_d = arm.plant.q, arm.shown.q
        self._q, self._q_d = q, q_d
        packet, tip = self.packet, arm.settings.F_T_EE
        pose = arm.plant.body.tip(q, tip)
        desired = pose if q_d is q else arm.plant.body.tip(q_d, tip)
        packet.put("O_T_EE", pose)
        packet.put("O_T_EE_d", desired)
        packet.put("O_T_EE_c", desired)
        packet.put("elbow", _elbow(q))
        packet.put("elbow_d", _elbow(q_d))
        packet.put("elbow_c", _elbow(q_d))

    def _write_settings(self, arm: Arm) -> None:
        packet, settings = self.packet, arm.settings
        self._settings, self._changes = settings, settings.changes
        packet.put("F_T_EE", settings.F_T_EE)
        packet.put("EE_T_K", settings.EE_T_K)
        packet.put("F_T_NE", settings.F_T_NE)
        packet.put("NE_T_EE", settings.NE_T_EE)
        if settings.with_hand:
            packet.put("m_ee", (_HAND_MASS,))
            packet.put("F_x_Cee", _HAND_CENTRE)
            packet.put("I_ee", _HAND_INERTIA)
        mass, centre, inertia = settings.load
        packet.put("m_load", (mass,))
        packet.put("F_x_Cload", centre)
        packet.put("I_load", inertia)
        self._q = None


def _elbow(q: Floats) -> tuple[float, float]:
    """Angle of joint 3, and which way joint 4 bends."""
    return q[2], 1.0 if q[3] > ELBOW_FLIP else -1.0
