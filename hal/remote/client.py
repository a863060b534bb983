"""The end of a link at the program: the arms that another computer serves, and the process in place of their host."""

from __future__ import annotations

import os
import socket
import ssl
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from .. import registry
from ..errors import ConnectionLost, HalError
from ..host.process import Channel, ChannelClosed, SharedMemory, pack_error, unpack_error
from ..host.records import GroupMemory
from ..host.scheduling import LINK_PRIORITY, prepare_process
from ..keys import Credentials, needs_keys
from ..kinematics.composition import keep_urdf
from ..specs import CameraSpec, GroupSpec, PadSpec, RobotSpec, from_json
from .boxes import boxes_of_hosts, boxes_of_program
from .link import ANSWER_LIMIT, CLOSE_LIMIT, PORT, RigLink, describe_version

PERIOD = 0.001
"""Longest time from a new record of the program to its frame, s. A command wakes this process."""


def split_address(at: str) -> tuple[str, int]:
    """Return name and port of ``NAME[:PORT]``, of which IPv6 addresses are in brackets. Raises ValueError."""
    name, colon, port = at.rpartition(":") if not at.endswith("]") else (at, "", "")
    if not colon:
        return at.strip("[]"), PORT
    if not 0 < int(port) < 65536:  # the system would take the rest of a division
        raise ValueError(f"there is no port {port}")
    return name.strip("[]"), int(port)


def connect(at: str, purpose: dict[str, Any]) -> tuple[RigLink, dict[str, Any]]:
    """Connect to another computer, and return the link with its first answer.

    Args:
        at: Its address.
        purpose: What the connection is for: ``{"want": "devices"}``, ``"control"``, ``"frames"`` or ``"pad"``.

    Raises:
        ConnectionLost: Nothing answers there (``code`` is ``no_server``); or a certificate is refused, see
            :meth:`~hal.keys.Credentials.explain`.
        NotSupported: There is no certificate here, see :func:`~hal.keys.find_key`.
        HalError: The server's refusal: another version (``version_mismatch``), or ``in_use``.
    """
    name, port = split_address(at)
    credentials = Credentials("person") if needs_keys(name) else None
    try:
        sock = socket.create_connection((name, port), timeout=ANSWER_LIMIT)
    except OSError as error:
        text = f"nothing answers at {at} ({error.strerror or error}): start `hal serve --config RIG` on that computer"
        raise ConnectionLost(text, code="no_server") from None
    if credentials is not None:
        sock = secured = credentials.wrap(sock, name)
        credentials.shake(secured, at)
    link = RigLink(sock, at)
    try:
        if credentials is not None:
            link.check = partial(credentials.check, secured.getpeercert() or {})
        link.post(describe_version() | purpose)
        answer = link.await_message()
        if "error" in answer:
            raise unpack_error({**answer["error"], "text": f"{at}: {answer['error']['text']}"})
    except ConnectionLost as error:
        link.close()
        if credentials is not None and isinstance(error.__cause__, ssl.SSLError):  # what the server has against us
            raise credentials.explain(error.__cause__, at) from None
        raise
    except BaseException:
        link.close()
        raise
    return link, answer


def fetch_devices(at: str) -> dict[str, RobotSpec | CameraSpec | PadSpec]:
    """Return the arms, cameras and gamepads that another computer serves, by name. Raises as :func:`connect`.

    Their URDFs are those of this computer where they are the same, else copies in the user's cache; the meshes of
    these are missing.
    """
    link, answer = connect(at, {"want": "devices"})
    link.close()
    files = {path: _place_urdf(path, text) for path, text in answer["urdfs"].items()}
    found: dict[str, RobotSpec | CameraSpec | PadSpec] = {}
    for data in answer["robots"]:
        spec = from_json(RobotSpec, data)
        kinematics = replace(spec.kinematics, urdf=files[spec.kinematics.urdf])
        found[spec.name] = replace(spec, at=at, urdf=files[spec.urdf], kinematics=kinematics)
    for data in answer["cameras"]:
        camera = from_json(CameraSpec, data)
        found[camera.name] = replace(camera, at=at, driver=registry.SERVED)
    for data in answer["pads"]:
        pad = from_json(PadSpec, data)
        if pad.leader is not None and pad.leader.kinematics is not None:
            own = replace(pad.leader.kinematics, urdf=files[pad.leader.kinematics.urdf])
            pad = replace(pad, leader=replace(pad.leader, kinematics=own))
        found[pad.name] = replace(pad, at=at, driver=registry.SERVED)
    return found


def _place_urdf(path: str, text: str) -> str:
    """Return the path of a URDF with this text on this computer."""
    try:
        if Path(path).read_text(encoding="utf-8") == text:
            return path
    except (OSError, UnicodeDecodeError):
        pass
    return str(keep_urdf(text.encode(), Path(path).stem))


class LinkClient:
    """The process in place of a host: it copies between the program's memory and a link, and passes requests on."""

    def __init__(self, channel: Channel, memory: GroupMemory, spec: GroupSpec) -> None:
        assert spec.at is not None
        self._channel = channel
        self._parent = os.getppid()
        robots = [[robot.name, len(robot.joints)] for robot in spec.robots]
        purpose = {"want": "control", "robots": robots, "grippers": list(memory.grippers)}
        self._link, _ = connect(spec.at, purpose)
        self._link.outgoing = boxes_of_program([memory], memory.robots, memory.grippers)
        self._link.incoming = boxes_of_hosts([memory], memory.robots, memory.grippers)
        self._ended_by = float("inf")
        """Time at which this process ends anyway, s, once it was asked to close."""

    def run(self) -> None:
        """Copy until the program closes this process, or is gone, or the link is."""
        try:
            self._copy()
        except ChannelClosed:  # the program is gone
            pass
        except HalError as error:  # the program's next call raises it
            print(error)
            self._channel.send({"error": pack_error(error)})
        finally:
            self._link.close()

    def _copy(self) -> None:
        link, channel = self._link, self._channel
        while os.getppid() == self._parent and time.monotonic() < self._ended_by:
            news = channel.poll_all() if link.wait(PERIOD, channel.sock) else ()
            for request in filter(None, news):  # a new command comes with a message of nothing
                link.post(request)
                if request["method"] == "close":
                    self._ended_by = time.monotonic() + CLOSE_LIMIT
            for message in link.receive():
                if "closed" in message:
                    return
                if "error" in message and "id" not in message:
                    raise unpack_error(message["error"])
                channel.send(message)
            link.send()


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the child process of a group at another computer."""
    spec = from_json(GroupSpec, config["group"])
    memory = GroupMemory.of(memories[0].buffer, spec)
    client = LinkClient(channel, memory, spec)
    prepare_process(config["realtime"], LINK_PRIORITY)
    client.run()
