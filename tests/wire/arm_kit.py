"""An emulated arm without a network: tests pass requests and commands, and read answers and states."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import nan

from hal.config.data_files import find_data
from hal.drivers.franka.limits import LIMITS
from hal_emulators.franka.arm import ArmReply, EmulatedArm, RequestHandler, RobotFiles
from hal_emulators.franka.journal import Journal
from hal_emulators.franka.plant import IdealPlant, Plant, RigidBody
from hal_emulators.franka.protocol import PROTOCOLS, STATE, CommandPacket, Controller, Generator

HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
URDF = find_data("robots", "fr3.urdf")
ZERO = (0.0,) * 7


class Bench:
    """An arm and its client."""

    def __init__(self, version: int = 10, plant: Plant | None = None, library: bytes = b"") -> None:
        self.version = version
        self.journal = Journal(quiet=True)
        self.replies: list[ArmReply] = []
        self.plant = plant or IdealPlant(RigidBody(URDF), HOME)
        limits = LIMITS["fr3" if version == 10 else "fer"]
        self.arm = EmulatedArm(PROTOCOLS[version], limits, self.plant, self.journal, send=self.replies.append)
        self.requests = RequestHandler(self.arm, RobotFiles(b"<robot/>", library))

    def ask(self, name: str, payload: bytes = b"") -> int:
        """Send a request; return the status of its answer, after the next cycle if necessary."""
        before = len(self.replies)
        self.requests.handle(name, 7, payload)
        if len(self.replies) == before:
            self.idle()
        return self.replies[before].body[0]

    def move(self, generator: Generator = Generator.JOINT_POSITION, external: bool = False) -> int:
        """Request a motion."""
        controller = Controller.EXTERNAL if external else Controller.JOINT_IMPEDANCE
        payload = struct.pack("<II6d", controller, generator, *[1.0] * 6)
        return self.ask("Move", payload + (bytes(57) if self.version == 10 else b""))

    def idle(self, cycles: int = 1) -> None:
        """Run cycles without a command."""
        for _ in range(cycles):
            self.arm.tick(None)

    def command(
        self,
        q: Sequence[float] | None = None,
        dq: Sequence[float] = ZERO,
        tau: Sequence[float] = ZERO,
        finished: bool = False,
    ) -> None:
        """Run one cycle with a command."""
        position = tuple(q) if q is not None else (nan,) * 7 if finished else tuple(self.arm.sample.q)
        self.arm.tick(CommandPacket(self.arm.message_id, position, tuple(dq), tuple(tau), finished))

    def state(self, name: str) -> tuple[float, ...]:
        """Return a field of the state packet, after another cycle."""
        packet = bytes(self.arm.tick(None))
        field = STATE[self.version].fields[name]
        values: tuple[float, ...] = struct.unpack_from(f"<{field.values}{field.kind}", packet, field.offset)
        return values

    def speed_up(self, cycles: int = 50) -> None:
        """Joint 1 from rest to 5 rad/s2 times so many milliseconds."""
        acceleration = 0.0
        speed = 0.0
        for _ in range(cycles):
            acceleration = min(5.0, acceleration + 4.0)
            speed += acceleration * 1e-3
            self.command(dq=(speed, *ZERO[1:]))
