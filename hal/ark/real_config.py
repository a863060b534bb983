"""``real_config`` of Ark's robots: addresses, and speeds where they are slow. Nothing becomes real by it."""

from __future__ import annotations

from typing import Any

from ..specs import GripperSpec
from .ledger import Ledger
from .reading import Node, Reading
from .text import Commented, Inline, Remark

__all__ = ["import_real"]

MOST_SPEED = 0.3
"""The share of the joint speeds that an import may ask for: the rig's default. A person may write more."""


def import_real(node: Node, key: str, hand: GripperSpec | None, reading: Reading, ledger: Ledger) -> dict[str, Any]:
    """What a robot of Franka's has besides; ``node`` is its ``config``, ``key`` where it stands in the rig."""
    entries: dict[str, Any] = {
        "#workspace": Remark(
            "workspace: {table_height: 0.01}    # m over the base: Ark has no such bound, a real arm should"
        )
    }
    real = node.get("real_config")
    if real is None:
        entries["#real"] = Remark("real: {host: 172.16.0.2}            # the robot's address, for --real")
        return entries
    reading.keys(real)
    host, own = real.get("robot_ip"), real.get("gripper_ip")
    gripper: dict[str, Any] = {}
    if host is not None:
        entries["real"] = Inline(host=reading.text(host))
        ledger.kept(host, f"{key}.real.host")
    if own is not None and host is not None and own.data == host.data:
        ledger.kept(own, f"{key}.real.host", "a hand has the arm's, unless it is given its own")
    elif own is not None:
        gripper["real"] = Inline(host=reading.text(own))
        ledger.kept(own, f"{key}.gripper.real.host")
    share = real.get("relative_dynamics_factor")
    if share is not None and reading.number(share, positive=True) <= MOST_SPEED:
        entries["speed"] = Commented(share.data, "Ark's relative_dynamics_factor")
        ledger.changed(share, f"{key}.speed", "share of the joint speeds, for commands; move_speed stays")
    else:
        ledger.changed(share, "", f"{key}.speed stays {MOST_SPEED:g} of the joint speeds: more is for you to write")
    speed = real.get("gripper_speed")
    if speed is not None and hand is not None:
        if reading.number(speed, positive=True) <= hand.speed:
            gripper["speed"] = speed.data
            ledger.kept(speed, f"{key}.gripper.speed")
        else:
            ledger.changed(speed, "", f"{hand.speed:g} m/s, the most that the hand can do")
    if gripper:
        entries["gripper"] = gripper
    return entries
