"""One simulated world for a rig whose arms are emulated: its emulators and the program that opens it share it.

A program beside the emulators steps the world (``hal_emulators.world``). Each emulator tells it where its arm is and
how its fingers press, and learns how wide the object between them is. The process of a rig's simulated world shows the
same world instead of a copy of its own (:class:`SharedWorld`), so cameras and ``rig.world`` have one truth. Messages
are JSON, one per packet of a socket in Linux's abstract name space.
"""

from __future__ import annotations

import hashlib
import json
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hal.errors import ConfigError, ConnectionLost, HalError, Problem
from hal.host.process import unpack_error
from hal.specs import RobotSpec, WorldSpec, to_json
from hal.world import WorldDriver

_LARGEST = 1 << 20
"""Largest message, bytes."""
_PATIENCE = 10.0
"""Longest wait for the answer to a request, s."""
_AGAIN = 1.0
"""Time between two tries to join again, s."""
_PATIENCE_AGAIN = 1.0
"""Longest wait for an answer at such a try, s: the process of the simulation stands still meanwhile."""


def address_of(robot: RobotSpec) -> str:
    """Return the address of the world that an emulated arm is in: one for all arms at one address or on one bus."""
    options = robot.options
    place = options.get("host") or [options.get("interface"), options.get("channel")]
    return "\0hal-world-" + hashlib.sha256(json.dumps([robot.driver, place]).encode()).hexdigest()


def scene_of(spec: WorldSpec) -> dict[str, Any]:
    """Return what two records of a world must have in common: its objects, and the bodies and places of its arms."""
    arms = {robot.name: [robot.urdf, robot.base_position, robot.base_orientation] for robot in spec.robots}
    scene = {"objects": {body.name: to_json(body) for body in spec.bodies}, "robots": arms, "gravity": spec.gravity}
    plain: dict[str, Any] = json.loads(json.dumps(scene))
    return plain


class Connection:
    """A connection to the program that steps a world, or one of its clients."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock

    @classmethod
    def connect(cls, address: str, timeout: float, **greeting: Any) -> tuple[Connection, Any]:
        """Connect, say what for, and return the connection with the program's answer.

        ``timeout`` is the longest wait for an answer, now and later, s. The greeting has a ``role``, and what the
        program has to know of a client of this kind. Raises ConnectionLost if there is no such program, or it does not
        answer, and the HalError with which it refuses this client.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.settimeout(timeout)
        made = cls(sock)
        try:
            try:
                sock.connect(address)
            except OSError as error:
                raise ConnectionLost(f"no emulator shares its world ({error}): start the emulators") from None
            made.send(greeting)
            answer = made.receive()
            if "error" in answer:
                raise unpack_error(answer["error"])
        except BaseException:
            made.close()
            raise
        return made, answer

    def send(self, message: Any) -> None:
        """Send a message. Raises ConnectionLost."""
        try:
            self.sock.send(json.dumps(message).encode())
        except BlockingIOError:
            pass  # the other side is behind: it gets a newer one
        except OSError as error:
            raise ConnectionLost(f"the emulators' world is gone ({error}): start the emulators again") from None

    def receive(self) -> Any:
        """Return the next message; None if the socket does not wait and there is none. Raises ConnectionLost."""
        try:
            data = self.sock.recv(_LARGEST)
        except BlockingIOError:
            return None
        except TimeoutError:
            raise ConnectionLost("the emulators' world does not answer") from None
        except OSError as error:
            raise ConnectionLost(f"the emulators' world is gone ({error}): start the emulators again") from None
        if not data:
            raise ConnectionLost("the emulators' world is gone: start the emulators again")
        return json.loads(data)

    def receive_newest(self) -> Any:
        """Return the newest message of a socket that does not wait; None if there is none. Raises ConnectionLost."""
        newest = None
        while (message := self.receive()) is not None:
            newest = message
        return newest

    def close(self) -> None:
        self.sock.close()


class SharedWorld(WorldDriver):
    """The world that the emulators of a rig's arms share, as the rig's own process of the simulation has it.

    It is stepped elsewhere: :meth:`step` takes its newest state, and requests are passed on. If the emulator ends, the
    last state stays, and the world is joined again when there is one; until then requests raise ConnectionLost, with
    the reason.
    """

    def __init__(self, spec: WorldSpec, address: str) -> None:
        """Join the world.

        Raises ConnectionLost if no emulator shares one, ControlTaken if another program has it, ConfigError for another
        scene.
        """
        super().__init__(spec)
        self._address = address
        self._edits: list[tuple[str, dict[str, Any]]] = []
        self._on_edit: list[Callable[[str, dict[str, Any], int], None]] = []
        self._values: list[float] = []
        self._stamp = 0.0
        self._requests: Connection | None = None
        self._poses: Connection | None = None
        self._number = 0
        """Of the newest request."""
        self._next_try = 0.0
        self._lost = "the world is closed"
        """Why it is not joined."""
        self._join(_PATIENCE)

    def _join(self, timeout: float) -> None:
        """Join the world, and repeat this rig's edits there; ``timeout`` (s) is for each answer."""
        try:
            self._connect(timeout)
        except HalError:
            self.close()
            raise

    def _connect(self, timeout: float) -> None:
        self._requests, answer = Connection.connect(self._address, timeout, role="requests", scene=scene_of(self.spec))
        self.warnings = [
            *answer["warnings"],
            "the objects are those of the emulator's world, which goes on without this rig",
        ]
        for method, params in self._edits:
            self._ask(method, params)
        self.steps = 0
        self._poses, state = Connection.connect(self._address, timeout, role="poses")
        self._take(state)
        self._poses.sock.setblocking(False)
        self._requests.sock.settimeout(_PATIENCE)

    def _take(self, state: Mapping[str, Any]) -> None:
        """Take a state of the world, unless a later one came with an answer."""
        if state["steps"] >= self.steps:
            self.steps, self.revision, self._values = state["steps"], state["revision"], state["snapshot"]
            self._stamp = state["t"]

    @property
    def version(self) -> tuple[int, int]:
        return self.steps, self.revision

    def stamp(self, now: float) -> float:
        return self._stamp

    def step(self) -> None:
        try:
            if self._poses is not None:
                newest = self._poses.receive_newest()
                if newest is not None:
                    self._take(newest)
            elif time.monotonic() >= self._next_try:
                self._join(_PATIENCE_AGAIN)
        except HalError as error:  # also another scene, or another program that was faster
            self.close()
            self._lost, self._next_try = str(error), time.monotonic() + _AGAIN

    def request(self, method: str, params: Mapping[str, Any]) -> Any:
        result = self._ask(method, params)
        if method in self.MIRRORED:
            self._edits.append((method, dict(params)))
            for callback in self._on_edit:
                callback(method, dict(params), result)
        return result

    def _ask(self, method: str, params: Mapping[str, Any]) -> Any:
        if self._requests is None:
            raise ConnectionLost(self._lost)
        self._number += 1
        self._requests.send({"id": self._number, "method": method, "params": dict(params)})
        answer = self._requests.receive()
        while answer["id"] != self._number:  # of a request that was given up
            answer = self._requests.receive()
        if "error" in answer:
            raise unpack_error(answer["error"])
        self._take(answer["state"])
        return answer["result"]

    def follow(self, name: str, q: Sequence[float], dq: Sequence[float], width: float | None = None) -> None:
        """Do nothing: the arm's emulator places it."""

    def snapshot(self) -> list[float]:
        return self._values

    def on_reset(self, name: str, callback: Callable[[], None]) -> None:
        """Do nothing: this world has no arms of its own."""

    def off_reset(self, name: str, callback: Callable[[], None]) -> None:
        """Do nothing."""

    def keep(self, name: str, save: Callable[[], Any], restore: Callable[[Any], None]) -> None:
        """Do nothing: this world has no drivers."""

    def on_edit(self, callback: Callable[[str, dict[str, Any], int], None]) -> None:
        self._on_edit.append(callback)

    def close(self) -> None:
        for connection in (self._requests, self._poses):
            if connection is not None:
                connection.close()
        self._requests = self._poses = None


def check_scene(own: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """Raise ConfigError, with the names of what differs, if the scene of a program is not that of the emulator."""
    if own == other:
        return
    differ = sorted(
        name
        for part in ("objects", "robots")
        for name in {*own[part], *other[part]}
        if own[part].get(name) != other[part].get(name)
    )
    text = f"the emulator has another scene ({', '.join(differ) or 'another gravity'})"
    text += ": start it with this rig (--config, --set)"
    raise ConfigError([Problem("simulation", "objects", text, "other_scene")])


def join_world(spec: WorldSpec) -> SharedWorld | None:
    """Return the world that the emulators of a rig's arms share; None if they share none, or an arm is not emulated."""
    if not spec.robots or not all(robot.emulated for robot in spec.robots):
        return None
    try:
        return SharedWorld(spec, address_of(spec.robots[0]))
    except ConnectionLost:
        return None
