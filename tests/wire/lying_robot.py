"""A robot that breaks the rules on request: ``python lying_robot.py '{"host": ..., "says": [{...}, ...]}'``.

Each connection gets the next entry of ``says``; see :class:`Lie`. Unlike the emulator it follows no rules.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from hal_emulators.franka.protocol import STATE

CONNECT, MOVE, STOP = 0, 1, 2
GET_MODEL = 11  # of protocol 10
MODEL = "".join(
    f'<link name="l{k}"/><joint name="fr3_joint{k}" type="revolute"><parent link="l{k - 1}"/><child link="l{k}"/>'
    '<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="87" velocity="2"/>{}</joint>'
    for k in range(1, 8)
)
SHRINKING = '<position_based_velocity_limits velocity_offset="0.5" deceleration_limit="5"/>'


@dataclass
class Lie:
    """Behaviour for one connection."""

    layout: int = 10
    """Protocol of the states' layout."""
    version: int = 10
    """Protocol that is claimed."""
    hang_up: bool = False
    silent: bool = False
    """No state is sent."""
    short: int = 0
    """Bytes that each state lacks."""
    model: bool = True
    """Whether the robot's model is complete."""
    start: int = 1
    """First answer to Move; 1 is that it began."""
    end: int | None = None
    """Second answer to Move, 20 ms later."""
    status: int = 0
    """Answer to everything else."""
    flags: tuple[int, ...] = ()
    mode: int = 1


def serve(connection: socket.socket, host: str, peer: str, lie: Lie) -> None:
    """Serve one connection until the client disconnects."""
    states = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    states.bind((host, 0))
    port, number, moving, began = 0, 0, None, 0.0
    buffer = bytearray()
    while not lie.hang_up:
        if select.select([connection], [], [], 0.001)[0]:
            data = connection.recv(65536)
            if not data:
                break
            buffer += data
        for code, request, payload in requests(buffer):
            body = bytes([lie.status])
            if code == CONNECT:
                version, port = struct.unpack("<HH", payload)
                body = struct.pack("<BH", version != lie.version, lie.version)
            elif code == MOVE:
                body = bytes([lie.start])
                moving, began = (request, time.monotonic()) if lie.start == 1 else (None, 0.0)
            elif code == STOP and moving is not None:
                reply(connection, MOVE, moving, bytes([2]))  # the motion is ended by another command
                moving = None
            elif code == GET_MODEL and lie.layout == 10:
                urdf = (
                    f'<robot name="fr3"><link name="l0"/>{MODEL.format(*[SHRINKING if lie.model else ""] * 7)}</robot>'
                )
                body = b"\0" + urdf.encode()
            reply(connection, code, request, body)
        number += 1
        ended = moving is not None and lie.end is not None and time.monotonic() - began > 0.02
        if port and not lie.silent:
            states.sendto(state(lie, number, moving is not None and not ended), (peer, port))
        if ended:
            reply(connection, MOVE, moving, bytes([lie.end or 0]))
            moving = None
    states.close()


def reply(connection: socket.socket, code: int, request: int | None, body: bytes) -> None:
    """Answer one request."""
    connection.sendall(struct.pack("<III", code, request, 12 + len(body)) + body)


def requests(buffer: bytearray) -> Iterator[tuple[int, int, bytes]]:
    """Remove and yield the complete requests: code, number, payload."""
    while len(buffer) >= 12:
        code, request, size = struct.unpack_from("<III", buffer)
        if len(buffer) < size:
            return
        payload = bytes(buffer[12:size])
        del buffer[:size]
        yield code, request, payload


def state(lie: Lie, number: int, moving: bool) -> bytes:
    """Return one state packet."""
    layout = STATE[lie.layout]
    packet = bytearray(layout.size)
    values: dict[str, Any] = {
        "message_id": [number],
        "motion_generator_mode": [int(moving)],
        "controller_mode": [0 if moving else 3],
        "errors": [int(k in lie.flags) for k in range(41)],
        "reflex_reason": [int(k in lie.flags) for k in range(41)],
        "robot_mode": [2 if moving else lie.mode],
        "control_command_success_rate": [0.5],
    }
    for name, items in values.items():
        field = layout.fields[name]
        struct.pack_into(f"<{field.values}{field.kind}", packet, field.offset, *items)
    return bytes(packet[: layout.size - lie.short])


def main() -> None:
    options = json.loads(sys.argv[1])
    with socket.create_server((options["host"], 1337)) as listener:
        print("ready", flush=True)
        for says in options["says"]:
            connection, (peer, _) = listener.accept()
            with connection:
                serve(connection, options["host"], peer, Lie(**says))


if __name__ == "__main__":
    main()
