"""Driver of the Franka Hand: widths, grasps and homing, with the hand's client library in a process of its own."""

from __future__ import annotations

import importlib.util
import math
import time

from hal.driver import GripperDriver, GripperReading
from hal.errors import CommandError, ConnectionLost
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .hand_motions import GripperCall, HandAction, HandController, HandState, WidthRange, is_holding
from .hand_process import HandLink, LinkLost
from .settings import HandSettings

if importlib.util.find_spec("panda_py") is None:  # the hand's process imports it; report its absence at once
    raise ModuleNotFoundError("No module named 'panda_py'", name="panda_py")

_STATE_TIMEOUT = 1.0
"""s without a state after which the hand counts as not answering."""
_FIRST_STATE_TIMEOUT = 2.0
"""s until the first state must have arrived."""
_CLOSE_TIMEOUT = 0.5
"""s for moving fingers to stop before the connection is closed."""


class FrankaHand(GripperDriver):
    """A Franka Hand of an FR3 or a Panda.

    Opening uses the hand's ``move``, closing its ``grasp`` (:mod:`.hand_motions` explains why). An object that is met
    while closing is therefore held with the requested force: the outcome is ``MISSED``, and ``grasped`` is true.
    Fingers that hold an object, or rest, never get a stop, because the hand may release the object.

    No call blocks, except ``open`` and, for half a second at most, ``close``. Stops are monitored: a stop that is
    ignored, or that releases the object, is reported as a fault.
    """

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        settings = HandSettings.of(spec)
        self._host = settings.host
        self._range = WidthRange(spec.width_max, settings.tolerance)
        self._link = HandLink(spec.name, settings.host)
        self._controller = HandController(self._range)
        self._target = 0.0
        self._seq = 0
        self._is_open = False

    def open(self) -> None:
        """Connect, and wait for a first state. Nothing moves.

        Raises ConnectionLost if the hand cannot be reached, or sends no states, NotSupported for another protocol
        version.
        """
        if self._is_open:
            return
        self._controller = HandController(self._range)  # states from before a close are outdated
        self._link.open()
        self._is_open = True
        deadline = time.monotonic() + _FIRST_STATE_TIMEOUT
        while self._controller.state is None:
            if time.monotonic() > deadline:
                self.close()
                reason = self._link.reason or f"the hand at {self._host} sends no states"
                raise ConnectionLost(f"{self.spec.name}: {reason}", code="silent")
            time.sleep(0.005)
            self._process_events()
        self._target = self._controller.state.width

    def read(self, now: float) -> GripperReading:
        """Return the newest state. Raises ConnectionLost when the hand has sent none for a second."""
        offset = now - time.monotonic()  # before what follows, which may take some time
        self._process_events()
        state = self._fresh_state()
        controller = self._controller
        running = controller.outcome is GripperOutcome.RUNNING
        return GripperReading(
            t=state.t + offset,
            t_device=state.t_hand,
            seq=self._seq,
            width=state.width,
            width_target=self._target,
            moving=controller.moving,
            grasped=is_holding(state),
            outcome=controller.outcome,
            fault=controller.fault or (None if running else self._range.fault(state)),
        )

    def _fresh_state(self) -> HandState:
        state = self._controller.state
        assert state is not None
        age = time.monotonic() - state.t
        if age > _STATE_TIMEOUT:
            reason = f"; {self._link.reason}" if self._link.reason else ""
            text = f"{self.spec.name}: the hand at {self._host} has sent no state for {age:.1f} s{reason}"
            raise ConnectionLost(text, code="silent")
        return state

    def _require_open(self) -> None:
        """Raise ConnectionLost before :meth:`open`: the link would connect otherwise."""
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open", code="closed")

    def _process_events(self) -> None:
        """Process what has arrived from the hand, and send what is due. Raises ConnectionLost before :meth:`open`."""
        self._require_open()
        for event in self._link.poll():
            if isinstance(event, HandState):
                self._seq += 1
                self._controller.update(event)
            elif isinstance(event, LinkLost):
                self._controller.connection_lost(event)
            else:
                self._controller.call_ended(event, time.monotonic())
        action = self._controller.next_action(time.monotonic())
        if isinstance(action, GripperCall):
            self._link.call(action.method, action.arguments)
        elif action is HandAction.STOP:
            self._link.stop()
        elif action is HandAction.STOP_STRAY:
            self._link.stop_stray()
        elif action is HandAction.RECONNECT:
            self._link.restart("the hand did not end a motion in spite of a stop")

    # Commands.

    def move(self, width: float, speed: float, force: float) -> None:
        """Move the fingers to ``width`` (m), clipped to the hand's range, or until they meet an object."""
        self._check(width, speed, force)
        self._target = min(max(width, 0.0), self.spec.width_max)
        self._controller.move(self._target, min(speed, self.spec.speed), force)
        self._process_events()

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Close on an object and hold it. A hand that holds one already accepts only the same force."""
        self._check(width, speed, force, inner, outer)
        self._target = 0.0
        width = min(max(width, 0.0), self.spec.width_max)
        self._controller.grasp(width, min(speed, self.spec.speed), force, inner, outer)
        self._process_events()

    def home(self) -> None:
        """Measure how far the fingers open. Refused while the hand holds an object, which would fall."""
        self._check()
        self._target = self.spec.width_max
        self._controller.home()
        self._process_events()

    def stop(self) -> None:
        """Stop the fingers; without a connection, as soon as it is back. An object stays held."""
        self._require_open()
        self._controller.stop()
        self._process_events()

    def _check(self, *numbers: float) -> None:
        if not all(map(math.isfinite, numbers)):
            raise CommandError(f"{self.spec.name}: {numbers} are not all finite numbers")
        if len(numbers) > 1 and not (numbers[1] > 0.0 and numbers[2] > 0.0):
            raise CommandError(f"{self.spec.name}: speed and force must be positive, not {numbers[1]} and {numbers[2]}")
        self._process_events()
        self._fresh_state()
        if not self._link.up:
            raise ConnectionLost(
                f"{self.spec.name}: the connection to the hand at {self._host} is lost; {self._link.reason}"
            )

    def close(self) -> None:
        """Stop moving fingers, keep a grasp as it is, and disconnect. Idempotent."""
        if not self._is_open:
            self._link.close()
            return
        self._controller.stop()
        deadline = time.monotonic() + _CLOSE_TIMEOUT
        self._process_events()
        while self._controller.busy and time.monotonic() < deadline:
            time.sleep(0.005)
            self._process_events()
        self._is_open = False
        self._link.close()
