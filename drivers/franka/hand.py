"""The Franka Hand: widths, grasps and homing, with the hand's own client library in a process of its own."""

from __future__ import annotations

import importlib.util
import math
import time

from hal.driver import GripperDriver, GripperReading
from hal.errors import CommandError, ConnectionLost
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .hand_calls import Call, Seen
from .hand_errands import Range, is_holding
from .hand_link import HandLink, Lost
from .hand_pilot import HandPilot, Order
from .settings import HandSettings

if importlib.util.find_spec("panda_py") is None:  # imported in a process of its own, but missed here and now
    raise ModuleNotFoundError("No module named 'panda_py'", name="panda_py")

__all__ = ["FrankaHand"]

_SILENT = 1.0
"""s without a state after which the hand does not answer."""
_FIRST_STATE = 2.0
"""s in which the first state must come."""
_CLOSING = 0.5
"""s in which fingers that are on their way must stop before the connection is closed."""


class FrankaHand(GripperDriver):
    """A Franka Hand of an FR3 or a Panda.

    Opening is the hand's ``move``, closing its ``grasp`` (:mod:`.hand_errands` says why), so what a ``move`` of ours
    meets while it closes is held with the force that was asked for: ``MISSED``, and ``grasped``. Fingers that hold
    something, or rest, are never told to stop: this hand may let go for it.

    No call blocks, except ``open`` and, for half a second at most, ``close``. Stops are watched: a hand that ignores
    one, or lets go for one, is told as a fault.
    """

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        settings = HandSettings.of(spec)
        self._host = settings.host
        self._range = Range(spec.width_max, settings.tolerance)
        self._link = HandLink(spec.name, settings.host)
        self._pilot = HandPilot(self._range)
        self._target = 0.0
        self._seq = 0
        self._is_open = False

    def open(self) -> None:
        """Connect, and wait for a first state. Raises ConnectionLost, NotSupported; nothing moves."""
        if self._is_open:
            return
        self._pilot = HandPilot(self._range)  # what was seen before it was closed is old
        self._link.open()
        self._is_open = True
        deadline = time.monotonic() + _FIRST_STATE
        while self._pilot.seen is None:
            if time.monotonic() > deadline:
                self.close()
                raise ConnectionLost(
                    f"{self.spec.name}: {self._link.why or f'the hand at {self._host} sends no states'}"
                )
            time.sleep(0.005)
            self._pump()
        self._target = self._pilot.seen.width

    def read(self, now: float) -> GripperReading:
        """The newest state. Raises ConnectionLost when the hand has been silent for a second."""
        self._pump()
        seen = self._fresh()
        pilot = self._pilot
        running = pilot.outcome is GripperOutcome.RUNNING
        return GripperReading(
            t=now - (time.monotonic() - seen.t),
            t_device=seen.t_hand,
            seq=self._seq,
            width=seen.width,
            width_target=self._target,
            moving=pilot.moving,
            grasped=is_holding(seen),
            outcome=pilot.outcome,
            fault=pilot.fault or (None if running else self._range.trouble(seen)),
        )

    def _fresh(self) -> Seen:
        seen = self._pilot.seen
        assert seen is not None
        age = time.monotonic() - seen.t
        if age > _SILENT:
            why = f"; {self._link.why}" if self._link.why else ""
            raise ConnectionLost(f"{self.spec.name}: the hand at {self._host} has been silent for {age:.1f} s{why}")
        return seen

    def _pump(self) -> None:
        """Take what came, do what is due. Raises ConnectionLost before :meth:`open`: the link connects by itself."""
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open")
        for event in self._link.poll():
            if isinstance(event, Seen):
                self._seq += 1
                self._pilot.see(event)
            elif isinstance(event, Lost):
                self._pilot.lost(event)
            else:
                self._pilot.answer(event, time.monotonic())
        order = self._pilot.next_order(time.monotonic())
        if isinstance(order, Call):
            self._link.call(order.method, order.arguments)
        elif order is Order.STOP:
            self._link.stop()
        elif order is Order.RECONNECT:
            self._link.restart("the hand did not end a motion, though it was told to stop")

    # Commands.

    def move(self, width: float, speed: float, force: float) -> None:
        """Bring the fingers to ``width``, cut to what the hand can do, or onto what is between them."""
        self._check(width, speed, force)
        self._target = min(max(width, 0.0), self.spec.width_max)
        self._pilot.reach(self._target, min(speed, self.spec.speed), force)
        self._pump()

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Close on something and hold it. Where the hand holds already, only the same force is possible."""
        self._check(width, speed, force, inner, outer)
        self._target = min(max(width, 0.0), self.spec.width_max)
        self._pilot.grasp(self._target, min(speed, self.spec.speed), force, inner, outer)
        self._pump()

    def home(self) -> None:
        """Find out how far the fingers open. Refused while the hand holds something: that would fall."""
        self._check()
        self._target = self.spec.width_max
        self._pilot.home()
        self._pump()

    def stop(self) -> None:
        """Stay there; what is held stays held."""
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open")
        self._pilot.stop()
        self._pump()

    def _check(self, *numbers: float) -> None:
        if not all(map(math.isfinite, numbers)):
            raise CommandError(f"{self.spec.name}: {numbers} are not all numbers")
        if len(numbers) > 1 and not (numbers[1] > 0.0 and numbers[2] > 0.0):
            raise CommandError(f"{self.spec.name}: speed and force must be positive, not {numbers[1]} and {numbers[2]}")
        self._pump()
        self._fresh()
        if not self._link.up:
            raise ConnectionLost(
                f"{self.spec.name}: the connection to the hand at {self._host} is lost; {self._link.why}"
            )

    def close(self) -> None:
        """Stop fingers that are on their way, leave alone what holds, and hang up. Idempotent."""
        if not self._is_open:
            self._link.close()
            return
        self._pilot.stop()
        deadline = time.monotonic() + _CLOSING
        self._pump()
        while self._pilot.busy and time.monotonic() < deadline:
            time.sleep(0.005)
            self._pump()
        self._is_open = False
        self._link.close()
