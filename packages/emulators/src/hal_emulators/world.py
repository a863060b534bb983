"""The program that steps the world of emulated arms: ``python -m hal_emulators.world --config RIG``.

Emulators start it. Time in the world is that of their arms: each is placed where it was at the time of a step, so a
busy computer makes the world late, and no motion in it faster. The world's fingers are a little ahead of the emulated
ones, and press as these do; these stop where the world's meet an object.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import itertools
import math
import os
import select
import signal
import socket
import sys
import time
import traceback
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import mul
from typing import Any

from hal import registry
from hal.config.loader import load
from hal.drivers.scene.gripper import SimulatedGripper
from hal.drivers.scene.shared import Connection, address_of, check_scene, scene_of
from hal.errors import CommandError, ConnectionLost, ControlTaken, HalError
from hal.host.process import pack_error
from hal.specs import RobotSpec, WorldSpec

_LONGEST_GAP = 5.0
"""Time for which the world catches up, s."""
_SILENT = 1.0
"""Time without a report after which the world does not wait for an arm, s."""
_FASTEST = 20.0
"""Joint speed, rad/s, from which on an arm counts as placed elsewhere."""
_FINGER_LEAD = 0.045
"""Time, s, by which the fingers lead: the emulated ones have to know of an object before they are there."""
_FINGER_SPEED = 3.0
"""The world's fingers may be so many times as fast as the emulated ones, so that they can follow."""
_TOUCHED = 0.02
"""Time after the last contact until which it counts, s: contacts flicker."""
_SHOWN = 4
"""A late world shows every so many steps only: it has to catch up."""
_AT_ONCE = frozenset({"pose", "poses", "contacts"})
"""Requests that loops, recordings and views make at their rate: they get the newest step, however late."""
_OPPOSITE = -0.5
"""Greatest cosine between the two sides' normals of contact with an object between them."""


class ArmOfWorld:
    """An emulated arm in the world: where it is, and what its fingers meet."""

    def __init__(self, world: Any, spec: RobotSpec) -> None:
        self._world = world
        self.name = spec.name
        self._joints = len(spec.joints)
        self.object_width: float | None = None
        """Width of the fingers on what is between them, m; None for nothing."""
        self._reports: deque[tuple[float, list[float]]] = deque()
        self._reports_of_fingers: deque[tuple[float, float, float]] = deque()
        self.reported = self.heard = -math.inf
        """Time of the newest report, and when it came, s."""
        self._q: list[float] | None = None
        self._width: tuple[float, float] | None = None
        """Time, s, and width, m, of the report of the fingers that counts now."""
        self._speed = self._force = 0.0
        self._target: tuple[float, float] | None = None
        self._touched_at = -1.0
        self._fingers: SimulatedGripper[Any, Any] | None = None
        self._sides: list[set[str]] = []
        if spec.gripper is not None and spec.gripper.joints:
            self._fingers = registry.load(world.spec.driver, "gripper")(spec.gripper, world)
            self._fingers.open()
            self._sides = _find_sides(world.body(spec.name), spec.gripper.joints)

    def take(self, report: Mapping[str, Any]) -> None:
        """Take a report of the emulator. Raises ValueError if it is one of an arm with other joints."""
        if len(report["q"]) != self._joints:
            raise ValueError(f"{self.name}: {len(report['q'])} joint positions, not {self._joints}")
        t, self.heard = report["t"], time.monotonic()
        self.reported = t
        self._reports.append((t, report["q"]))
        self.take_fingers(report)

    def take_fingers(self, report: Mapping[str, Any]) -> None:
        """Take a report of the fingers, which may be that of a gripper with an emulator of its own."""
        if report["fingers"] is not None:
            self._reports_of_fingers.append(report["fingers"])

    def prepare_step(self, t: float, dt: float) -> None:
        """Place the arm where it is at ``t``, and drive its fingers."""
        if self._reports:
            q = self._interpolate(t)
            before = q if self._q is None else self._q
            dq = [(new - old) / dt for new, old in zip(q, before, strict=True)]
            if max(map(abs, dq)) > _FASTEST:
                before, dq = q, [0.0] * len(q)
            self._world.follow(self.name, before, dq)
            self._q = q
        while self._reports_of_fingers and self._reports_of_fingers[0][0] <= t:
            self._take_fingers(*self._reports_of_fingers.popleft())
        if self._fingers is not None and self._width is not None:
            self._drive_fingers()

    def _take_fingers(self, t: float, width: float, force: float) -> None:
        self._force = force
        if self._width is not None and t > self._width[0]:
            self._speed = (width - self._width[1]) / (t - self._width[0])
        self._width = (t, width)

    def _interpolate(self, t: float) -> list[float]:
        reports = self._reports
        while len(reports) > 1 and reports[1][0] <= t:
            reports.popleft()
        t0, q0 = reports[0]
        if len(reports) == 1 or t <= t0:
            return q0
        t1, q1 = reports[1]
        share = (t - t0) / (t1 - t0)
        return [a + share * (b - a) for a, b in zip(q0, q1, strict=True)]

    def _drive_fingers(self) -> None:
        fingers, width = self._fingers, self._width
        assert fingers is not None
        assert width is not None
        spec = fingers.spec
        if self._force > 0.0:
            wanted = (spec.width_min, self._force)
        else:
            wanted = (width[1] + self._speed * _FINGER_LEAD, spec.force)
        if self._target is None or max(abs(a - b) for a, b in zip(wanted, self._target, strict=True)) > 1e-6:
            self._target = wanted
            fingers.move(wanted[0], spec.speed, wanted[1])

    def finish_step(self, t: float) -> None:
        if self._fingers is None:
            return
        width = self._fingers.read(t).width
        if self._is_between():
            self._touched_at = t
            self.object_width = width
        elif t > self._touched_at + _TOUCHED:
            self.object_width = None

    def _is_between(self) -> bool:
        """Return whether two fingers touch one thing, from opposite sides."""
        touched: list[dict[str, list[Any]]] = [{} for _ in self._sides]
        for contact in self._world.contacts(self.name):
            for side, links in zip(touched, self._sides, strict=True):
                if contact["link_a"] in links and contact["b"] != self.name:
                    side.setdefault(contact["b"], []).append(contact["normal"])
        return any(
            sum(map(mul, _mean(one[thing]), _mean(other[thing]))) < _OPPOSITE
            for one, other in itertools.combinations(touched, 2)
            for thing in one.keys() & other
        )


def _mean(normals: Sequence[Sequence[float]]) -> list[float]:
    return [sum(axis) / len(normals) for axis in zip(*normals, strict=True)]


def _find_sides(body: Any, joints: Sequence[str]) -> list[set[str]]:
    """Return the links that each joint of a gripper carries, joints with a mimic included."""
    own = {
        name for name, joint in body.urdf.joints.items() if name in joints or (joint.mimic and joint.mimic.of in joints)
    }
    first = {
        link: next((joint.name for joint in body.urdf.above(link) if joint.name in own), None) for link in body.links
    }
    return [{link for link, joint in first.items() if joint == name} for name in sorted(own)]


class WorldServer:
    """Steps a world in real time, and serves emulators and programs."""

    def __init__(self, spec: WorldSpec) -> None:
        """Build the world and listen. Raises ConfigError, and OSError ``EADDRINUSE`` if another program has it."""
        self._spec = spec
        self._poller = select.epoll()
        self._listeners: dict[int, socket.socket] = {}
        for address in {address_of(robot) for robot in spec.robots if robot.emulated}:
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            listener.bind(address)
            listener.listen(8)
            self._listeners[listener.fileno()] = listener
            self._poller.register(listener, select.EPOLLIN)
        self._clients: dict[int, Connection] = {}
        self._roles: dict[int, str] = {}
        self._arms_of: dict[int, ArmOfWorld] = {}
        self._requests: deque[tuple[float, int, int, str, dict[str, Any]]] = deque()
        """Time of the world for which a request is, s, the client that waits for the answer, and the request."""
        self._fingers_of: dict[int, ArmOfWorld] = {}
        """Arms whose gripper has an emulator of its own, by that one's connection."""
        self._t = time.monotonic()
        """Time of the step that was made last, s."""
        self._build()

    def _build(self) -> None:
        """Make the world anew; its arms wait for a report."""
        quick = tuple(
            robot
            if robot.gripper is None
            else replace(robot, gripper=replace(robot.gripper, speed=_FINGER_SPEED * robot.gripper.speed))
            for robot in self._spec.robots
        )
        spec = replace(self._spec, robots=quick)
        self.world: Any = registry.load(spec.driver, "world")(spec)
        self.arms = {robot.name: ArmOfWorld(self.world, robot) for robot in spec.robots}

    def run(self, until: int) -> None:
        """Step and serve until the descriptor ``until`` is closed on the other side."""
        self._poller.register(until, select.EPOLLIN | select.EPOLLHUP)
        dt = self.world.dt
        self._t = self._reported(time.monotonic())
        while True:
            now = time.monotonic()
            reported = self._reported(now)
            self._t = max(self._t, reported - _LONGEST_GAP)
            if self._t + dt <= reported:
                self._t += dt
                self._step(self._t, dt)
                if self._t + dt > reported or self.world.steps % _SHOWN == 0:
                    self._show()
            self._answer_due(self._t + dt)
            ready = self._t + dt <= reported
            for descriptor, _ in self._poller.poll(0.0 if ready else dt):
                if descriptor == until:
                    if not os.read(until, 4096):
                        return
                elif descriptor in self._listeners:
                    self._accept(self._listeners[descriptor])
                else:
                    self._serve(descriptor)

    def close(self) -> None:
        """Leave all clients, and free the world and its addresses."""
        for connection in (*self._listeners.values(), *self._clients.values(), self._poller, self.world):
            connection.close()

    def _reported(self, now: float) -> float:
        """Return the time up to which the arms have reported where they are, s."""
        times = [arm.reported for arm in self._arms_of.values() if arm.heard > now - _SILENT]
        return min(times, default=now)

    def _step(self, t: float, dt: float) -> None:
        for arm in self.arms.values():
            arm.prepare_step(t, dt)
        self.world.step()
        for arm in self.arms.values():
            arm.finish_step(t)
        for descriptor, arm in (*self._arms_of.items(), *self._fingers_of.items()):
            self._send(descriptor, {"object": arm.object_width, "t": t})

    def _show(self) -> None:
        """Send the state to all who watch."""
        watching = [descriptor for descriptor, role in self._roles.items() if role == "poses"]
        if watching:
            state = self._state()
            for descriptor in watching:
                self._send(descriptor, state)

    def _state(self) -> dict[str, Any]:
        world = self.world
        return {"t": self._t, "steps": world.steps, "revision": world.revision, "snapshot": world.snapshot()}

    def _send(self, descriptor: int, message: Any) -> None:
        with contextlib.suppress(ConnectionLost):  # the poller reports its end
            self._clients[descriptor].send(message)

    def _accept(self, listener: socket.socket) -> None:
        sock, _ = listener.accept()
        sock.setblocking(False)
        self._clients[sock.fileno()] = Connection(sock)
        self._poller.register(sock, select.EPOLLIN)

    def _serve(self, descriptor: int) -> None:
        client = self._clients[descriptor]
        try:
            while (message := client.receive()) is not None:
                if descriptor not in self._roles:
                    self._greet(descriptor, message)
                elif descriptor in self._arms_of:
                    self._arms_of[descriptor].take(message)
                elif descriptor in self._fingers_of:
                    self._fingers_of[descriptor].take_fingers(message)
                else:
                    request = message["id"], message["method"], message["params"]
                    due = self._t if message["method"] in _AT_ONCE else self._reported(time.monotonic())
                    self._requests.append((due, descriptor, *request))
        except ConnectionLost:
            self._drop(descriptor)
        except Exception:  # of what this client sent: the world goes on without it
            traceback.print_exc()
            self._drop(descriptor)

    def _drop(self, descriptor: int) -> None:
        client = self._clients.pop(descriptor)
        self._poller.unregister(client.sock)
        if self._roles.pop(descriptor, None) == "requests":
            self._requests.clear()
        self._arms_of.pop(descriptor, None)
        self._fingers_of.pop(descriptor, None)
        client.close()

    def _answer_due(self, t: float) -> None:
        """Answer the requests for before ``t``: a late world has caught up with what clients knew at their edits."""
        while self._requests and self._requests[0][0] <= t:
            _, descriptor, number, method, params = self._requests.popleft()
            self._send(descriptor, self._answer(number, method, params))

    def _answer(self, number: int, method: str, params: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a request of :class:`.shared.SharedWorld`, with the state after it."""
        try:
            result = self.world.request(method, params)
        except Exception as error:
            return {"id": number, "error": pack_error(error)}
        return {"id": number, "result": result, "state": self._state()}

    def _greet(self, descriptor: int, message: Mapping[str, Any]) -> None:
        """Answer the first message of a client; one that is refused is told why, and changes nothing."""
        try:
            answer = self._admit(descriptor, message)
        except HalError as error:
            answer = {"error": pack_error(error)}
        else:
            self._roles[descriptor] = message["role"]
        self._send(descriptor, answer)

    def _admit(self, descriptor: int, message: Mapping[str, Any]) -> dict[str, Any]:
        role = message["role"]
        if role in ("arm", "fingers"):
            name = message["name"]
            if name not in self.arms:
                names = ", ".join(self.arms)
                raise CommandError(
                    f"the world of the emulators has no arm {name!r}, but {names}: start each with the same rig"
                )
            arm = (self._arms_of if role == "arm" else self._fingers_of)[descriptor] = self.arms[name]
            return {"object": arm.object_width, "t": self._t}
        if role == "poses":
            return self._state()
        if "requests" in self._roles.values():
            raise ControlTaken("another program has this world: close it first")
        check_scene(scene_of(self._spec), message["scene"])
        if self.world.revision:
            self._restart()
        return {"warnings": self.world.warnings}

    def _restart(self) -> None:
        """Undo what a program that is gone added, removed and painted: the next one does not know of it."""
        before = self.world
        self._build()
        before.close()
        for place in (self._arms_of, self._fingers_of):
            for descriptor, arm in place.items():
                place[descriptor] = self.arms[arm.name]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program until its standard input ends; return its exit status. Its first line says whether it runs."""
    parser = argparse.ArgumentParser(
        prog="python -m hal_emulators.world", description="Steps the world of a rig's emulated arms."
    )
    parser.add_argument("--config", required=True, help="the rig: a name in config/, or a path")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the emulator ends it
    emulator = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # it reads one line: what an engine writes goes to the terminal
    try:
        world = load(options.config, sim=False, overrides=options.set).resolve().world
        if world is None:
            raise ValueError("this rig has no simulated world: it needs a simulated camera")
        if not all(robot.emulated for robot in world.robots):
            raise ValueError("every arm of this rig must be an emulated one")
        server = WorldServer(world)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
        print("shared", file=emulator, flush=True)
        return 0
    except (HalError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=emulator, flush=True)
        return 1
    print("ready", file=emulator, flush=True)
    server.run(sys.stdin.fileno())
    server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
