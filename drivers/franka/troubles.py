"""What the texts of libfranka's exceptions mean, apart from flags and versions.

Each text was seen from the libraries themselves, in the words of libfranka 0.9 (Panda) and 0.21 (FR3):
``tests/unit/drivers/franka/test_franka_faults.py`` raises them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from hal.types import Fault

__all__ = ["NO_HAND", "NO_WAY", "REFUSED", "TROUBLES", "UNKNOWN_HOST", "UNREACHABLE", "Trouble"]


@dataclass(frozen=True)
class Trouble:
    """One thing that can go wrong, and how libfranka says it."""

    says: str
    """A regular expression."""
    code: str
    cause: str
    """With ``{where}`` for the address, where that is known."""
    remedy: str
    lost: bool = False
    """Is the connection gone?"""

    def fault(self, where: str) -> Fault:
        """As a fault; ``where`` is the address, or who it is."""
        return Fault(self.code, self.cause.format(where=where), self.remedy.format(where=where))

    @staticmethod
    def in_text(text: str) -> Trouble | None:
        """What a text of the library means; None where it is none of these."""
        return next((trouble for trouble in TROUBLES if re.search(trouble.says, text)), None)


_CABLE = "see that the robot is switched on, and that the cable goes to Control's LAN port, not to the arm's base"

REFUSED = Trouble(
    "Connection to FCI refused",
    "refused",
    "{where} refuses: FCI is not active, another program holds the robot, or this is no robot",
    "in Desk, unlock the joints and activate FCI; end other programs that use this arm",
    lost=True,
)
UNREACHABLE = Trouble(
    "Connection timeout",
    "unreachable",
    "nobody answers at {where}",
    f"{_CABLE}; compare the address with the one in Desk (Settings, Network)",
    lost=True,
)
UNKNOWN_HOST = Trouble(
    "Host not found",
    "unknown_host",
    "there is no computer called {where}",
    "write the robot's address in numbers, such as real: {{host: 172.16.0.2}}",
    lost=True,
)
NO_WAY = Trouble(
    "Connection error",
    "no_way",
    "no network of this computer leads to {where}",
    "give a network port of this computer an address beside the robot's, such as 172.16.0.1/24",
    lost=True,
)
NO_HAND = Trouble(
    REFUSED.says,
    "no_hand",
    "{where} refuses: there is no hand, or the robot does not know of it",
    "connect the hand and choose it in Desk as the end effector; for an arm without one, gripper: {{enabled: false}}",
    lost=True,
)
"""What a refusal means at the hand's port."""

TROUBLES = (
    # The network.
    REFUSED,
    UNREACHABLE,
    UNKNOWN_HOST,
    NO_WAY,
    Trouble(
        "UDP receive: Timeout",
        "silent",
        "the robot has sent no state for 1 s ({where})",
        f"{_CABLE}; if it never sent one, a firewall may block UDP (sudo iptables -L)",
        lost=True,
    ),
    Trouble(
        r"TCP connection got interrupted|server closed connection|TCP send|Net Exception|UDP (send|receive)",
        "closed",
        "the robot ended the connection ({where}): it restarts, or FCI was switched off in Desk",
        "wait until it has started, and activate FCI in Desk",
        lost=True,
    ),
    Trouble(
        "incorrect object size|incorrect model library|Unexpected response|protocol error",
        "packets",
        "the robot's packets are not what the library expects ({where})",
        "bring the robot's system up to date; pip install -U 'robot-hal[franka]'",
        lost=True,
    ),
    Trouble(
        "position_based_velocity_limits|parse URDF|[Uu]rdf",
        "model",
        "the library cannot read the model that the robot sends of itself",
        "bring the robot's system up to date; pip install -U 'robot-hal[franka]'",
        lost=True,
    ),
    # What stops a motion, or keeps it from starting.
    Trouble(
        "User Stop pressed",
        "user_stopped",
        "the user stop was pressed; the joints hold by themselves",
        "see that nobody is in the arm's way, then release the user stop (the external activation device)",
    ),
    Trouble(
        "safety function",
        "safety_rule",
        "a safety rule of the robot forbids motions from outside",
        "in Desk, open Watchman and switch off, or delete, the rule that limits this motion",
    ),
    Trouble(
        "manual error recovery required",
        "manual_recovery",
        "the robot cannot clear this error by itself",
        "press the user stop and release it, or clear the error in Desk",
    ),
    Trouble(
        "aborted by reflex",
        "reflex",
        "the robot stopped by a reflex, and does not say why",
        "look at the message in Desk, and whether something touches the arm",
    ),
    Trouble(
        "singular pose",
        "singular",
        "the arm stands in a singular pose and cannot start there",
        "guide it by hand until its elbow is bent",
    ),
    Trouble(
        "invalid argument|invalid input|out of range",
        "invalid_argument",
        "the robot refused a number that it was given",
        "look at the numbers under real: in the rig's file",
    ),
    Trouble(
        "infinite or NaN",
        "not_a_number",
        "a set-point was not a number; nothing was sent",
        "this is a mistake in the program that commands the arm",
    ),
    Trouble(
        "preempted",
        "preempted",
        "another command ended the motion",
        "end the other program, or the Desk task, that uses this arm",
    ),
    Trouble(
        "while another control or read operation",
        "occupied",
        "two parts of this program use the arm at once",
        "this is a mistake in the driver; start the program anew",
    ),
    Trouble(
        "realtime|real-time",
        "realtime",
        "the library was refused real-time scheduling",
        "install a real-time kernel and allow rtprio: hal-check says how",
    ),
    # The hand.
    Trouble(
        "gripper: Command failed",
        "hand_failed",
        "the hand could not do what it was told",
        "see that the fingers can move; home the hand, which it needs once after it was switched on",
    ),
    Trouble(
        "gripper: Command aborted",
        "hand_aborted",
        "the hand's motion was stopped",
        "send the next command when the fingers are free",
    ),
    Trouble(
        "command aborted",
        "aborted",
        "the robot ended the motion, and does not say why",
        "look at the message in Desk",
    ),
)
"""The first that fits is the one."""
