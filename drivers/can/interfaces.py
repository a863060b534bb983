"""CAN interfaces of this computer's kernel: up or down, bit rate and errors, as ``ip -details -json link`` lists them.

For ``hal check``; the driver itself needs none of it.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from typing import Any, NamedTuple

from .bus import bring_up, can_interfaces
from .settings import BusSettings

_PATIENCE = 3.0
"""Longest time that ``ip`` may take, s."""


class CanInterface(NamedTuple):
    name: str
    up: bool
    virtual: bool = False
    """Whether it is a vcan, which has no wire and no bit rate."""
    bit_rate: int | None = None
    """bit/s; None if none is set."""
    data_bit_rate: int | None = None
    """Of the data of CAN-FD frames, bit/s; None for an interface that is not set up for CAN-FD."""
    state: str = ""
    """State of the controller: ERROR-ACTIVE (in order), ERROR-WARNING, ERROR-PASSIVE, BUS-OFF or STOPPED."""
    adapter: str = ""
    """Driver of the adapter, for example gs_usb."""

    def __str__(self) -> str:
        parts = ["up" if self.up else "down"]
        if self.bit_rate:
            parts.append(f"{self.bit_rate} bit/s")
        if self.data_bit_rate:
            parts.append(f"CAN-FD, data {self.data_bit_rate} bit/s")
        if self.state:
            parts.append(self.state)
        if self.adapter:
            parts.append(self.adapter)
        return ", ".join(parts)


def read_interfaces() -> tuple[CanInterface, ...] | None:
    """Return the CAN interfaces of this computer; None if ``ip`` (iproute2) is not installed or fails."""
    text = _run_ip()
    return None if text is None else parse_links(text)


def _run_ip() -> str | None:
    try:
        done = subprocess.run(
            ["ip", "-details", "-json", "link"], capture_output=True, text=True, timeout=_PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


def parse_links(text: str) -> tuple[CanInterface, ...]:
    """Return the CAN interfaces in an answer of ``ip -details -json link``; an answer that is not one has none."""
    try:
        links = json.loads(text or "[]")
    except json.JSONDecodeError:
        return ()
    return tuple(_interface(link) for link in links if link.get("link_type") == "can")


def _interface(link: dict[str, Any]) -> CanInterface:
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    return CanInterface(
        name=str(link.get("ifname")),
        up="UP" in link.get("flags", ()),
        virtual=info.get("info_kind") in ("vcan", "vxcan"),
        bit_rate=data.get("bittiming", {}).get("bitrate"),
        data_bit_rate=data.get("data_bittiming", {}).get("bitrate"),
        state=str(data.get("state", "")),
        adapter=str(data.get("bittiming_const", {}).get("name", "")),
    )


def list_buses() -> Iterator[str]:
    """Yield a line for each CAN interface and for each serial or USB adapter that python-can finds."""
    interfaces = read_interfaces()
    if interfaces is None:
        interfaces = tuple(CanInterface(name, up=False, state="ip (iproute2) is missing") for name in can_interfaces())
    for interface in interfaces:
        remedy = "" if interface.up else f"; {bring_up(BusSettings(interface='socketcan', channel=interface.name))}"
        yield f"{interface.name:12s} socketcan    {interface}{remedy}"
    for config in _other_adapters():
        more = ", ".join(f"{key} {value}" for key, value in config.items() if key not in ("interface", "channel"))
        yield f"{config.get('channel', '')!s:12s} {config['interface']:12s} {more}".rstrip()


def _other_adapters() -> list[dict[str, Any]]:
    """Return the adapters that python-can's own interfaces find, without SocketCAN and without those in memory."""
    import logging

    import can

    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # each vendor's library that is not installed would be a line
    known = sorted(set(can.VALID_INTERFACES) - {"socketcan", "virtual", "udp_multicast"})
    try:
        return [dict(config) for config in can.detect_available_configs(known, timeout=1.0)]
    finally:
        logging.disable(before)
