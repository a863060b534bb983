"""A driver on a bench as an app sees it: the host's own code around it, and the public class in front."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

from .. import registry
from ..clock import LockStepClock
from ..gripper import Gripper
from ..host.cycle import ArmUnit
from ..host.gripper_unit import GripperUnit
from ..host.hosts import Host
from ..host.records import AppRecord, GroupMemory
from ..robot import Robot
from ..specs import GroupSpec, RobotSpec
from ..types import GripperState, RobotState
from .benches import GripperBench, RobotBench


class _BenchHost(Host):
    """A host whose cycles the checks run themselves."""

    def __init__(self, spec: GroupSpec) -> None:
        super().__init__()
        self.spec = spec
        self.memory = GroupMemory.of(memoryview(bytearray(GroupMemory.size_of(spec))), spec)

    def request(self, method: str, params: dict[str, Any] | None = None) -> Any:
        raise NotImplementedError(f"a bench has no request {method}")

    def check(self) -> None:
        """Do nothing: it never ends."""

    def close(self) -> None:
        """Do nothing: the checks close what they opened."""


class HostedRobot:
    """An arm: the host's unit around the driver, and the public :class:`~hal.robot.Robot` in front of it.

    ``with HostedRobot(bench) as hosted`` opens the driver, and closes it.
    """

    def __init__(self, bench: RobotBench) -> None:
        self.bench = bench
        self._folder = TemporaryDirectory()
        spec = _add_kinematics(bench.driver.spec, Path(self._folder.name))
        clock = "real_time" if bench.real_time else "lock_step"
        host = _BenchHost(GroupSpec("bench", clock, 1.0 / bench.dt, (spec,)))
        with patch.object(registry, "load", lambda name, kind: lambda spec, world: bench.driver):
            self.unit = ArmUnit(spec, bench.dt, host.memory.robots[spec.name], None)
        self.robot = Robot(spec, host, LockStepClock(lambda: bench.now, self._advance_to))

    def run_cycles(self, cycles: int) -> RobotState:
        """Run cycles of the host, and return the state that the app sees; raises what the app's ``state()`` raises."""
        for _ in range(cycles):
            self._run_cycle()
        return self.robot.state()

    def _run_cycle(self) -> None:
        unit, now = self.unit, self.bench.pass_time()
        app = AppRecord(now, 0)
        unit.read(now)
        unit.tick(now, app)
        unit.write(now)
        unit.finish_session()
        unit.publish(now)

    def _advance_to(self, t: float) -> None:
        while self.bench.now < t:
            self._run_cycle()

    def __enter__(self) -> HostedRobot:
        self.unit.open(self.bench.pass_time())
        return self

    def __exit__(self, *_: object) -> None:
        self.unit.close()
        self._folder.cleanup()


class HostedGripper:
    """A gripper: the host's unit around the driver, and the public :class:`~hal.gripper.Gripper` in front of it.

    A call that waits for the gripper advances the bench's time.
    """

    def __init__(self, bench: GripperBench) -> None:
        spec = bench.driver.spec
        clock = "real_time" if bench.real_time else "lock_step"
        self.bench = bench
        self.host = _BenchHost(GroupSpec("bench", clock, 1.0 / bench.dt, (), grippers=(spec,)))
        self.unit = GripperUnit(bench.driver, self.host.memory.grippers[spec.name])
        self.gripper = Gripper(spec, "bench", self.host, LockStepClock(lambda: bench.now, self._advance_to))

    def run_for(self, seconds: float) -> GripperState:
        """Run the host for ``seconds``, and return the state that the app sees; raises what its ``state()`` raises."""
        for _ in self.bench.turns(seconds):
            self._run_cycle()
        return self.gripper.state()

    def _run_cycle(self) -> None:
        now = self.bench.pass_time()
        self.unit.serve(now, AppRecord(now, self.host.latch.stops))
        self.unit.publish(now)

    def _advance_to(self, t: float) -> None:
        while self.bench.now < t:
            self._run_cycle()

    def __enter__(self) -> HostedGripper:
        self.unit.open()
        self.run_for(self.bench.dt)
        return self

    def __exit__(self, *_: object) -> None:
        self.unit.close()


def _add_kinematics(spec: RobotSpec, folder: Path) -> RobotSpec:
    """Return the spec, with a planar chain of 0.2 m links as its URDF if it names none."""
    if spec.kinematics.urdf:
        return spec
    file = folder / "arm.urdf"
    file.write_text(_chain_urdf(spec), encoding="utf-8")
    tip = f"link{len(spec.joints)}"
    return replace(spec, urdf=str(file), kinematics=replace(spec.kinematics, urdf=str(file), tcp_link=tip))


def _chain_urdf(spec: RobotSpec) -> str:
    limits = spec.limits
    parts = ['<robot name="chain"><link name="link0"/>']
    for k, name in enumerate(spec.joints):
        parts.append(
            f'<link name="link{k + 1}"/><joint name="{name}" type="revolute"><parent link="link{k}"/>'
            f'<child link="link{k + 1}"/><origin xyz="0.2 0 0"/><axis xyz="0 0 1"/><limit lower="{limits.lower[k]}" '
            f'upper="{limits.upper[k]}" velocity="{limits.velocity[k]}" effort="100"/></joint>'
        )
    return "".join(parts) + "</robot>"
