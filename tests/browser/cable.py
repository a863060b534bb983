"""A way to the console that can be cut."""

from __future__ import annotations

import asyncio
import socket
import threading
import time


class Cable:
    """A way to the console that can be cut like a cable: nothing is closed, nothing arrives any more."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._cut = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self.port = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._ready.wait(5.0)

    def _run(self) -> None:
        async def serve() -> None:
            server = await asyncio.start_server(self._forward, "127.0.0.1", 0, family=socket.AF_INET)
            self.port = server.sockets[0].getsockname()[1]
            self._ready.set()

        self._loop.run_until_complete(serve())
        self._loop.run_forever()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there_reader, there_writer = await asyncio.open_connection("127.0.0.1", self._target)

        async def pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
            while data := await source.read(65536):
                while self._cut.is_set():  # held back, as by a network that may yet come back
                    await asyncio.sleep(0.005)
                sink.write(data)
                await sink.drain()
            sink.close()

        await asyncio.gather(pump(reader, there_writer), pump(there_reader, writer), return_exceptions=True)

    def cut(self) -> float:
        self._cut.set()
        return time.monotonic()

    def mend(self) -> None:
        self._cut.clear()

    def close(self) -> None:
        self._cut.clear()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
