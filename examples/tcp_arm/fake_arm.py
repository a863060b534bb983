"""The other end of ``tcp_arm.py``: an arm that is always at its last set-point, with faults to switch on.

python examples/tcp_arm/fake_arm.py [PORT]        # at 127.0.0.1, until Ctrl-C
"""

from __future__ import annotations

import socket
import sys
import threading
import time
from contextlib import suppress

from tcp_arm import COMMAND, STATE

HOME = (0.0, 1.5, -1.2, 0.0, 0.8, 0.0)
CYCLE = 0.004
"""s"""
WATCHDOG = 25
"""Cycles without a set-point after which the arm stops by itself."""


class FakeArm:
    """An arm at 127.0.0.1. ``step`` runs one of its cycles, from a loop or from a test."""

    def __init__(self, port: int = 0) -> None:
        self.port, self.q, self.dq, self.seq, self.unheard = port, HOME, (0.0,) * 6, 0, WATCHDOG
        self.fault, self.silent, self.nan = 0, False, False
        """Number of a fault; whether its cable is pulled; whether its encoders report nonsense."""
        self.log: list[tuple[float, ...]] = []
        """The set-points that have come, q and dq."""
        self.client: socket.socket | None = None
        self.lock = threading.Lock()
        self.plug()

    def plug(self) -> None:
        self.server = socket.create_server(("127.0.0.1", self.port))
        self.port = self.server.getsockname()[1]
        threading.Thread(target=self.accept, args=(self.server,), daemon=True).start()

    def unplug(self) -> None:
        with self.lock, suppress(OSError):  # it is unplugged already
            self.server.shutdown(socket.SHUT_RDWR)
            self.server.close()
            if self.client is not None:
                self.client.close()
                self.client = None

    def accept(self, server: socket.socket) -> None:
        with suppress(OSError):  # unplugged
            while True:
                client, _ = server.accept()
                with self.lock:
                    client.setblocking(False)
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self.client, self.came = client, b""  # the newest one drives
                    self.report()

    def step(self) -> None:
        """Run one cycle: take what has come, watch for silence, report the state."""
        with self.lock:
            self.seq, self.unheard = self.seq + 1, self.unheard + 1
            with suppress(OSError, AttributeError):  # nothing came; nobody is connected
                self.came += self.client.recv(1 << 16)
            while self.client is not None and len(self.came) >= COMMAND.size:
                what, *numbers = COMMAND.unpack(self.came[: COMMAND.size])
                self.came = self.came[COMMAND.size :]
                self.obey(what, tuple(numbers))
            if self.unheard > WATCHDOG or self.fault:
                self.dq = (0.0,) * 6
            self.report()

    def obey(self, what: bytes, numbers: tuple[float, ...]) -> None:
        if what == b"P":
            self.log.append(numbers)
            if not self.fault:
                self.q, self.dq, self.unheard = numbers[:6], numbers[6:], 0
        else:
            self.dq, self.fault = (0.0,) * 6, 0 if what == b"C" else self.fault

    def report(self) -> None:
        if self.client is not None and not self.silent:
            q = (float("nan"), *self.q[1:]) if self.nan else self.q
            with suppress(OSError):  # it does not listen: the state is dropped
                self.client.send(STATE.pack(self.seq, round(1e3 * CYCLE * self.seq), self.fault, *q, *self.dq, *self.q))

    def run(self) -> None:
        while True:
            self.step()
            time.sleep(CYCLE)


if __name__ == "__main__":
    arm = FakeArm(int(sys.argv[1]) if len(sys.argv) > 1 else 4777)
    print(f"an arm at 127.0.0.1:{arm.port}", flush=True)
    with suppress(KeyboardInterrupt):
        arm.run()
