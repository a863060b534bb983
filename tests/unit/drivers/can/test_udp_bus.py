"""Buses over UDP multicast on one computer."""

from __future__ import annotations

import os

import can

from hal.drivers.can.settings import BusSettings


def test_two_channels_on_one_computer_do_not_hear_each_other() -> None:
    """On one port Linux hands out the frames of every group that any of its programs has joined."""
    first, second = (
        can.Bus(**BusSettings(interface="udp_multicast", channel=f"239.74.{os.getpid() % 250}.{k}").arguments())
        for k in (1, 2)
    )
    with first, second:
        first.send(can.Message(arbitration_id=0x123, data=b"\1", is_extended_id=False))
        own = first.recv(1.0)
        assert own is not None
        assert own.arbitration_id == 0x123
        while (other := second.recv(0.1)) is not None:
            assert other.arbitration_id != 0x123
