"""Drivers to copy: a gripper that knows its width only, and a pedal that is a dead-man (in ``pedal_rig.yaml``)."""

from __future__ import annotations

import socket
from pathlib import Path

from hal.driver import GamepadDriver, GripperDriver, GripperReading, PadReading
from hal.registry import DriverSpec

DRIVER = DriverSpec(name="hand_and_pedal", gripper="hand_and_pedal:Hand", gamepad="hand_and_pedal:Pedal")


class Hand(GripperDriver):
    """Two fingers without any feedback but their width."""

    def open(self) -> None:
        self.width = self.target = self.spec.width_max
        self.speed, self.t, self.seq = 0.0, None, 0

    def read(self, now: float) -> GripperReading:
        step = self.speed * (now - self.t) if self.t is not None else 0.0
        self.width += max(-step, min(step, self.target - self.width))
        self.t, self.seq = now, self.seq + 1
        moving = self.width != self.target
        return GripperReading(now, now, self.seq, self.width, self.target, moving, grasped=None, force=None)

    def move(self, width: float, speed: float, force: float) -> None:
        self.target, self.speed = width, speed

    def stop(self) -> None:
        self.target = self.width

    def close(self) -> None:
        self.stop()


class Pedal(GamepadDriver):
    """A foot switch that sends 0 or 1 to a local socket all the time. It is the button l2, and has no axes."""

    proves_liveness = True  # it streams: silence means that it is gone

    def open(self) -> None:
        Path(self.spec.options["path"]).unlink(missing_ok=True)
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(self.spec.options["path"])
        self.pressed, self.t_event, self.t_alive, self.seq = False, 0.0, -1.0, 0

    def poll(self, now: float, timeout: float) -> PadReading:
        self.socket.settimeout(max(timeout, 1e-4))
        try:
            pressed = self.socket.recv(16) == b"1"
        except TimeoutError:
            pass
        else:
            self.t_alive = now
            if pressed != self.pressed:
                self.pressed, self.t_event, self.seq = pressed, now, self.seq + 1
        buttons = frozenset({"l2"}) if self.pressed else frozenset()
        connected = now - self.t_alive < 0.5
        return PadReading(self.t_event, self.t_alive, self.t_event, self.seq, {}, buttons, connected)

    def close(self) -> None:
        self.socket.close()
