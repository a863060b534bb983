"""The emulators' side of the world that they share: what an emulated arm tells it and learns of it, and its program."""

from __future__ import annotations

import contextlib
import math
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hal.config.loader import load
from hal.drivers.scene.shared import Connection, address_of
from hal.errors import ConnectionLost
from hal.specs import Plan, RobotSpec

PRIORITY = 40
"""Of an emulator among SCHED_FIFO threads; a host has 50."""

_PERIOD = 0.004
"""Time between two reports of an arm, s."""
_START = 60.0
"""Longest time that the program of the world takes to get ready, s: the first time it reads large meshes."""
_END = 5.0
"""Longest time that it takes to end, s."""
_LEAD = 0.03
"""Time, s, by which an arm's fingers may be ahead of the world, whose messages take about 0.01 s."""
_AT_REST = 4e-6
"""Motion of a joint between two reports, rad, below which the arm counts as being at rest."""


class ArmInWorld:
    """An emulated arm in the world that its rig's emulators share.

    Attributes:
        fingers: Time of its fingers, s, their width, m, and the force with which they press on what is between them,
            N. Set by the emulator.
        object_width: Width at which an object stops the fingers, m; None if nothing is between them.
    """

    def __init__(self, address: str, name: str, role: str = "arm") -> None:
        """Enter the world; with the role ``fingers`` as the gripper of that arm, which has an emulator of its own.

        Raises ConnectionLost if there is no such world, ValueError if it has no arm of this name; lists those that it
        has.
        """
        self.fingers: tuple[float, float, float] | None = None
        connection, answer = Connection.connect(address, _START, role=role, name=name)
        connection.sock.setblocking(False)
        self._connection: Connection | None = connection
        self.object_width: float | None = answer["object"]
        self._reached: float = answer["t"]
        """Time that the world has reached, s; infinite once it is lost."""
        self._t = time.monotonic()
        """Time of the arm, s: it falls behind where the emulator is late, so that no motion in the world is faster."""
        self._due = self._t
        self._q: list[float] = []

    @property
    def now(self) -> float:
        """Time of the arm, s; what comes from its client is for this time."""
        return self._t

    @property
    def now_of_fingers(self) -> float:
        """Time of the fingers, s: that of the arm, but hardly ahead of the world, which is late on a busy computer.

        Fingers that close before the world's arm has come to the object would miss it.
        """
        return min(self._t, self._reached + _LEAD)

    def exchange(self, dt: float, q: Sequence[float]) -> None:
        """Report the joint positions (n,), rad, after a cycle of ``dt`` s, and take what the world says."""
        self._t += dt
        if self._connection is None or self._t < self._due:
            return
        before, self._q = self._q, [float(x) for x in q]
        if all(abs(a - b) < _AT_REST for a, b in zip(self._q, before, strict=False)):
            self._t = max(self._t, time.monotonic())
        self._due = self._t + _PERIOD
        try:
            self._connection.send({"t": self._t, "q": self._q, "fingers": self.fingers})
            answer = self._connection.receive_newest()
        except ConnectionLost as error:  # nothing is between the fingers any more
            self.close()
            print(f"warning: {error}; until then the fingers meet no objects", file=sys.stderr, flush=True)
            return
        if answer is not None:
            self.object_width, self._reached = answer["object"], answer["t"]

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection, self.object_width, self._reached = None, None, math.inf


def raise_priority(priority: int) -> None:
    """Run this thread, and those that it starts, before all that are not real-time, where that is allowed."""
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def load_real(config: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> Plan:
    """Return a rig with everything real; arms without ``real`` beside leaders, or with a real gripper, are simulated.

    Raises ConfigError.
    """
    rig = load(config, overrides=overrides)
    others = {name: rig.leaders or arm.gripper.sim is False for name, arm in rig.robots.items() if not arm.real}
    bare = [f"robots.{name}.sim=true" for name, there in others.items() if there]
    return load(config, sim=False, overrides=[*overrides, *bare]).resolve()


def has_world(config: str, overrides: Sequence[str] = ()) -> bool:
    """Return whether a rig has a simulated world in which all arms are emulated. Raises ConfigError."""
    world = load_real(config, overrides).world
    if world is None or not world.robots:
        return False
    return all(robot.emulated and robot.driver != world.driver for robot in world.robots)


@contextlib.contextmanager
def run_world(config: str, overrides: Sequence[str] = ()) -> Iterator[None]:
    """Run the world of a rig in a process of its own, unless another emulator runs it. Raises ValueError."""
    words = [word for value in overrides for word in ("--set", value)]
    command = [sys.executable, "-m", "hal_emulators.world", "--config", config, *words]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            if not select.select([process.stdout], [], [], _START)[0]:
                raise ValueError(f"the program of the world is not ready within {_START:g} s")
            line = process.stdout.readline().strip()
            if line not in ("ready", "shared"):
                raise ValueError(line.removeprefix("error: ") or "the program of the world ended")
            yield
        finally:
            process.stdin.close()  # it ends
            try:
                process.wait(_END)
            except subprocess.TimeoutExpired:
                process.kill()


def find_address(arm: RobotSpec) -> str:
    """Return the address of an emulated arm: that of ``localhost`` as a number."""
    host = str(arm.options.get("host"))
    return "127.0.0.1" if host.removesuffix(".").lower() == "localhost" else host


def find_arm(config: str, overrides: Sequence[str], driver: str, host: str) -> RobotSpec:
    """Return the arm of a rig that has this driver and address. Raises ConfigError, and ValueError if none has."""
    rig = load_real(config, overrides)
    arm = next((arm for arm in rig.robots if arm.driver == driver and find_address(arm) == host), None)
    if arm is None:
        raise ValueError(f"{config} has no {driver} at {host}: change --host, or --set robots.NAME.real.host")
    return arm


def enter_world(
    stack: contextlib.ExitStack, config: str, overrides: Sequence[str], arm: RobotSpec, role: str = "arm"
) -> ArmInWorld:
    """Return the place of an arm in the simulated world of its rig, which is run until the stack is closed.

    Raises ConfigError, and ConnectionLost and ValueError if its world does not start, or has no such arm.
    """
    stack.enter_context(run_world(config, overrides))
    raise_priority(PRIORITY)  # of an arm that is late, the world and its pictures are late; the world inherits none
    world = ArmInWorld(address_of(arm), arm.name, role)
    stack.callback(world.close)
    return world
