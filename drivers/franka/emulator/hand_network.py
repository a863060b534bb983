"""The emulated hand's sockets: one client on TCP, states by UDP."""

from __future__ import annotations

import contextlib
import math
import selectors
import socket

from .hand_wire import HandState, Request, Requests

__all__ = ["Client", "HandNetwork"]


class Client:
    """A client that is connected: what it says, and the answers that it waits for."""

    def __init__(self, sock: socket.socket, ip: str) -> None:
        self.sock = sock
        self.ip = ip
        self.udp_port: int | None = None
        """Where it wants its states; known once it has said CONNECT."""
        self._requests = Requests()
        self._answers: list[tuple[float, bytes]] = []
        """When each is due on the monotonic clock, in order."""
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def hear(self) -> list[Request]:
        """What it asks for now. OSError when it hung up, ValueError for what no client says."""
        data = self.sock.recv(4096)
        if not data:
            raise ConnectionResetError("the client hung up")
        return list(self._requests.feed(data))

    def answer(self, data: bytes, due: float) -> None:
        """Answer at the time ``due``."""
        self._answers.append((due, data))
        self._answers.sort(key=lambda answer: answer[0])

    @property
    def due(self) -> float:
        """When the next answer must go."""
        return self._answers[0][0] if self._answers else math.inf

    def send_due(self, now: float) -> None:
        """Send the answers that are due. OSError when it is gone."""
        while self.due <= now:
            self.sock.sendall(self._answers.pop(0)[1])  # a few bytes: a socket's buffer has always room for them


class HandNetwork:
    """A listener and at most one client. Assumption: a second client is let in and hung up on at once."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_out.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._wake_in, selectors.EVENT_READ)
        self._listener: socket.socket | None = None
        self._udp: socket.socket | None = None
        self.client: Client | None = None

    @property
    def listening(self) -> bool:
        """Can a client come?"""
        return self._listener is not None

    def listen(self) -> None:
        """Let clients come. OSError where the address is taken."""
        self._listener = socket.create_server(self._address)
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((self._address[0], 0))

    def wake(self) -> None:
        """End a :meth:`wait` in another thread."""
        with contextlib.suppress(OSError):
            self._wake_out.send(b"!")

    def wait(self, timeout: float) -> list[selectors.SelectorKey]:
        """Sleep until something came, for at most ``timeout`` s. Only this may run without the lock."""
        return [key for key, _ in self._selector.select(timeout)]

    def take(self, keys: list[selectors.SelectorKey]) -> list[Request]:
        """What the client asks for, after a :meth:`wait`."""
        requests: list[Request] = []
        sources = [key.fileobj for key in keys]
        for source in sources:
            if source is self._wake_in:
                self._wake_in.recv(64)
            elif self.client is not None and source is self.client.sock:
                try:
                    requests += self.client.hear()
                except (OSError, ValueError):  # it hung up, or is no client of a hand
                    self.hang_up()
        if self._listener is not None and self._listener in sources:  # last: the one before may just have hung up
            self._welcome(self._listener)
        return requests

    def _welcome(self, listener: socket.socket) -> None:
        try:
            sock, (ip, _) = listener.accept()
        except OSError:  # gone again
            return
        if self.client is not None:
            sock.close()
            return
        self.client = Client(sock, ip)
        self._selector.register(sock, selectors.EVENT_READ)

    def send_answers(self, now: float) -> None:
        """Those that are due."""
        if self.client is not None:
            try:
                self.client.send_due(now)
            except OSError:
                self.hang_up()

    def send_state(self, state: HandState) -> None:
        """To the client, if there is one."""
        client = self.client
        if client is not None and client.udp_port is not None and self._udp is not None:
            with contextlib.suppress(OSError):
                self._udp.sendto(state.pack(), (client.ip, client.udp_port))

    def hang_up(self) -> None:
        """End the client's connection, if there is one."""
        client, self.client = self.client, None
        if client is not None:
            self._selector.unregister(client.sock)
            client.sock.close()

    def shut(self) -> None:
        """Hang up, and let nobody come."""
        self.hang_up()
        listener, self._listener = self._listener, None
        if listener is not None:
            self._selector.unregister(listener)
            listener.close()
        if self._udp is not None:
            self._udp.close()

    def close(self) -> None:
        """For good."""
        self.shut()
        self._selector.close()
        self._wake_in.close()
        self._wake_out.close()
