"""One cycle of a group of devices: advance, read all, tick each servo, write all, publish.

The same code runs in a process of its own in real time (:mod:`hal.host.main`) and in the caller's process in
lock-step (:mod:`hal.host.hosts`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .. import registry
from ..commands import Session
from ..driver import RobotDriver
from ..errors import DeviceNotFound, NotSupported
from ..specs import GroupSpec
from .arm import ArmUnit
from .copies import copies_of
from .gripper_unit import GripperUnit
from .records import AppRecord, GroupMemory

__all__ = ["Cycle"]


class Cycle:
    """A group: its world, if it has one, its arms and its grippers."""

    def __init__(self, spec: GroupSpec, memory: GroupMemory, others: Iterable[GroupMemory] = ()) -> None:
        """``others``: memories of the rig's other groups, whose arms have copies in this group's world."""
        self.spec = spec
        self.memory = memory
        self._copies = copies_of(spec, others)
        self.dt = 1.0 / spec.rate_hz
        self.ticks = 0
        self.t = 0.0
        """Of the newest cycle, s on the group's clock."""
        self._counted_from = 0
        self.world: Any = None
        if spec.world is not None:
            # In real time, a process of its own draws a copy of the world.
            self.world = registry.load(spec.world.driver, "world")(spec.world, drawn=spec.clock == "lock_step")
        self.arms = {r.name: ArmUnit(r, self.dt, memory.robots[r.name], self.world) for r in spec.robots}
        self._units = tuple(self.arms.values())
        self.grippers: dict[str, GripperUnit] = {}
        for gripper in spec.grippers:
            driver = registry.load(gripper.driver, "gripper")(gripper, self.world)
            self.grippers[gripper.name] = GripperUnit(driver, memory.grippers[gripper.name])
        self._hands = tuple(self.grippers.values())

    @property
    def paces_itself(self) -> bool:
        """Does a device set the pace?"""
        return any(unit.driver.paces_itself for unit in self._units)

    @property
    def lost_cycles(self) -> int:
        """Cycles of the device that sets the pace of which this group saw nothing."""
        return sum(unit.lost_cycles for unit in self._units)

    @property
    def attended(self) -> bool:
        """Does something real move?"""
        return any(unit.spec.attended for unit in self._units)

    def looping_driver(self) -> RobotDriver | None:
        """A driver whose library wants to own the loop now."""
        return next((unit.driver for unit in self._units if unit.driver.wants_loop), None)

    def open(self, now: float) -> None:
        """Connect to every device and publish a first state. Nothing moves."""
        self.t = now
        for unit in self._units:
            unit.open(now)
        for hand in self._hands:
            hand.open()
        self.publish(now)

    def wait(self) -> None:
        """Block until the device that sets the pace has something new."""
        for unit in self._units:
            if unit.driver.paces_itself:
                unit.driver.wait()

    def step(self, now: float, app: AppRecord, late: bool = False) -> None:
        """One cycle. ``now`` is the time on the group's clock; ``late``: this process could not run for a while."""
        self.ticks += 1
        self.t = now
        if self.world is not None:
            for copy in self._copies:
                copy.follow(self.world)
            self.world.step()
        for unit in self._units:
            unit.read(now)
            unit.tick(now, app, late)
        for unit in self._units:
            unit.write(now)
            unit.finish_session()
            unit.prepare(app)
        for hand in self._hands:
            hand.serve(app)

    def publish(self, now: float) -> None:
        """Tell the app what every device reports."""
        for unit in self._units:
            unit.publish(now)
        for hand in self._hands:
            hand.publish(now)

    def stop_sessions(self) -> bool:
        """Bring every arm to rest; True when all of them are. Call it between steps until it is.

        Fingers are left alone: they keep what they hold.
        """
        resting = True
        for unit in self._units:
            if not unit.finish_session():
                unit.servo.end()
                resting = False
        return resting

    def request(self, method: str, params: dict[str, Any]) -> Any:
        """What the app asks for between two steps. Names: see the ``_do_`` methods and the world's requests."""
        if method.startswith("world."):
            return self._world_request(method.removeprefix("world."), params)
        handler = getattr(self, f"_do_{method}", None)
        if handler is None:
            raise NotSupported(f"no request {method!r}")
        return handler(**params)

    def _arm(self, robot: str) -> ArmUnit:
        if robot not in self.arms:
            raise DeviceNotFound(f"no robot {robot!r}; robots: {', '.join(self.arms)}")
        return self.arms[robot]

    def _do_begin(self, robot: str, session: list[Any]) -> None:
        fields = Session(*session)
        goal = tuple(fields.move_to) if fields.move_to is not None else None
        self._arm(robot).begin(fields._replace(move_to=goal), self.memory.get_app())

    def _do_recover(self, robot: str) -> None:
        self._arm(robot).recover()

    def _do_inject(self, robot: str, knobs: dict[str, Any]) -> None:
        self._arm(robot).driver.inject(**knobs)

    def _do_inject_gripper(self, gripper: str, knobs: dict[str, Any]) -> None:
        self.grippers[gripper].driver.inject(**knobs)

    def _do_warnings(self) -> list[str]:
        """What the simulation had to change in the files that it loaded."""
        return list(getattr(self.world, "warnings", ()))

    def _do_statistics(self) -> dict[str, Any]:
        return {
            "ticks": self.ticks - self._counted_from,
            "robots": {
                name: {
                    "peak": unit.audit.peaks(),
                    "latency_s": unit.latency.summary(),
                    "reanchored": unit.reanchored,
                    **unit.servo.statistics(),
                    "driver": unit.driver.statistics(),
                }
                for name, unit in self.arms.items()
            },
        }

    def _do_reset_statistics(self) -> None:
        self._counted_from = self.ticks
        for unit in self._units:
            unit.reset_statistics()

    def _world_request(self, method: str, params: dict[str, Any]) -> Any:
        if self.world is None:
            raise NotSupported("this rig has no simulated world; rig.world exists in simulation only")
        result = self.world.request(method, params)
        if method == "poses":
            result["t"] = self.t  # a world only counts its steps
        if method == "reset":
            name = params.get("name")
            for unit in self._units:
                if name is None or name == unit.spec.name:
                    unit.moved()
        return result

    def close(self) -> None:
        """Let go of every device. Idempotent."""
        errors = []
        for close in (*(unit.close for unit in self._units), *(hand.close for hand in self._hands)):
            try:
                close()
            except Exception as error:
                errors.append(error)
        if self.world is not None:
            self.world.close()
        if errors:
            raise errors[0]
