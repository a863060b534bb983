"""The console: the app's side of the page in a browser. The server is a process of its own (:mod:`.process`).

:class:`WebConsole` is what a rig has as ``rig.console``; :class:`ProcessChannel` is its connection to that process,
which never makes the app wait.
"""

from __future__ import annotations

import contextlib
import re
import secrets
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from hal.auth import host_names, is_loopback, page_link, ssh_tunnel
from hal.camera import Camera
from hal.driver import RawFrame
from hal.errors import ConnectionLost, HalError
from hal.gamepad import Gamepad
from hal.host.process import Channel, Child, SharedMemory
from hal.host.ring import frame_rings, frame_rings_size
from hal.keys import find_credentials, needs_keys
from hal.pads.keyboard import keyboard_table
from hal.specs import CameraSpec, GroupSpec, RobotSpec, to_json
from hal.types import STREAMS, Frame
from hal.views import Console, DrivingView, Listen, RecordingView

from .messages import ALARMS, Outbox
from .pad import PadQueue, WebPad, pad_reading

if TYPE_CHECKING:
    from hal.rig import Rig

_TOKEN_BYTES = 18
_STREAMS = sorted(STREAMS, key=lambda name: STREAMS[name].exact)
"""A page shows the first of these streams that a camera has, and the others on request."""
_MAX_LINE = 300
"""Characters of a line; a page shows no more."""
_CHECK_PERIOD = 0.5
"""Time between two checks whether the channel is closed, in s."""
_SEND_TIME = 10.0
"""A process that reads nothing for so long is given up, in s."""
_MAX_MESSAGES = 256
"""Messages that may wait for the process; of more the oldest are dropped."""
_CLOSE_TIME = 2.0
"""Time for the process to end by itself, in s; it gives its pages one of them."""


class WebConsole(Console):
    """The console of a rig: shows the rig's state on pages, and carries out what pages request.

    A console's process that does not read (stopped, swapped out) delays neither a camera nor the app.
    """

    def __init__(self, rig: Rig, listen: Listen, *, driven_by: str | None) -> None:
        """Start the process; the arguments are those of :class:`~hal.views.Console`.

        Raises:
            NotSupported: In lock-step, where no person could drive by hand (``needs_real_time``).
        """
        super().__init__(rig, listen, driven_by=driven_by)
        self._queues: list[PadQueue] = []
        self.deadman = "l2"
        """Button that is the dead-man."""
        self._token = secrets.token_urlsafe(_TOKEN_BYTES)
        self._address, self._port = listen.address, listen.port
        self._tls = needs_keys(listen.address) and find_credentials("host") is not None
        self._watched: frozenset[str] = frozenset()
        self._waiting: tuple[str, ...] = ()
        self._loss = ("", "")
        """Reason for losing the pad last, and ``alarm`` or ``calm``; empty again once the pad is back."""
        self._detach: list[Any] = []
        self._action_handler: Callable[[str], None] | None = None
        self._setting_handler: Callable[[str, str | float], None] | None = None
        self._closed = False
        self._recovering = threading.Lock()
        groups = rig.shared_states()
        self._shown = [
            replace(camera, name=name, streams=(stream,))
            for camera in rig.plan.cameras
            for stream, name in _name_streams(camera).items()
        ]
        self._frames = SharedMemory(frame_rings_size(self._shown))
        self._rings = frame_rings(self._frames.buffer, self._shown)
        config = {
            "rig": _rig_message(rig, driven_by),
            "viewer": rig.viewer3d.address if rig.viewer3d is not None else "",
            "listen": [listen.address, listen.port],
            "port_fixed": listen.fixed,
            "tls": self._tls,
            "token": self._token,
            "names": host_names(),
            "keyboard": keyboard_table("browser")._asdict(),
            "hosts": [_group_message(group.spec) for group in groups],
            "cameras": [to_json(camera) for camera in self._shown],
        }
        memories = [self._frames, *(group.memory for group in groups)]
        self._child = Child("console", "hal.drivers.web.process:main", config, memories)
        self._channel = ProcessChannel(self._child, self._receive, self._process_lost)

    def wait_ready(self) -> None:
        ready = self._child.wait_ready()
        self._address, self._port = str(ready["address"]), int(ready["port"])
        self.notes = self._warnings()
        self._channel.start()

    def _warnings(self) -> tuple[str, ...]:
        if is_loopback(self._address):
            return ()
        who = "anyone who has the link" if self._tls else "anyone who has the link, or can read the network traffic,"
        what = "can drive the REAL ARM" if self.rig.attended and not self.rig.emulated else "can drive"
        remedy = "; nothing is encrypted: `hal keys make --host NAME`, or leave --listen out and use an ssh tunnel"
        return (f"the console listens on {self._address}: {who} {what}{'' if self._tls else remedy}",)

    @property
    def link(self) -> str:
        return page_link(self._address, self._port, self._token, self._tls)

    @property
    def tunnel(self) -> str:
        return ssh_tunnel(self._address, self._port) if is_loopback(self._address) else ""

    # The pad's side, see WebPad.

    @property
    def stop_count(self) -> int:
        """Number that grows with every ``rig.stop()``."""
        return self.rig.stop_count

    def subscribe(self, hand: str) -> PadQueue:
        """Return a queue that gets every reading of the page's pad, or of a hand of its headset, from now on."""
        queue = PadQueue(hand)
        self._queues.append(queue)
        return queue

    def show_playing(self, on: bool) -> None:
        """Show on the pages whether the recorded tour is playing."""
        self._channel.send("playing", on=on)
        if not on:
            self._report_loss("the tour has ended")

    def _put_pad(self, message: Mapping[str, Any]) -> None:
        for queue in self._queues:
            queue.put(pad_reading(message, queue.hand, self.deadman))

    # What pages show.

    def say(self, text: str) -> None:
        self._channel.send("say", t=time.monotonic(), text=name_buttons(text))

    def explain(self, labels: Mapping[str, Any]) -> None:
        self.deadman = str(labels["deadman"])
        self._channel.send("labels", labels=dict(labels))

    def show_driving(self, view: DrivingView) -> None:
        self._channel.send("driving", view=asdict(view))

    def show_recording(self, view: RecordingView) -> None:
        self._channel.send_newest("recording", "recording", t=time.monotonic(), view=recording_message(view))

    def show_camera(self, camera: Camera) -> None:
        names = _name_streams(camera.spec)
        self._detach.append(camera.on_frame(lambda frame: self._show_frame(names, frame)))

    def _show_frame(self, names: Mapping[str, str], frame: Frame) -> None:
        for stream, name in names.items():
            if name in self._watched:
                layer = {stream: getattr(frame, stream)}
                self._rings[name].write(RawFrame(frame.stamp.t, frame.stamp.t_device, frame.stamp.seq, **layer))
                self._channel.send_newest(f"frame {name}", "frame", camera=name)

    # What pages request.

    def on_action(self, taken: Callable[[str], None]) -> None:
        self._action_handler = taken

    def on_setting(self, changed: Callable[[str, str | float], None]) -> None:
        self._setting_handler = changed

    def _process_lost(self) -> None:
        self.driver = None
        self._put_pad({"connected": False, "t": time.monotonic()})
        print("the console has ended: no page can drive or stop any more; start the program again", file=sys.stderr)

    def _receive(self, message: dict[str, Any]) -> None:
        if "pad" in message:
            pad = message["pad"]
            self._put_pad(pad)
            if not pad["connected"]:
                self._report_loss(str(pad["why"]))
            else:
                self._loss = ("", "")
            self._send_waiting_controls()
        elif "stop" in message:
            self.rig.stop()
            page = message["stop"]
            self._channel.send("say", t=time.monotonic(), text=f"STOP was pressed on {page}", stop=page)
        elif "driver" in message:
            self.driver = message["driver"]
        elif "watched" in message:
            self._watched = frozenset(message["watched"])
        elif "recover" in message:
            self._start_recovery(str(message["recover"]), str(message["page"]))
        elif "demo" in message:
            self._play_tour(bool(message["demo"]), str(message["page"]))
        elif "action" in message and self._action_handler is not None:
            self._action_handler(str(message["action"]))
        elif "setting" in message and self._setting_handler is not None:
            self._setting_handler(str(message["setting"]), message["value"])

    def _report_loss(self, why: str) -> None:
        """Show on the pages why the pad was lost, once, and whether that was intended (calm) or not (alarm)."""
        loss = "alarm" if why in ALARMS else "calm"
        if (why, loss) != self._loss:
            self._channel.send("say", t=time.monotonic(), text=why, loss=loss)
        self._loss = (why, loss)

    def _start_recovery(self, robot: str, page: str) -> None:
        """Recover a robot in a thread of its own, one at a time: it may take long, and pad messages must not wait."""
        if not self._recovering.acquire(blocking=False):
            self._refuse(page, "a robot is already being recovered")
            return
        threading.Thread(target=self._recover, args=(robot, page), name="hal-console-recover", daemon=True).start()

    def _recover(self, robot: str, page: str) -> None:
        try:
            self.rig.robots[robot].recover()
        except (HalError, OSError) as error:
            self._refuse(page, str(error))
        else:
            self.say(f"{robot} recovered by {page}: release the dead-man, then hold it again")
        finally:
            self._recovering.release()

    def _play_tour(self, on: bool, page: str) -> None:
        pad = self._pad()
        if pad is None or (self.rig.attended and not self.rig.emulated):
            self._refuse(page, "the tour plays in simulation only")
            return
        assert isinstance(pad.driver, WebPad)
        pad.driver.play(on)

    def _refuse(self, page: str, why: str) -> None:
        self._channel.send("refused", page=page, why=name_buttons(why))

    def _pad(self) -> Gamepad | None:
        pads = [pad for pad in self.rig.gamepads.values() if isinstance(pad.driver, WebPad)]
        return next((pad for pad in pads if not pad.driver.spec.hand), None)

    def _send_waiting_controls(self) -> None:
        """Send the names of the controls that must be released first, if they changed."""
        pad = self._pad()
        waiting = pad.waiting_for if pad is not None else ()
        if waiting != self._waiting:
            self._waiting = waiting
            self._channel.send("waiting", controls=list(waiting))

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for detach in self._detach:
            detach()
        self._channel.close()
        self._frames.close()


class ProcessChannel:
    """The channel to the console's process, for an app that must never wait for it: one thread for each direction.

    If either direction breaks, the process is killed and ``lost`` is called once: a page must never look alive while
    its stop does not arrive.
    """

    def __init__(self, child: Child, receive: Callable[[dict[str, Any]], None], lost: Callable[[], None]) -> None:
        """``receive`` is called with every message of the process, in the receiving thread."""
        self._child = child
        self._receive = receive
        self._lost = lost
        self._changed = threading.Condition()
        self._waiting: Outbox[dict[str, Any]] = Outbox(most=_MAX_MESSAGES)
        self._over = False
        self._threads = [
            threading.Thread(target=self._receive_all, name="hal-console-receive", daemon=True),
            threading.Thread(target=self._send_all, name="hal-console-send", daemon=True),
        ]

    def start(self) -> None:
        """Start both threads, which have the channel from now on."""
        for thread in self._threads:
            thread.start()

    def send(self, method: str, **more: Any) -> None:
        """Queue a message; never waits."""
        with self._changed:
            while not self._waiting.put({"method": method, **more}):
                self._waiting.pop()
            self._changed.notify()

    def send_newest(self, kind: str, method: str, **more: Any) -> None:
        """Queue a message that replaces one of the same kind that still waits. Other messages come first."""
        with self._changed:
            self._waiting.put_newest(kind, {"method": method, **more})
            self._changed.notify()

    def _next(self) -> dict[str, Any] | None:
        message = None
        with self._changed:
            while not self._over and (message := self._waiting.pop()) is None:
                self._changed.wait()
        return message

    def _send_all(self) -> None:
        channel = Channel(self._child.channel.sock.dup())  # its own lock: a message that waits must not delay the close
        try:
            while (message := self._next()) is not None:
                channel.send(message, _SEND_TIME)
        except ConnectionLost:
            self._break()
        finally:
            channel.close()

    def _receive_all(self) -> None:
        try:
            while not self._over:
                message = self._child.channel.receive(_CHECK_PERIOD)
                if message is not None:
                    self._receive_safely(message)
        except (ConnectionLost, OSError, ValueError):
            pass
        finally:
            self._break()

    def _receive_safely(self, message: dict[str, Any]) -> None:
        try:
            self._receive(message)
        except Exception:  # an error in one message must not block the next one, which may be a stop
            traceback.print_exc(file=sys.stderr)

    def _break(self) -> None:
        with self._changed:
            if self._over:
                return
            self._over = True
            self._changed.notify_all()
        self._child.process.kill()
        self._lost()

    def close(self) -> None:
        """End the process, within a few seconds whatever it does. Idempotent."""
        with self._changed:
            self._over = True
            self._changed.notify_all()
        self._child.close(_CLOSE_TIME)
        for thread in self._threads:
            with contextlib.suppress(RuntimeError):  # it was never started
                thread.join(timeout=1.0)


# What the process and its pages get as JSON.


def _name_streams(camera: CameraSpec) -> dict[str, str]:
    """Return the name of each stream's pictures: that of the camera for the first one."""
    streams = [name for name in _STREAMS if name in camera.streams]
    return {stream: f"{camera.name}/{stream}" if k else camera.name for k, stream in enumerate(streams)}


def _rig_message(rig: Rig, driven_by: str | None) -> dict[str, Any]:
    """Return everything that does not change while the rig is open."""
    pads = [pad for pad in rig.plan.pads if pad.driver in ("auto", "web")]
    return {
        "source": rig.plan.source,
        "sim": rig.plan.sim,
        "emulated": rig.emulated,
        "stage": f"/3d/{secrets.token_urlsafe(_TOKEN_BYTES)}" if rig.viewer3d is not None else "",
        "drivable": driven_by is None,
        "driven_by": driven_by,
        "demo": driven_by is None and (rig.emulated or not rig.attended),
        "hands": sorted({pad.hand or "any" for pad in pads}),
        "pad_may_hold": not rig.attended or any(pad.options.get("accept_silent_pad") is True for pad in pads),
        "robots": [_robot_message(robot) for robot in rig.plan.robots],
        "cameras": [
            {name: getattr(camera, name) for name in ("name", "width", "height", "rate_hz")}
            | {"streams": _name_streams(camera), "depth": [camera.depth_min, camera.depth_max]}
            for camera in rig.plan.cameras
        ],
    }


def _robot_message(robot: RobotSpec) -> dict[str, Any]:
    return {
        "name": robot.name,
        "model": robot.model,
        "real": robot.attended,
        "driver": robot.driver,
        "joints": list(robot.joints),
        "lower": list(robot.limits.lower),
        "upper": list(robot.limits.upper),
        "tcp_speed": robot.tcp_speed,
        "widths": [robot.gripper.width_min, robot.gripper.width_max] if robot.gripper is not None else None,
    }


def _group_message(spec: GroupSpec) -> dict[str, Any]:
    return {
        "name": spec.name,
        "rate_hz": spec.rate_hz,
        "joints": [[robot.name, len(robot.joints)] for robot in spec.robots],
        "grippers": [gripper.name for gripper in spec.grippers],
        "gripper_of": {robot.name: robot.gripper.name for robot in spec.robots if robot.gripper is not None},
    }


def name_buttons(text: str) -> str:
    """Return a text for pages, whose button does what a program calls ``robot.recover()`` for."""
    return re.sub(r"(call )?robot\.recover\(\)", 'press "Recover"', text)


def recording_message(view: RecordingView) -> dict[str, Any]:
    """Return a recording's view as JSON; its numbers may be numpy's.

    Raises:
        TypeError, ValueError: A field that must be a number is not one.
    """
    texts = {name: _line(getattr(view, name)) for name in ("prompt", "task", "trouble")}
    numbers = ("episode", "saved", "wanted", "succeeded", "failed", "discarded", "frames", "dropped", "free_bytes")
    counts = {name: int(getattr(view, name)) for name in numbers}
    seconds = round(float(view.seconds), 2)
    return {"phase": view.phase, **texts, **counts, "seconds": seconds, "actions": list(view.actions)}


def _line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _MAX_LINE else line[: _MAX_LINE - 1] + "…"
