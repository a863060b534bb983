"""The console's process with everything around it, for tests: an app and pages that are played by hand."""

from __future__ import annotations

import asyncio
import os
import ssl
import struct
import time
from collections.abc import Callable
from typing import Any

import aiohttp
import numpy as np

from hal.commands import DeadmanRecord
from hal.driver import GripperReading, RawFrame, Reading
from hal.host.process import Child, SharedMemory
from hal.host.records import GroupMemory, ServoRecord
from hal.host.ring import frame_rings, frame_rings_size
from hal.pads.keyboard import keyboard_table
from hal.specs import CameraSpec, to_json
from hal.testing import camera_spec
from hal.types import PAGE_AXES, STREAMS, Limited, RobotStatus, Trip

TOKEN = "a-token-of-the-test_0123456789"
JOINTS = [("arm", 3)]
GRIPPERS = ["arm.gripper"]
REST = [0.0] * len(PAGE_AXES)
WAIT = 20.0
"""s after which something that never comes is missed."""
HEADER = struct.Struct("<BBHIdf")


def camera(name: str, width: int = 64, height: int = 48, stream: str = "color", rate_hz: float = 30.0) -> CameraSpec:
    """Return a camera whose ring holds one stream."""
    size = {"width": width, "height": height, "rate_hz": rate_hz}
    return camera_spec(name=name, **size, depth_min=0.2, depth_max=2.2, streams=(stream,), view=None)


def frame(spec: CameraSpec, value: float, t: float | None = None) -> RawFrame:
    """A picture of one colour, or depth."""
    flat = (spec.height, spec.width)
    images: dict[str, Any] = {}
    (stream,) = spec.streams
    images[stream] = np.full((*flat, *STREAMS[stream].shape), value, STREAMS[stream].dtype)
    now = time.monotonic() if t is None else t
    return RawFrame(now, now, 0, **images)


class App:
    """The app's side of the channel, and of the memory."""

    def __init__(
        self,
        *cameras: CameraSpec,
        rig: dict[str, Any] | None = None,
        target: str = "hal.drivers.web.process:main",
        **config: Any,
    ) -> None:
        self.cameras = {spec.name: spec for spec in cameras}
        self.ring_memory = SharedMemory(frame_rings_size(cameras))
        self.rings = frame_rings(self.ring_memory.buffer, cameras)
        self.host_memory = SharedMemory(GroupMemory.size(JOINTS, GRIPPERS))
        self.group = GroupMemory(self.host_memory.buffer, JOINTS, GRIPPERS)
        known = {
            "source": "test",
            "sim": True,
            "drivable": True,
            "driven_by": None,
            "demo": True,
            "stage": "",
        }
        settings = {
            "viewer": "",
            "rig": {**known, "robots": [{"name": "arm"}], "cameras": [], **(rig or {})},
            "listen": ["127.0.0.1", 0],
            "port_fixed": False,
            "tls": False,
            "token": TOKEN,
            "names": ["testbench"],
            "keyboard": keyboard_table("browser")._asdict(),
            "hosts": [
                {
                    "name": "group",
                    "rate_hz": 240.0,
                    "joints": JOINTS,
                    "grippers": GRIPPERS,
                    "gripper_of": {"arm": "arm.gripper"},
                }
            ],
            "cameras": [to_json(spec) for spec in cameras],
            **config,
        }
        memories = [self.ring_memory, self.host_memory]
        self.child = Child("console", target, settings, memories)
        ready = self.child.wait_ready(30.0)
        self._log = os.dup(self.child._log.fileno())
        self.port = int(ready["port"])
        self.tls: ssl.SSLContext | bool = True
        """What pages trust."""
        self.url = f"http{'s' * settings['tls']}://{settings['listen'][0]}:{self.port}"

    def __enter__(self) -> App:
        return self

    def __exit__(self, *error: object) -> None:
        self.child.close()
        self.ring_memory.close()
        self.host_memory.close()
        with os.fdopen(self._log, "rb") as log:
            log.seek(0)
            said = log.read().decode()
        assert said == "", f"the console's process complained: {said}"

    def send(self, method: str, **more: Any) -> None:
        """Say something to the console."""
        self.child.channel.send({"method": method, **more})

    def show(self, camera: str, value: float, t: float | None = None) -> None:
        """A new picture of one colour."""
        self.rings[camera].write(frame(self.cameras[camera], value, t))
        self.send("frame", camera=camera)

    async def next(self, wanted: Callable[[dict[str, Any]], bool] = lambda message: True) -> dict[str, Any]:
        """The next message that is wanted; those before it are dropped."""
        deadline = time.monotonic() + WAIT
        while time.monotonic() < deadline:
            message = self.child.channel.poll()
            if message is not None and wanted(message):
                return message
            if message is None:
                await asyncio.sleep(0.001)
        raise AssertionError("the app was never told")

    async def all_until(self, wanted: Callable[[dict[str, Any]], bool]) -> list[dict[str, Any]]:
        """Every message up to the one that is wanted, in order."""
        seen: list[dict[str, Any]] = []

        def note(message: dict[str, Any]) -> bool:
            seen.append(message)
            return wanted(message)

        await self.next(note)
        return seen

    async def pad(self) -> dict[str, Any]:
        """The next word on the pad."""
        return dict((await self.next(lambda message: "pad" in message))["pad"])

    def put_state(self, t: float, q: float = 0.5, status: RobotStatus = RobotStatus.FOLLOWING, **reading: Any) -> None:
        """The arm's state as its host would write it."""
        n = JOINTS[0][1]
        mail = self.group.robots["arm"]
        servo = ServoRecord(status, Trip.NONE, Limited.SPEED, 0, 1, False, 0, t, t, (0.25,) * n, (0.0,) * n)
        tcp = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)
        mail.put_state(Reading(t, t, 1, (q,) * n, (0.0,) * n, **reading), servo, tcp, tcp, (0.0,) * 6)
        self.group.grippers["arm.gripper"].put(GripperReading(t, t, 1, 0.04, 0.08, True, None))
        mail.put_deadman(DeadmanRecord(True, True, 1, t))
        self.group.host.write(t, 1000, 3, True)


class Page:
    """A page, as far as the server can tell. ``async with`` opens its socket."""

    def __init__(self, app: App, path: str = "/live", token: str = TOKEN, **headers: str) -> None:
        self.app = app
        self._path = path
        self._protocols = ("hal.v1", token)
        self._headers = {"Origin": app.url, **headers}
        self.seen = 0.0
        self.at = 0.0
        self.name = ""

    async def __aenter__(self) -> Page:
        self._session = aiohttp.ClientSession()
        try:
            self.ws = await self._session.ws_connect(
                self.app.url + self._path, protocols=self._protocols, headers=self._headers, ssl=self.app.tls
            )
        except aiohttp.ClientError:
            await self._session.close()
            raise
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.ws.close()
        await self._session.close()

    async def say(self, **message: Any) -> None:
        await self.ws.send_json(message)

    async def next(self, kind: str) -> dict[str, Any]:
        """The next message of this type."""
        while True:
            message = await self.ws.receive(WAIT)
            assert message.type is aiohttp.WSMsgType.TEXT, f"{message.type}: {message.data}"
            data = message.json()
            if data["type"] == "beat" or (data["type"] == "lease" and data["you"]):
                self.seen, self.at = data["t"], time.monotonic()
            if data["type"] == kind:
                return dict(data)

    async def closed(self) -> int:
        """Wait until the server closes; its code."""
        while True:
            message = await self.ws.receive(WAIT)
            if message.type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR):
                assert self.ws.close_code is not None
                return self.ws.close_code

    async def take(self) -> None:
        """Take the lease, and wait until it is there."""
        await self.say(type="lease", take=True)
        while not (await self.next("lease"))["you"]:
            pass

    def pad(self, axes: list[float] = REST, buttons: int = 0, age: float = 0.0) -> dict[str, Any]:
        """A pad message that was sent ``age`` s ago, and was under way since."""
        since = max(0.0, time.monotonic() - self.at - age) * 1000.0
        return {"type": "pad", "seen": self.seen, "since": since, "axes": axes, "buttons": buttons, "hands": {}}

    async def drive(self, axes: list[float] = REST, buttons: int = 0) -> None:
        """One pad message, and its beat."""
        await self.ws.send_json(self.pad(axes, buttons))
        await self.next("beat")
