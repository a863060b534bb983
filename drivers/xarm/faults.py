"""Faults of a UFACTORY arm, with cause and remedy."""

from __future__ import annotations

from hal.errors import Fault

from .sdk import ControllerErrorCodeMap, ControllerWarnCodeMap, GripperErrorCodeMap

POSITION, SERVO, MANUAL = 0, 1, 2
"""Modes: position control, servo motion, joint teaching (the arm is moved by hand)."""
MOVING, READY, PAUSED, STOPPED, CHANGED = 1, 2, 3, 4, 5
"""States: in motion; at rest, takes commands; paused; stopped; its mode or its settings were changed."""

_PATH = "look where the arm is, and slow down or plan another path"
_BOUNDARY = "move the arm back by hand (UFACTORY Studio, Live Control, Manual Mode)"
_MOTOR = "restart the control box with its emergency stop; if that does not help, ask UFACTORY"
_ERRORS = {
    1: ("the emergency stop of the control box is pressed", "release the button"),
    2: ("the emergency input of the control box is open", "close both EI inputs"),
    3: ("the emergency stop of the three-state switch is pressed", "release the button"),
    10: ("a motor has an error", _MOTOR),
    **{10 + k: (f"the motor of joint {k} has an error", _MOTOR) for k in range(1, 8)},
    22: ("the arm is about to collide with itself", _PATH),
    23: ("a joint is beyond its limit", _BOUNDARY),
    24: ("the speed exceeds the controller's limit: 180 degrees/s of a joint, 1 m/s of the tcp", _PATH),
    31: (
        "collision: the motors' currents are not as expected",
        "look for the cause, clear the way; check the payload (real.load), and the collision sensitivity",
    ),
    35: ("the arm is at the safety boundary of the controller", _BOUNDARY),
    60: ("the linear speed exceeds the limit of servo mode", _PATH),
}
_LOOK_UP = "look it up in UFACTORY Studio"


def error_fault(number: int) -> Fault:
    """Return the fault of an error of the controller, ``C`` and its number; of most the words are the SDK's."""
    known = ControllerErrorCodeMap.get(number, {}).get("en", {})
    theirs = known.get("title", "an error that the SDK does not know"), known.get("desc") or _LOOK_UP
    cause, remedy = _ERRORS.get(number, theirs)
    return Fault(f"C{number}", f"{cause} (error {number})", remedy)


def describe_warning(number: int) -> str:
    """Return the meaning of a warning of the controller, which stops nothing."""
    known = ControllerWarnCodeMap.get(number, {}).get("en", {})
    return f"W{number}: {known.get('title', 'a warning that the SDK does not know')}"


def gripper_fault(number: int) -> Fault:
    """Return the fault of an error of the gripper, ``G`` and its number."""
    title = GripperErrorCodeMap.get(number, GripperErrorCodeMap["other"])["en"]["title"]
    return Fault(f"G{number}", f"{title} (error {number})", "look for what blocks the fingers; then gripper.home()")


NO_GRIPPER = Fault(
    "no_gripper",
    "the gripper does not answer through the control box",
    "check its plug at the flange, end the arm's error C19 by recover(); give the command again",
)
STOP = Fault(
    "STOPPED",
    "the arm was stopped, or its motors were switched off, by UFACTORY Studio or another program",
    "find out who stopped it",
)
PAUSE = Fault("PAUSED", "another program paused the arm", "find out which; stop it in UFACTORY Studio")
OTHER_MODE = Fault(
    "OTHER_MODE", "another program, or UFACTORY Studio, took over: the arm is in another mode", "end the other program"
)
BUSY = Fault("BUSY", "another program moves the arm", "end it, then open the session again")
MANUAL_MODE = Fault("MANUAL_MODE", "the arm is in manual mode, so somebody may be holding it", "switch manual mode off")
NOT_STARTED = Fault("NOT_STARTED", "the arm did not get ready for set-points", "look at it in UFACTORY Studio")
NOT_FOLLOWING = Fault(
    "NOT_FOLLOWING",
    "the arm is not where its set-points are: it is held back, or another program sends set-points as well",
    "look for an obstacle, and end other programs",
)
SILENT = Fault("SILENT", "the controller does not answer any more", "check the cable and that the controller is on")
NO_CONTROLLER = Fault("NO_CONTROLLER", "it does not answer", "check real.host, the cable, the subnet, and firewalls")


def find_occupant(mode: int, state: int, moving: bool) -> Fault | None:
    """Return why an arm that is not ours must be left alone.

    Args:
        mode: Its mode.
        state: Its state.
        moving: Whether its joints move.
    """
    if mode == MANUAL and state not in (STOPPED, CHANGED):
        return MANUAL_MODE
    if state == PAUSED:
        return PAUSE
    return BUSY if moving or (state == MOVING and mode != SERVO) else None
