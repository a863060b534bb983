"""The console: the app's side of the page in a browser. The server is a process of its own (:mod:`.process`)."""

from __future__ import annotations

import secrets
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from hal.camera import Camera, RawFrame
from hal.driver import PadReading
from hal.errors import HalError
from hal.gamepad import Gamepad
from hal.host.frames import FrameRing
from hal.host.process import Child, SharedMemory
from hal.specs import CameraSpec, GroupSpec, to_json
from hal.types import Frame
from hal.views import Console, DrivingView, Listen, RecordingView

from .about import about_rig, shown_stream
from .addresses import is_loopback, link, names, tunnel
from .conversation import Conversation
from .messages import HANDS
from .pad import PadMail, WebPad, gone, reading
from .padmessage import ALARMS
from .recording import as_message

if TYPE_CHECKING:
    from hal.rig import Rig

__all__ = ["WebConsole"]

_TOKEN_BYTES = 18


class WebConsole(Console):
    """What an app tells its pages, and what it does for them.

    A console that does not listen (stopped, swapped out) holds up neither a camera nor the app: :mod:`.conversation`.
    """

    def __init__(self, rig: Rig, listen: Listen, *, driven_by: str | None) -> None:
        super().__init__(rig, listen, driven_by=driven_by)
        self._mails: list[PadMail] = []
        self._driver: str | None = None
        self._token = secrets.token_urlsafe(_TOKEN_BYTES)
        self._address, self._port = listen.address, listen.port
        self._watched: frozenset[str] = frozenset()
        self._waiting: tuple[str, ...] = ()
        self._loss = ("", "")
        """Why the pad was lost last, and whether that is an alarm; forgotten once it is back."""
        self._detach: list[Any] = []
        self._taken: Callable[[str], None] | None = None
        self._changed: Callable[[str, str | float], None] | None = None
        self._closed = False
        self._recovering = threading.Lock()
        groups = rig.shared_states()
        self._shown = [_reduced(camera) for camera in rig.plan.cameras if shown_stream(camera)]
        self._frames = SharedMemory(FrameRing.size(self._shown))
        self._ring = FrameRing(self._frames.buffer, self._shown)
        config = {
            "rig": about_rig(rig, self._shown, driven_by),
            "listen": [listen.address, listen.port],
            "port_fixed": listen.fixed,
            "token": self._token,
            "names": names(),
            "hosts": [_about_group(group.spec) for group in groups],
            "cameras": [to_json(camera) for camera in self._shown],
        }
        memories = [self._frames, *(group.memory for group in groups)]
        self._child = Child("console", "hal.drivers.web.process:main", config, memories)
        self._conversation = Conversation(self._child, self._take, self._is_lost)

    def wait_ready(self) -> None:
        ready = self._child.wait_ready()
        self._address, self._port = str(ready["address"]), int(ready["port"])
        self.notes = self._warnings()
        self._conversation.start()

    def _warnings(self) -> tuple[str, ...]:
        if is_loopback(self._address):
            return ()
        text = f"the console listens on {self._address}: whoever has the link, and whoever can listen in, "
        text += "can drive the REAL ARM" if self.rig.attended and not self.rig.emulated else "can drive"
        return (text + "; nothing on the way is encrypted (an ssh tunnel is: leave --listen out)",)

    # What it is.

    @property
    def link(self) -> str:
        return link(self._address, self._port, self._token)

    @property
    def tunnel(self) -> str:
        return tunnel(self._address, self._port) if is_loopback(self._address) else ""

    @property
    def driver(self) -> str | None:
        """The page that drives, by its name; None where none does."""
        return self._driver

    @property
    def stops(self) -> int:
        """How often ``rig.stop()`` was called, by whomever."""
        return self.rig.stop_count

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
        self._conversation.tell("say", t=time.monotonic(), text=text)

    def explain(self, labels: Mapping[str, Any]) -> None:
        self._conversation.tell("labels", labels=dict(labels))

    def show_driving(self, view: DrivingView) -> None:
        self._conversation.tell("driving", view=asdict(view))

    def show_playing(self, on: bool) -> None:
        """Tell the pages whether the recorded tour is being played."""
        self._conversation.tell("playing", on=on)
        if not on:
            self._say_loss("the tour has ended")

    def show_recording(self, view: RecordingView) -> None:
        self._conversation.tell_newest("recording", t=time.monotonic(), view=as_message(view))

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
        self._conversation.show(spec.name)

    # What it hears.

    def on_action(self, taken: Callable[[str], None]) -> None:
        self._taken = taken

    def on_setting(self, changed: Callable[[str, str | float], None]) -> None:
        self._changed = changed

    def _is_lost(self) -> None:
        self._driver = None
        self._put(gone(time.monotonic(), 0))
        print("the console has ended: no page can drive or stop any more; start the program again", file=sys.stderr)

    def _take(self, message: dict[str, Any]) -> None:
        if "pad" in message:
            pad = message["pad"]
            self._put(reading(pad, 0))
            if not pad["connected"]:
                self._say_loss(str(pad["why"]))
            else:
                self._loss = ("", "")
            self._say_what_is_waited_for()
        elif "stop" in message:
            self.rig.stop()
            page = message["stop"]
            self._conversation.tell("say", t=time.monotonic(), text=f"STOP was pressed on {page}", stop=page)
        elif "driver" in message:
            self._driver = message["driver"]
        elif "watched" in message:
            self._watched = frozenset(message["watched"])
        elif "recover" in message:
            self._start_recovery(str(message["recover"]), str(message["page"]))
        elif "demo" in message:
            self._play(bool(message["demo"]), str(message["page"]))
        elif "action" in message:
            self._act(str(message["action"]), str(message["page"]))
        elif "setting" in message and self._changed is not None:
            self._changed(str(message["setting"]), message["value"])

    def _say_loss(self, why: str) -> None:
        """Tell the pages why the pad was lost, and whether that was somebody's intention."""
        loss = "alarm" if why in ALARMS or why == HANDS else "calm"
        if (why, loss) != self._loss:
            self._conversation.tell("say", t=time.monotonic(), text=why, loss=loss)
        self._loss = (why, loss)

    def _start_recovery(self, robot: str, page: str) -> None:
        """One at a time, in a thread of its own: it may take long, and the pad must be heard meanwhile."""
        if not self._recovering.acquire(blocking=False):
            self._conversation.tell("refused", page=page, why="a robot is already being recovered")
            return
        try:
            threading.Thread(target=self._recover, args=(robot, page), name="hal-console-recover", daemon=True).start()
        except RuntimeError:
            self._recovering.release()
            raise

    def _recover(self, robot: str, page: str) -> None:
        try:
            self.rig.robots[robot].recover()
        except (HalError, OSError) as error:
            self._conversation.tell("refused", page=page, why=str(error))
        else:
            self.say(f"{robot} recovered by {page}: release the dead-man, then hold it again")
        finally:
            self._recovering.release()

    def _play(self, on: bool, page: str) -> None:
        pad = self._pad()
        if pad is None or (self.rig.attended and not self.rig.emulated):
            self._conversation.tell("refused", page=page, why="the tour plays in simulation only")
            return
        assert isinstance(pad.driver, WebPad)
        pad.driver.play(on)

    def _act(self, action: str, page: str) -> None:
        if self._taken is None:
            self._conversation.tell("refused", page=page, why="this program records nothing")
            return
        try:
            self._taken(action)
        except Exception:
            why = f"the program failed at {action!r}: see its own output"
            self._conversation.tell("refused", page=page, why=why)
            raise  # to be printed by whoever brought the message

    def _pad(self) -> Gamepad | None:
        return next((pad for pad in self.rig.gamepads.values() if isinstance(pad.driver, WebPad)), None)

    def _say_what_is_waited_for(self) -> None:
        pad = self._pad()
        waiting = pad.waiting_for if pad is not None else ()
        if waiting != self._waiting:
            self._waiting = waiting
            self._conversation.tell("waiting", controls=list(waiting))

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for detach in self._detach:
            detach()
        self._conversation.close()
        self._frames.close()


def _reduced(camera: CameraSpec) -> CameraSpec:
    stream = shown_stream(camera)
    assert stream is not None
    return replace(camera, streams=(stream,))


def _about_group(spec: GroupSpec) -> dict[str, Any]:
    return {
        "name": spec.name,
        "rate_hz": spec.rate_hz,
        "joints": [[robot.name, len(robot.joints)] for robot in spec.robots],
        "grippers": [gripper.name for gripper in spec.grippers],
        "gripper_of": {robot.name: robot.gripper.name for robot in spec.robots if robot.gripper is not None},
    }
