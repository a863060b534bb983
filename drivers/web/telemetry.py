"""The state of the rig for the pages, read from the memory that the hosts publish into."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hal.commands import DeadmanRecord
from hal.errors import Fault
from hal.host.records import GripperMail, GroupMemory, RobotMail
from hal.types import RobotStatus, Trip

_MAX_AGE = 0.1
"""A state older than this is not shown, in s; the same limit as that of ``robot.state()``."""
_GRIPPER_MAX_AGE = 0.5
"""The same for a gripper, in s; as ``gripper.state()``."""
_DIGITS = 5


def round_number(value: float) -> float | None:
    """Return a number rounded for a page, to 10 um or 10 urad; None if it is not finite."""
    return round(value, _DIGITS) if math.isfinite(value) else None


class Telemetry:
    """Reads the mailboxes of every group; writes nothing and waits for no one."""

    def __init__(self, hosts: Sequence[Mapping[str, Any]], memories: Sequence[memoryview]) -> None:
        """Open the memory of each of ``hosts``, which are as in the process's configuration."""
        self._hosts = hosts
        self._groups = [
            GroupMemory(memory, [(str(name), int(n)) for name, n in host["joints"]], host["grippers"])
            for host, memory in zip(hosts, memories, strict=True)
        ]
        mails = {name: mail for group in self._groups for name, mail in group.grippers.items()}
        self._grippers = {str(arm): mails[name] for host in hosts for arm, name in host["gripper_of"].items()}

    def snapshot(self, now: float) -> dict[str, Any]:
        """Return the state of all robots and hosts as JSON; ``now`` in s, on the hosts' clock."""
        robots: dict[str, Any] = {}
        hosts: dict[str, Any] = {}
        for host, group in zip(self._hosts, self._groups, strict=True):
            record = group.get_host()
            hosts[host["name"]] = {
                "rate_hz": host["rate_hz"],
                "ticks": record.ticks,
                "missed": record.missed,
                "silent": round_number(now - record.t) if record.ticks or record.ready else None,
            }
            for name, mail in group.robots.items():
                robots[name] = _robot(mail, self._grippers.get(name), now)
        return {"robots": robots, "hosts": hosts}


def _robot(mail: RobotMail, gripper: GripperMail | None, now: float) -> dict[str, Any]:
    state = mail.get_state()
    if state is None:
        return {"lost": "no state received yet"}
    age = now - state.stamp.t
    if state.status is RobotStatus.LOST:
        reason = f": {state.fault.cause}" if state.fault is not None else ""
        return {"lost": f"it does not answer{reason} (last state {age:.1f} s old)"}
    if not age <= _MAX_AGE:
        return {"lost": f"last state {age:.1f} s old"}
    return {
        "t": state.stamp.t,
        "age": round_number(age),
        "status": str(state.status),
        "trip": str(state.trip),
        "trip_text": state.trip.text if state.trip is not Trip.NONE else "",
        "limited": str(state.limited),
        "fault": _fault(state.fault),
        "q": _list(state.q),
        "q_set": _list(state.q_set),
        "dq": _list(state.dq),
        "tcp": _list(state.tcp.position) + _list(state.tcp.orientation),
        "speed": round_number(math.hypot(*state.tcp_twist[:3])),
        "force": None if state.wrench_ext is None else round_number(math.hypot(*state.wrench_ext[:3])),
        "gripper": _gripper(gripper, now),
        "deadman": _deadman(mail.get_deadman(), now),
    }


def _fault(fault: Fault | None) -> dict[str, str] | None:
    return None if fault is None else {"code": fault.code, "cause": fault.cause, "remedy": fault.remedy}


def _gripper(mail: GripperMail | None, now: float) -> dict[str, Any] | None:
    """Return None if there is no gripper, or no recent state: its process may be gone while the arm still runs."""
    record = mail.get() if mail is not None else None
    if record is None or not now - record.state.stamp.t <= _GRIPPER_MAX_AGE:
        return None
    state = record.state
    return {
        "width": round_number(state.width),
        "width_target": round_number(state.width_target),
        "moving": state.moving,
        "grasped": state.grasped,
    }


def _deadman(record: DeadmanRecord | None, now: float) -> dict[str, Any] | None:
    if record is None:
        return None
    return {"held": record.held, "connected": record.connected, "age": round_number(now - record.t_alive)}


def _list(values: Any) -> list[float | None]:
    return [round_number(value) for value in values.tolist()]
