"""What emulated controllers of arms on Ethernet have in common: ports that one thread serves, faults, the program."""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import selectors
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from hal.errors import HalError

from .control import (
    CONTROL_PORT,
    Command,
    EmulatorControl,
    answer_line,
    assign,
    between,
    note_signals,
    read_end,
    read_loopback,
    run_command,
    serve_prompt,
)
from .lines import Losses
from .shared_world import PRIORITY, ArmInWorld, enter_world, find_arm, raise_priority


class NetworkController:
    """A controller with its arm and a cycle of ``dt`` s."""

    def __init__(self, dt: float) -> None:
        self.dt, self.now = dt, 0.0
        self.events: list[str] = []
        """What happened, the newest last."""

    def note(self, event: str) -> None:
        self.events = [*self.events[-49:], f"{self.now:.3f} {event}"]

    @property
    def joints(self) -> Sequence[float]:
        """Where the joints are, rad."""
        raise NotImplementedError

    def step(self) -> None:
        """Let a cycle pass."""
        raise NotImplementedError


class Client:
    def __init__(self, line: socket.socket, port: int) -> None:
        self.line, self.port, self.came = line, port, b""


class NetworkArm:
    """A controller's ports on one address, served by one thread, once per cycle of the controller.

    The control port is one of them: a ``CommandPort``'s threads would change the controller within a cycle. Raises
    OSError if a port is in use, or below 1024 and not allowed.
    """

    PORTS: ClassVar[tuple[int, ...]]
    COMMANDS: ClassVar[Mapping[str, Command]]
    """Commands of the control port; their target is this object."""
    LONGEST: ClassVar[int] = 1 << 20
    """Most bytes that a client may send without a whole message."""
    client: ClassVar[type[Client]] = Client

    def __init__(self, host: str, controller: NetworkController, seed: int = 0) -> None:
        self.host, self.controller = host, controller
        self.world: ArmInWorld | None = None
        """The simulated world that the arm is in."""
        self.has_gripper = False
        """Whether the rig of that world has a gripper at this controller."""
        self.lost = 0
        """Number of states that were left out."""
        self.losses = Losses(seed)
        self._selector = selectors.DefaultSelector()
        self.clients: list[Any] = []
        self._late: deque[tuple[float, Client, bytes]] = deque()
        self._listeners: list[socket.socket] = []
        self._calm()
        self._listen(CONTROL_PORT)
        self._listen_all()

    def _calm(self) -> None:
        self.losses.clear()
        self.delay = self.mute_until = self.silent_until = self.cut_until = 0.0

    def _listen(self, port: int) -> socket.socket:
        listener = socket.create_server((self.host, port))
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, port)
        return listener

    def _listen_all(self) -> None:
        self._listeners = [self._listen(port) for port in self.PORTS]

    def run(self, ends: Sequence[object]) -> None:
        raise_priority(PRIORITY)
        due = time.monotonic()
        while not ends:
            dt = self.controller.dt
            due += dt
            self._serve(max(0.0, due - time.monotonic()))
            if time.monotonic() - due > 0.1:  # a computer that slept: time is not made up for
                due = time.monotonic()
            self.controller.step()
            if self.world is not None:
                self.exchange(self.world)
            now = time.monotonic()
            if now >= self.silent_until:
                while self._late and self._late[0][0] <= now:
                    self.send(*self._late.popleft()[1:])
                self.publish()

    def close(self) -> None:
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()

    # Of a kind of controller.

    def exchange(self, world: ArmInWorld) -> None:
        """Tell the world where the arm is."""
        world.exchange(self.controller.dt, self.controller.joints)

    def greet(self, client: Client) -> None:
        """Send what a new client gets first."""

    def take(self, client: Any) -> None:
        """Take whole messages from what has come from a client."""
        raise NotImplementedError

    def publish(self) -> None:
        """Send what is due after a cycle."""
        raise NotImplementedError

    def describe(self) -> dict[str, Any]:
        """Return what the arm does."""
        raise NotImplementedError

    def renew(self) -> NetworkController:
        """Return a controller as it was at the start, at the present time."""
        raise NotImplementedError

    # Input.

    def _serve(self, wait: float) -> None:
        """Handle what comes within ``wait`` s."""
        end = time.monotonic() + wait
        while True:
            now = time.monotonic()
            if not self._listeners and now >= self.cut_until:
                self._listen_all()
            deaf = now < max(self.silent_until, self.mute_until)
            for key, _ in self._selector.select(max(0.0, end - now) if not deaf else 0.0):
                if isinstance(key.data, int):
                    self._accept(key.fileobj, key.data)  # type: ignore[arg-type]
                elif not deaf or key.data.port == CONTROL_PORT:
                    self._receive(key.data)
            if deaf and end > now:
                time.sleep(end - now)
            if time.monotonic() >= end:
                return

    def _accept(self, listener: socket.socket, port: int) -> None:
        with contextlib.suppress(OSError):
            line, _ = listener.accept()
            line.setblocking(False)
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = self.client(line, port)
            self.clients.append(client)
            self._selector.register(line, selectors.EVENT_READ, client)
            self.greet(client)

    def drop(self, client: Client) -> None:
        if client in self.clients:
            self.clients.remove(client)
            self._selector.unregister(client.line)
            client.line.close()

    def _receive(self, client: Client) -> None:
        try:
            news = client.line.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            news = b""
        client.came += news
        if not news or len(client.came) > self.LONGEST:
            self.drop(client)
        elif client.port == CONTROL_PORT:
            for line in take_lines(client):
                self.send(client, json.dumps(answer_line(self.execute, line)).encode() + b"\n")
        else:
            self.take(client)

    # Output.

    def send(self, client: Client, data: bytes) -> None:
        try:
            client.line.send(data)
        except BlockingIOError:  # a client that reads nothing misses states
            return
        except OSError:
            self.drop(client)

    def send_state(self, client: Client, data: bytes) -> None:
        """Send a state, unless it is lost; late if they are."""
        if self.losses.take():
            self.lost += 1
        elif self.delay or self._late:
            self._late.append((time.monotonic() + self.delay, client, data))
        else:
            self.send(client, data)

    # Faults.

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of :attr:`COMMANDS`. Raises ValueError for a wrong one."""
        return run_command(self.COMMANDS, self, line.split())

    def report(self) -> dict[str, Any]:
        """Return what the arm does, and the last events."""
        return {**self.describe(), "events": self.controller.events, "now": self.controller.now, "lost": self.lost}

    def cut(self, until: float) -> None:
        """Close all connections, and accept none until a time, s on the monotonic clock."""
        self.cut_until = until
        for listener in self._listeners:
            self._selector.unregister(listener)
            listener.close()
        self._listeners = []
        for client in [client for client in self.clients if client.port != CONTROL_PORT]:
            self.drop(client)

    def refresh(self) -> None:
        """End all faults, and put the arm back where it began."""
        self._calm()
        self.controller = self.renew()


def take_lines(client: Client) -> list[str]:
    """Take the whole lines of what has come."""
    *lines, client.came = client.came.split(b"\n")
    return [line.decode(errors="replace").strip() for line in lines]


COMMANDS = (
    Command("lose SHARE", "leave out this share of the states", assign("losses.share", between(0.0, 1.0))),
    Command("late S", "send states so much later", assign("delay", between(0.0, 10.0))),
    Command("mute S", "answer no commands; states go on", assign("mute_until", read_end)),
    Command("silence S", "answer nothing and send nothing; the connections stay", assign("silent_until", read_end)),
    Command("cut S", "close all connections, and accept none", lambda arm, words: arm.cut(read_end(words[0]))),
    Command("refresh", "end all faults, and put the arm back where it began", lambda arm, _: arm.refresh()),
    Command("status", "what the arm does, and the last events", lambda arm, _: arm.report()),
)
"""Commands of every such emulator."""


def run_program(
    parser: argparse.ArgumentParser,
    arguments: Sequence[str] | None,
    driver: str,
    create: Callable[[argparse.Namespace], NetworkArm],
    describe: Callable[[NetworkArm], str],
) -> int:
    """Run the program of an emulator of this driver; return its exit status.

    ``create`` returns the emulator for the options of ``parser``, ``describe`` what it is and its ports, for the
    reader.
    """
    add = parser.add_argument
    add("--host", default="127.0.0.1", type=read_loopback, help="address to listen on, at fixed ports (%(default)s)")
    add(
        "--config",
        metavar="RIG",
        help="put the arm into the simulated world of this rig, whose objects its gripper meets (a name, or a path)",
    )
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    add("--seed", type=int, default=0, help="seed of all that is random (%(default)s)")
    options = parser.parse_args(arguments)
    try:
        with contextlib.ExitStack() as stack:
            ends = note_signals()
            server = create(options)
            stack.callback(server.close)
            if options.config is not None:
                arm = find_arm(options.config, options.set, driver, options.host)
                server.world = enter_world(stack, options.config, options.set, arm)
                server.has_gripper = arm.gripper is not None and arm.gripper.driver == driver
            gc.freeze()
            print(
                f"ready: {options.robot} at {options.host}, {describe(server)}, control {options.host}:{CONTROL_PORT}",
                flush=True,
            )
            serve_prompt(stack.enter_context(EmulatorControl(options.host)).send)
            server.run(ends)
    except (HalError, OSError, ValueError) as error:
        text = f"{options.host}: {error.strerror}" if isinstance(error, OSError) and error.strerror else error
        if isinstance(error, PermissionError):
            text = f"{text}: allow ports below 1024 with `sudo sysctl net.ipv4.ip_unprivileged_port_start=502`"
        print(f"error: {text}", file=sys.stderr)
        return 1
    return 0
