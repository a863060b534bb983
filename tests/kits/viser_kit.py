"""A page of the 3D viewer without a browser: viser's protocol over a plain WebSocket."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect, unix_connect


def until(condition: Callable[[], Any], limit: float = 20.0) -> Any:
    """Return the condition's value once it is true."""
    deadline = time.monotonic() + limit
    while not (value := condition()):
        assert time.monotonic() < deadline, "time-out"
        time.sleep(0.01)
    return value


class PlainPage:
    """Says what a browser says that shows the 3D view, and keeps the received state."""

    def __init__(self, address: str, link: str = "") -> None:
        """Connect to the view's own socket at ``address``; with a ``link`` through the console that serves there."""
        options: dict[str, Any] = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None}
        options["close_timeout"] = 0.5  # what was not heard keeps a close waiting,
        options["max_queue"] = None  # and would keep pings unanswered
        if link:
            self.socket = connect(f"ws://{urlsplit(link).netloc}{address}", origin=link.partition("/#")[0], **options)
        else:
            self.socket = unix_connect(address, "ws://viser/", **options)
        self.nodes: dict[str, dict[str, Any]] = {}
        """Newest ``position``, ``wxyz``, ``visible``, and properties that changed, of each node, by name."""
        self.say(
            "ViewerCameraMessage",
            wxyz=(1, 0, 0, 0),
            position=(1, 1, 1),
            fov=1.0,
            near=0.1,
            far=10.0,
            image_height=10,
            image_width=10,
            look_at=(0, 0, 0),
            up_direction=(0, 0, 1),
        )

    def say(self, kind: str, **fields: Any) -> None:
        """Send one message."""
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def drag(self, name: str, *poses: tuple[tuple[float, ...], tuple[float, ...]], let_go: bool = True) -> None:
        """Grab a handle, drag it through poses of position and wxyz, and release it."""
        self.say("TransformControlsDragStartMessage", name=name)
        for position, wxyz in poses:
            self.say("TransformControlsUpdateMessage", name=name, position=position, wxyz=wxyz)
        if let_go:
            self.say("TransformControlsDragEndMessage", name=name)

    def hear(self) -> None:
        """Evaluate the received messages."""
        while True:
            try:
                frame = self.socket.recv(timeout=0.0)
            except TimeoutError:
                return
            assert isinstance(frame, bytes)
            size = int.from_bytes(frame[8:16], "little")
            inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])
            decoded = msgspec.msgpack.decode(inner)
            arrays, place = list[bytes](), 16 + size
            for length in decoded["binaryBufferLengths"]:
                place += -place % 8
                arrays.append(frame[place : place + length])
                place += length
            for message in decoded["messages"]:
                self._take(message, arrays)

    def _take(self, message: dict[str, Any], arrays: list[bytes]) -> None:
        kind, name = message["type"], message.get("name", "")
        if kind == "SetPositionMessage":
            self.nodes.setdefault(name, {})["position"] = message["position"]
        elif kind == "SetOrientationMessage":
            self.nodes.setdefault(name, {})["wxyz"] = message["wxyz"]
        elif kind == "SetSceneNodeVisibilityMessage":
            self.nodes.setdefault(name, {})["visible"] = message["visible"]
        elif kind == "SceneNodeUpdateMessage":
            for key, value in message["updates"].items():
                if isinstance(value, dict):
                    value = np.frombuffer(arrays[value["__binary_index"]], value["dtype"])
                self.nodes.setdefault(name, {})[key] = value

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()
