"""The console: the app's side of the page in a browser. The server is a process of its own (:mod:`.process`)."""

from __future__ import annotations

import contextlib
import queue
import secrets
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hal.camera import Camera, RawFrame
from hal.console import Console, Listen
from hal.errors import ConnectionLost, HalError, NotSupported
from hal.gamepad import Gamepad, PadReading
from hal.host.frames import FrameRing
from hal.host.hosts import RemoteHost
from hal.host.process import Channel, Child, SharedMemory
from hal.specs import CameraSpec, to_json
from hal.types import Frame

from .about import about_rig, shown_stream
from .addresses import is_loopback, link, names, tunnel
from .pad import PadMail, WebPad, gone, reading

if TYPE_CHECKING:
    from hal.rig import Rig

__all__ = ["WebConsole"]

_LOOK = 0.5
"""s between two looks whether the console's process is still there."""
_OUTGOING = 256
"""Messages that may wait for the console's process."""
_TOKEN_BYTES = 18


class WebConsole(Console):
    """The page, its process, and the two threads that talk with that.

    One thread hears the page's pad and its wishes. The other one tells: a console that does not listen (stopped,
    swapped out) must never hold up a camera or the app.
    """

    def __init__(self, rig: Rig, listen: Listen, *, driven_by: str | None) -> None:
        super().__init__(rig, listen, driven_by=driven_by)
        self._mails: list[PadMail] = []
        self._driver: str | None = None
        self._token = secrets.token_urlsafe(_TOKEN_BYTES)
        self._address, self._port = listen.address, listen.port
        self._watched: frozenset[str] = frozenset()
        self._waiting: tuple[str, ...] = ()
        self._detach: list[Any] = []
        self._closed = threading.Event()
        self._outgoing: queue.Queue[dict[str, Any] | None] = queue.Queue(_OUTGOING)
        self._threads: list[threading.Thread] = []
        hosts = [host for host in rig._hosts if isinstance(host, RemoteHost)]
        if len(hosts) != len(rig._hosts):
            raise NotSupported("the console shows a rig in real time only")
        self._shown = [_reduced(camera) for camera in rig.plan.cameras if shown_stream(camera)]
        self._frames = SharedMemory(FrameRing.size(self._shown))
        self._ring = FrameRing(self._frames.buffer, self._shown)
        config = {
            "rig": about_rig(rig, self._shown, driven_by),
            "listen": [listen.address, listen.port],
            "port_fixed": listen.fixed,
            "token": self._token,
            "names": names(),
            "hosts": [_host(host) for host in hosts],
            "cameras": [to_json(camera) for camera in self._shown],
        }
        memories = [self._frames, *(host.shared for host in hosts)]
        self._child = Child("console", "hal.drivers.web.process:main", config, memories)

    def wait_ready(self) -> None:
        ready = self._child.wait_ready()
        self._address, self._port = str(ready["address"]), int(ready["port"])
        self.notes = self._warnings()
        hear = threading.Thread(target=self._hear, name="hal-console-hear", daemon=True)
        tell = threading.Thread(target=self._tell, name="hal-console-tell", daemon=True)
        self._threads = [hear, tell]
        for thread in self._threads:
            thread.start()

    def _warnings(self) -> tuple[str, ...]:
        if is_loopback(self._address):
            return ()
        text = f"the console listens on {self._address}: whoever has the link, and whoever can listen in, "
        text += "can drive the REAL ARM" if self.rig.attended else "can drive"
        return (text + "; nothing on the way is encrypted (an ssh tunnel is: leave --listen out)",)

    # What it is.

    @property
    def link(self) -> str:
        return link(self._address, self._port, self._token)

    @property
    def tunnel(self) -> str:
        return tunnel(self._port) if is_loopback(self._address) else ""

    @property
    def driver(self) -> str | None:
        """The page that drives, by its name; None where none does."""
        return self._driver

    def subscribe(self) -> PadMail:
        """What the page does with its pad, from now on."""
        mail = PadMail()
        self._mails.append(mail)
        return mail

    def _put(self, found: PadReading) -> None:
        for mail in self._mails:
            mail.put(found)

    # What it tells.

    def say(self, text: str) -> None:
        self._send({"method": "say", "t": time.monotonic(), "text": text})

    def explain(self, labels: Mapping[str, Any]) -> None:
        self._send({"method": "labels", "labels": dict(labels)})

    def show_playing(self, on: bool) -> None:
        """Tell the pages whether the recorded tour is being played."""
        self._send({"method": "playing", "on": on})

    def show(self, camera: Camera) -> None:
        """Show this camera's frames to whoever watches it."""
        spec = next((spec for spec in self._shown if spec.name == camera.name), None)
        if spec is not None:
            self._detach.append(camera.on_frame(lambda frame: self._take_frame(spec, frame)))

    def _take_frame(self, spec: CameraSpec, frame: Frame) -> None:
        if spec.name not in self._watched:
            return
        stamp = frame.stamp
        layers = {name: getattr(frame, name) for name in spec.streams}
        raw = RawFrame(stamp.t, stamp.t_device, stamp.seq, None, None, None, None, None)._replace(**layers)
        self._ring.put(spec.name, raw)
        self._send({"method": "frame", "camera": spec.name})

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(queue.Full):  # it does not listen; what it missed is old by the time it does
            self._outgoing.put_nowait(message)

    def _tell(self) -> None:
        channel = Channel(self._child.channel.sock.dup())
        try:
            while (message := self._outgoing.get()) is not None:
                channel.send(message)
        except ConnectionLost:
            pass  # the hearing thread says so
        finally:
            channel.close()

    # What it hears.

    def _hear(self) -> None:
        try:
            while not self._closed.is_set():
                message = self._child.channel.receive(_LOOK)
                if message is not None:
                    self._take(message)
        except (ConnectionLost, OSError, ValueError):
            pass
        finally:
            self._driver = None
            self._put(gone(time.monotonic(), 0))
            if not self._closed.is_set():
                print("the console's process is gone: no page can drive or stop any more", file=sys.stderr)

    def _take(self, message: dict[str, Any]) -> None:
        if "pad" in message:
            pad = message["pad"]
            self._put(reading(pad, 0))
            if not pad["connected"]:
                self.say(f"the pad is gone: {pad['why']}")
            self._say_what_is_waited_for()
        elif "stop" in message:
            self.rig.stop()
            self.say(f"stopped by {message['stop']}")
        elif "driver" in message:
            self._driver = message["driver"]
        elif "watched" in message:
            self._watched = frozenset(message["watched"])
        elif "recover" in message:
            # It may take long, and the pad must be heard meanwhile.
            threading.Thread(target=self._recover, args=(message["recover"], message["page"]), daemon=True).start()
        elif "demo" in message:
            self._play(bool(message["demo"]), str(message["page"]))

    def _recover(self, robot: str, page: str) -> None:
        try:
            self.rig.robots[robot].recover()
        except (HalError, OSError) as error:
            self._send({"method": "refused", "page": page, "why": str(error)})
        else:
            self.say(f"{robot} recovered by {page}: release the dead-man and press it again")

    def _play(self, on: bool, page: str) -> None:
        pad = self._pad()
        if pad is None or self.rig.attended:
            self._send({"method": "refused", "page": page, "why": "the tour is played in simulation only"})
            return
        assert isinstance(pad.driver, WebPad)
        pad.driver.play(on)

    def _pad(self) -> Gamepad | None:
        return next((pad for pad in self.rig.gamepads.values() if isinstance(pad.driver, WebPad)), None)

    def _say_what_is_waited_for(self) -> None:
        pad = self._pad()
        waiting = pad.waiting_for if pad is not None else ()
        if waiting != self._waiting:
            self._waiting = waiting
            self._send({"method": "waiting", "controls": list(waiting)})

    def close(self) -> None:
        if self._closed.is_set():
            return
        self._closed.set()
        for detach in self._detach:
            detach()
        with contextlib.suppress(queue.Full):
            self._outgoing.put_nowait(None)
        self._child.close()
        for thread in self._threads:
            thread.join(timeout=1.0)
        self._frames.close()


def _reduced(camera: CameraSpec) -> CameraSpec:
    stream = shown_stream(camera)
    assert stream is not None
    return replace(camera, streams=(stream,))


def _host(host: RemoteHost) -> dict[str, Any]:
    spec = host.spec
    return {
        "name": spec.name,
        "rate_hz": spec.rate_hz,
        "joints": [[robot.name, len(robot.joints)] for robot in spec.robots],
        "grippers": [robot.name for robot in spec.robots if robot.gripper is not None],
    }
