"""A served rig in this process, programs that drive it over a proxy, and what that proxy does to the frames."""

from __future__ import annotations

import json
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from waiting import wait_until

import hal
from hal.host.records import RobotMail, ServoRecord
from hal.remote.server import Server

ROOT = Path(__file__).parents[2]
PROGRAM = """
import json, select, sys, time
import hal
from hal.deadman import Deadman

def say(**what):
    print(json.dumps(what), flush=True)

deadman = Deadman("test") if sys.argv[2] == "deadman" else None
with hal.open({"robots": {"panda": {"at": sys.argv[1]}}}, pad="none") as rig:
    arm, host = rig.robots["panda"], rig._hosts[0]
    if deadman is not None:
        deadman.update(False, True, time.monotonic())
    with arm.control(rate_hz=5, deadman=deadman) as control:
        pressed = True
        say(link=host.child.process.pid)
        for tick in rig.clock.rate(100):
            if deadman is not None:
                deadman.update(pressed, True, time.monotonic())
            if select.select([sys.stdin], [], [], 0.0)[0]:
                word = sys.stdin.readline().strip()
                pressed = word != "release"
                if word == "rearm":
                    control.rearm()
                if word == "end":
                    break
                say(done=word)
            try:
                control.send(hal.JointVelocity([0.2, 0, 0, 0, 0, 0, 0]))
            except hal.MotionStopped as stop:
                say(stopped=stop.code)
            except hal.ConnectionLost as lost:
                say(lost=lost.code)
                break
"""
"""Drives the arm until it is told to end, holding its dead-man; says each stop."""
_HEADER = struct.Struct("<IQddd")


def start_server(*overrides: str, listen: str = "127.0.0.1:0") -> tuple[subprocess.Popen[str], str]:
    """Start ``hal serve --sim``, without cameras unless it is overridden; return its process and its address."""
    run = [sys.executable, str(ROOT / "apps" / "serve.py"), "--sim", "--listen", listen]
    run += [word for override in overrides or ["cameras={}"] for word in ("--set", override)]
    server = subprocess.Popen(run, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    line = next(line for line in server.stdout if line.startswith("listening at "))
    return server, line.removeprefix("listening at ").partition(",")[0]


class DrivingProgram:
    """A program that drives a served arm, in a process of its own."""

    def __init__(self, at: str, deadman: bool) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, at, "deadman" if deadman else "none"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.said: list[dict[str, Any]] = []
        threading.Thread(target=self._read, daemon=True).start()
        self.link: int = self.wait_for("link")

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(json.loads(line))

    def wait_for(self, key: str, value: Any = None) -> Any:
        """Wait until the program says something with this key, and this value; return its value."""

        def found() -> list[Any]:
            return [what[key] for what in self.said if key in what and value in (None, what[key])]

        wait_until(lambda: found() or self.process.poll() is not None, f"the program says {key}")
        assert found(), f"the program ended with {self.process.poll()}: {self.said}"
        return found()[-1]

    def tell(self, word: str) -> None:
        """Tell the program to do this, and wait until it has done it."""
        self.said.clear()
        assert self.process.stdin is not None
        print(word, file=self.process.stdin, flush=True)
        self.wait_for("done", word)


class Proxy:
    """Passes the frames of connections on, and does to them what networks do."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.at = f"127.0.0.1:{self._socket.getsockname()[1]}"
        self.delay = 0.0
        """Of each frame, s."""
        self.stalled = threading.Event()
        """While set, nothing is passed on; it comes afterwards."""
        self.trouble = 0.0
        """Share of the frames with records alone that are lost, as many that come twice, and as many out of order."""
        self._random = random.Random(1)
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                here, _ = self._socket.accept()
            except OSError:
                return
            there = socket.create_connection(("127.0.0.1", self._to))
            self._open += [here, there]
            for one, other in ((here, there), (there, here)):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                waiting: list[tuple[float, bytes]] = []
                threading.Thread(target=self._take, args=(one, waiting), daemon=True).start()
                threading.Thread(target=self._pass_on, args=(one, other, waiting), daemon=True).start()

    def _take(self, source: socket.socket, waiting: list[tuple[float, bytes]]) -> None:
        buffer = b""
        while True:
            try:
                data = source.recv(1 << 16)
            except OSError:
                data = b""
            if not data:
                waiting.append((0.0, b""))
                return
            buffer += data
            while len(buffer) >= _HEADER.size and len(buffer) >= (end := _HEADER.size + _HEADER.unpack_from(buffer)[0]):
                frame, buffer = buffer[:end], buffer[end:]
                self._queue(frame, waiting)

    def _queue(self, frame: bytes, waiting: list[tuple[float, bytes]]) -> None:
        due = time.monotonic() + self.delay
        what = self._random.random() if self.trouble and not _has_message(frame) else 1.0
        if what < self.trouble:
            return
        if what < 2 * self.trouble and waiting and not _has_message(waiting[-1][1]):
            waiting.insert(len(waiting) - 1, (due, frame))
            return
        waiting.append((due, frame))
        if what < 3 * self.trouble:
            waiting.append((due + 0.01, frame))

    def _pass_on(self, source: socket.socket, to: socket.socket, waiting: list[tuple[float, bytes]]) -> None:
        while True:
            while not waiting or waiting[0][0] > time.monotonic() or self.stalled.is_set():
                time.sleep(0.0005)
                if source.fileno() < 0:
                    return
            _, frame = waiting.pop(0)
            try:
                if not frame:
                    to.shutdown(socket.SHUT_RDWR)
                    return
                to.sendall(frame)
            except OSError:
                return

    def cut(self) -> None:
        """Close every connection."""
        for sock in self._open:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
            sock.close()
        self._open.clear()

    def close(self) -> None:
        """Close everything."""
        with suppress(OSError):  # a test has closed it
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self.cut()


def _has_message(frame: bytes) -> bool:
    offset = _HEADER.size + 2
    for _ in range(struct.unpack_from("<H", frame, _HEADER.size)[0]):
        offset += 12 + struct.unpack_from("<I", frame, offset + 8)[0]
    return offset < len(frame)


class Bench:
    """A served mock arm, and a proxy before it."""

    def __init__(self, rig: hal.Rig, server: Server, proxy: Proxy) -> None:
        self.rig, self.server, self.proxy = rig, server, proxy
        self.programs: list[DrivingProgram] = []

    def drive(self, deadman: bool = True) -> DrivingProgram:
        """Start a program, and return it when the arm moves."""
        self.programs.append(DrivingProgram(self.proxy.at, deadman))
        wait_until(lambda: self.speed() > 0.15, "the arm moves")
        return self.programs[-1]

    @property
    def mail(self) -> RobotMail:
        """The mailboxes of the arm, at its own host."""
        return self.rig.robots["panda"]._mail

    def servo(self) -> ServoRecord:
        """Return the newest state of the servo."""
        found = self.mail.peek()
        assert found is not None
        return found

    def speed(self) -> float:
        """Return the speed of the first joint's set-point, rad/s."""
        return abs(self.servo().dq_set[0])


@contextmanager
def serve_rig(rig: hal.Rig) -> Iterator[tuple[Server, Proxy]]:
    """Serve a rig of this process, and yield the server with a proxy before it."""
    server = Server(rig, "127.0.0.1", 0, lambda line: None)
    thread = threading.Thread(target=server.run)
    thread.start()
    proxy = Proxy(server.port)
    try:
        yield server, proxy
    finally:
        server.close()
        thread.join()
        proxy.close()


@contextmanager
def served_arm() -> Iterator[Bench]:
    """Serve a mock arm; close everything in the end."""
    overrides = {"cameras": {}, "gamepads": {}, "objects": []}
    with (
        hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=overrides) as rig,
        serve_rig(rig) as (server, proxy),
    ):
        bench = Bench(rig, server, proxy)
        try:
            yield bench
        finally:
            for program in bench.programs:
                program.process.kill()
                program.process.wait()
