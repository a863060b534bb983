"""Faults of a UR arm, with cause and remedy."""

from __future__ import annotations

from hal.errors import Fault

RUNNING = 7
"""``robot_mode`` of an arm whose power is on and whose brakes are released."""
STOPPED, PLAYING = 1, 2
"""``runtime_state`` of a controller that runs no program, and of one that does; otherwise it is paused, or changes."""
PROTECTIVE_STOP = 3
"""``safety_mode``"""
UNLOCK_AFTER = 5.0
"""Time after a protective stop from which the controller unlocks it, s."""

_MODES = {-1: "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "power off", 4: "power on"}
_MODES |= {5: "brakes on (idle)", 6: "backdrive", 8: "updating firmware"}
_ON = "on the pendant switch the arm on and release its brakes"

SAFETY = {
    PROTECTIVE_STOP: Fault(
        "PROTECTIVE_STOP",
        "protective stop: a collision, a limit, or a set-point that jumped (the pendant's log has the code, as C153)",
        f"look for the cause, clear the way, wait {UNLOCK_AFTER:g} s",
    ),
    4: Fault("RECOVERY_MODE", "a joint is beyond a safety limit (recovery mode)", "move it back with the pendant"),
    5: Fault("SAFEGUARD_STOP", "safeguard stop: a light curtain or a door", "close it, reset it"),
    6: Fault("EMERGENCY_STOP", "emergency stop of the system", f"release it; {_ON}"),
    7: Fault("EMERGENCY_STOP", "emergency stop", f"release the button; {_ON}"),
    8: Fault("SAFETY_VIOLATION", "violation of a safety limit", f"restart the safety system on the pendant; {_ON}"),
    9: Fault("SAFETY_FAULT", "fault of the safety system", "see the pendant's log; restart the controller"),
}
"""``safety_mode`` -> its fault. 1 is normal, 2 reduced."""


def safety_fault(mode: int) -> Fault | None:
    """Return the fault of a ``safety_mode``: any other than normal and reduced is one."""
    return (
        None if mode in (1, 2) else SAFETY.get(mode) or Fault("SAFETY_STOP", f"safety mode {mode}", "see the pendant")
    )


LOCAL = Fault(
    "LOCAL_CONTROL",
    "the controller is in local control, so it takes no program from the network",
    "on the pendant choose Remote Control (switched on under Settings, System)",
)
OTHER_PROGRAM = Fault(
    "OTHER_PROGRAM",
    "another program is running on the controller",
    "stop it on the pendant, or end the other client, then open the session again",
)
REGISTERS_TAKEN = Fault(
    "REGISTERS_TAKEN",
    "another client has the RTDE input registers: a second program, or a fieldbus (EtherNet/IP, PROFINET, MODBUS)",
    "end it, or set real.upper_registers: true",
)
NOT_STARTED = Fault(
    "NOT_STARTED", "the control program did not start", "look at the pendant's log; check that port 30002 is open"
)
WATCHDOG = Fault(
    "WATCHDOG",
    "the controller heard nothing in time, and its watchdog ended the control program",
    "check the network and what else this computer runs",
)
PROGRAM_STOPPED = Fault(
    "PROGRAM_STOPPED",
    "the control program was stopped: on the pendant, or by another client",
    "find out who stopped it",
)
NOT_FOLLOWING = Fault(
    "NOT_FOLLOWING",
    "the controller does not follow its set-points",
    "look at the pendant for a limit or a scaled speed",
)
NO_DASHBOARD = Fault("NO_DASHBOARD", "its dashboard does not answer", "on the pendant allow the dashboard (Services)")
SILENT = Fault("SILENT", "the controller sends no states any more", "check the cable and that the controller is on")
NO_CONTROLLER = Fault("NO_CONTROLLER", "it does not answer", "check real.host, the cable, the subnet, and firewalls")


def mode_fault(mode: int) -> Fault:
    """Return the fault of a ``robot_mode`` in which the arm cannot move."""
    return Fault("NOT_RUNNING", f"the arm is not ready: {_MODES.get(mode, f'mode {mode}')}", _ON)


def scaling_fault(share: float, slider: bool) -> Fault:
    """Return the fault of a controller that scales speeds, so that set-points would run away from the arm."""
    if slider:
        cause = f"the speed slider is at {100 * share:.0f} %: the controller would follow set-points too slowly"
        return Fault("SPEED_SLIDER", cause, "set the slider to 100 % (limit speeds in the rig)")
    cause = f"the controller scales its speed to {100 * share:.0f} %"
    return Fault("SPEED_SCALED", cause, "stay farther from its safety limits")
