"""The contract of a LeaderDriver: that of a gamepad, and joint positions."""

from __future__ import annotations

import math
import time
from typing import cast

from ..driver import PadReading
from ..leader import LeaderDriver
from .benches import PadBench, needs
from .gamepad import GamepadContract

_NO_BUTTONS = "a leader has no buttons of its own"


class LeaderContract(GamepadContract, left_out={"press": _NO_BUTTONS, "release": _NO_BUTTONS}):
    """Checks of a leader's driver. The bench is a :class:`~hal.testing.PadBench` with the leader at rest.

    ``left_out`` may name ``lose``, ``restore`` and ``freeze``.
    """

    def test_a_reading_has_every_joint(self, bench: PadBench) -> None:
        bench.driver.open()
        reading = _poll_until(bench, connected=True)
        joints = cast(LeaderDriver, bench.driver).leader.joints
        assert len(reading.joints) == len(joints), f"one position for each of {', '.join(joints)}"
        assert all(math.isfinite(position) for position in reading.joints)
        assert all(0.0 <= share <= 1.0 for share in reading.axes.values()), "a lever is from 0 to 1"
        assert set(reading.axes) <= {"l2", "r2"}, "l2 is the dead-man, r2 the gripper"

    @needs("lose", "restore")
    def test_an_unplugged_leader_has_no_joints_and_comes_back(self, bench: PadBench) -> None:
        bench.driver.open()
        before = _poll_until(bench, connected=True)
        bench.lose()
        gone = _poll_until(bench, connected=False)
        assert not gone.joints
        assert not gone.buttons
        assert not any(gone.axes.values())
        assert gone.seq > before.seq, "being unplugged is an event"
        assert bench.driver.notes, "the notes say why"
        bench.restore()
        back = _poll_until(bench, connected=True)
        assert back.joints == before.joints
        assert back.t_alive > gone.t_alive


def _poll_until(bench: PadBench, connected: bool) -> PadReading:
    deadline = time.monotonic() + bench.patience + 2.0
    while True:
        reading = bench.driver.poll(bench.pass_time(), 0.0)
        if reading.connected is connected:
            return reading
        assert time.monotonic() < deadline, f"connected is not {connected}: {bench.driver.describe()}"
