"""Emulated Frankas for tests: each a process of its own at a loopback address of its own.

with Emulator("--lockstep", robot="fr3") as emulator:     # ready when the line is through
    ...                                                   # connect anything to emulator.host
    emulator.control.send("reflex joint_reflex")
    emulator.wait_event("motion ended")
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hal_emulators.control import EmulatorControl

LIBRARIES = {"fr3": "pylibfranka", "panda": "panda_py"}
"""The vendor's library of each robot."""
PORTS = (1337, 1338, 1339)
START_LIMIT = 60.0
END_LIMIT = 15.0


_hosts = itertools.cycle(range(1, 251))


def free_host(ports: Sequence[int] = PORTS) -> str:
    """Return a loopback address where these ports are free, which this process has not used yet, and no other one uses.

    A new address each time: the process of an arm that a test left behind may still hold the lock on the old one.
    """
    block = f"127.{1 + os.getpid() // 256 % 250}.{os.getpid() % 256}"
    for last in itertools.islice(_hosts, 250):
        host = f"{block}.{last}"
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for port in ports:
                listener = stack.enter_context(socket.socket())
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind((host, port))
            return host
    raise RuntimeError(f"no free address in {block}.x")


class Client:
    """A client of a robot that speaks the protocol by hand."""

    def __init__(self, host: str, version: int = 10) -> None:
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind(("127.0.0.1", 0))
        self.udp.settimeout(15.0)
        self.tcp = socket.create_connection((host, PORTS[0]), 15.0)
        self.send(0, struct.pack("<HH", version, self.udp.getsockname()[1]))

    def send(self, code: int, payload: bytes) -> None:
        """Send a request."""
        self.tcp.sendall(struct.pack("<III", code, 1, 12 + len(payload)) + payload)

    def reply(self) -> bytes:
        """Return the next response, without its header."""
        head = self.tcp.recv(12, socket.MSG_WAITALL)
        return self.tcp.recv(struct.unpack("<III", head)[2] - 12, socket.MSG_WAITALL)

    def close(self) -> None:
        """Disconnect."""
        self.tcp.close()
        self.udp.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Emulator:
    """A running emulator. ``options`` are those of its command line; without ``hand`` it serves only the arm."""

    def __init__(self, *options: str, robot: str = "fr3", host: str | None = None, hand: bool = False) -> None:
        """Start it, and wait until it is ready. Raises RuntimeError, with its output, if it is not in time."""
        self.host = host or free_host()
        self.lines: list[str] = []
        """Its output so far."""
        self._ready = threading.Event()
        command = [sys.executable, "-m", "hal_emulators.franka", "--robot", robot, "--host", self.host, *options]
        if not hand:
            command.append("--no-hand")
        began = time.monotonic()
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if not self._ready.wait(START_LIMIT) or not any("ready:" in line for line in self.lines):
            self.process.kill()
            self.process.wait()
            raise RuntimeError("the emulator did not get ready:\n" + "\n".join(self.lines))
        self.start_time = time.monotonic() - began
        """Time from the start of the process to its "ready", s."""
        self.control = EmulatorControl(self.host)

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if "ready:" in line:
                self._ready.set()
        self._ready.set()

    def type(self, line: str) -> None:
        """Type a line into its standard input."""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def events(self, kind: str | None = None) -> list[dict[str, Any]]:
        """Return its last events, of one kind or of any."""
        events: list[dict[str, Any]] = self.control.send("log 1000")["events"]
        return [event for event in events if kind in (None, event["kind"])]

    def wait_event(self, kind: str, after: int = 0, timeout: float = 30.0) -> dict[str, Any]:
        """Return the first event of a kind with a number above ``after``. Raises TimeoutError if there is none."""
        deadline = time.monotonic() + timeout
        while True:
            for event in self.events(kind):
                if event["n"] > after:
                    return event
            if time.monotonic() > deadline:
                raise TimeoutError(f"no event {kind!r}; there were: {[event['text'] for event in self.events()]}")
            time.sleep(0.005)

    def refresh(self) -> None:
        """Reset it to the state after switching on, at home, for tests that share one."""
        self.control.send("restart")
        self.control.send("place")
        self.control.send("reset-stats")

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send it a signal, and return its exit status."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(number)
        return self.process.wait(END_LIMIT)

    def close(self) -> None:
        """End it in any state."""
        self.control.close()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(END_LIMIT)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join(END_LIMIT)
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def run_client(robot: str, scenario: str, host: str, timeout: float = 60.0, **arguments: object) -> dict[str, Any]:
    """Run one scenario of ``franka_client.py`` in a process of its own, and return its report.

    The vendor's libraries block all Python threads, and change the scheduling of the thread that constructs a robot,
    so they stay out of the tests' process. Raises subprocess.TimeoutExpired if the script hangs, and RuntimeError with
    its output if it fails.
    """
    script = Path(__file__).with_name("franka_client.py")
    command = [sys.executable, str(script), LIBRARIES[robot], scenario, host, json.dumps(arguments)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout)
    if done.returncode != 0:
        raise RuntimeError(f"{robot} {scenario} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


@contextlib.contextmanager
def shared(*options: str, robot: str) -> Iterator[Emulator]:
    """An emulator for a module; fails if it ended before the module."""
    with Emulator(*options, robot=robot) as emulator:
        yield emulator
        assert emulator.process.poll() is None, "\n".join(emulator.lines)
