"""Emulated UR controller: registers, the script that ur_rtde uploads, safety, and the state that RTDE reports.

What a command does is what ``process_cmd`` of the uploaded script does with it (ur_rtde 1.6.5); of other commands only
the handshake is played.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hal_emulators.network_arm import NetworkController

from .motion import ROBOTS, TargetMotion, forward, parameters

__all__ = ["POWER_OFF", "RUNNING", "Controller"]

STOPPED, PLAYING, PAUSED = 1, 2, 4
"""``runtime_state``."""
RUNNING, IDLE, POWER_OFF = 7, 5, 3
"""``robot_mode``."""
NORMAL, PROTECTIVE_STOP, SAFEGUARD_STOP, EMERGENCY_STOP = 1, 3, 5, 7
"""``safety_mode``."""
_SAFETY_BITS = {NORMAL: 0x1, PROTECTIVE_STOP: 0x404, SAFEGUARD_STOP: 0x410, EMERGENCY_STOP: 0x4C0}
_REALTIME = frozenset({24, 11, 9, 10, 6, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that the script's main loop repeats while they stay in the register."""
_START = 0.05
"""From the end of an upload to the first cycle of the program, s; chosen."""
_UNLOCK = 5.0
"""A protective stop cannot be unlocked earlier, s (UR's manual)."""
_PROGRAM_STOP, _PROTECTIVE_DECELERATION = 8.0, 30.0
"""Deceleration of a program that ends, and of a protective stop, rad/s2; chosen."""


class Controller(NetworkController):
    """One controller with its arm. ``step`` lets a cycle pass."""

    def __init__(self, robot: str, q: Sequence[float]) -> None:
        self.robot, self.dh = robot, parameters(robot)
        self.rate = ROBOTS[robot][2]
        super().__init__(1.0 / self.rate)
        self.motion = TargetMotion(q, self.dt)
        self.version = (5, 15, 0, 0) if self.rate == 500 else (3, 15, 0, 0)
        self.remote = True
        self.robot_mode, self.safety_mode = RUNNING, NORMAL
        self.payload, self.cog, self.tcp = 0.0, [0.0] * 3, [0.0] * 6
        self.inputs: dict[str, float] = {}
        """Registers that clients write."""
        self.outputs: dict[str, float] = {}
        """Registers that the program writes."""
        self.program = ""
        """Name of the program that is running."""
        self.paused = False
        """Whether the program is paused."""
        self.force = [0.0] * 6
        """What pushes the arm, N and Nm in the controller's base."""
        self.stuck = False
        """Whether it ignores set-points of ``servoj``."""
        self.jump = 0.0
        """By how much the next one is off, rad."""
        self.offset = 0
        self._starts: tuple[float, str, int] | None = None
        self._watchdog: float | None = None
        self._t_written = self._t_protective = 0.0
        self._busy: Callable[[], bool] | None = None
        """Whether the command that blocks the script is over."""
        self._executing = False

    @property
    def joints(self) -> Sequence[float]:
        return self.motion.actual_q

    # Programs.

    def upload(self, text: str) -> None:
        found = re.search(r"^\s*def\s+(\w+)", text)
        if found is None:
            return
        if not self.remote or self.robot_mode != RUNNING or self.safety_mode != NORMAL:
            self.note("script refused")
            return
        self.stop_program("replaced")
        offset = re.search(r"int register offset\s+(\d+)", text)
        self._starts = self.now + _START, found[1], int(offset[1]) if offset else 0

    def stop_program(self, why: str) -> None:
        """End the program that is running: the arm comes to rest."""
        self._starts, self._watchdog, self._busy, self._executing = None, None, None, False
        if self.program:
            self.note(f"program {self.program} stopped: {why}")
            self.program, self.paused = "", False
            self.motion.stop(_PROGRAM_STOP)

    def write_inputs(self, values: dict[str, float]) -> None:
        self.inputs.update(values)
        if f"input_int_register_{self.offset}" in values:
            self._t_written = self.now

    def calibrate(self, seed: int) -> None:
        """Have other lengths and angles, as a factory calibration finds them: how large they are is chosen."""
        spread = np.array([5e-4, 3e-4, 3e-4, 5e-4])[:, None]
        self.dh = parameters(self.robot) + np.random.default_rng(seed).normal(0.0, spread, (4, 6))

    def pack_kinematics(self) -> bytes:
        """Return the message of the primary interface with the kinematics, whose checksums are 0 here."""
        return struct.pack(">iBiB6I24dI", 230, 16, 225, 5, *[0] * 6, *self.dh.flat, 0)

    # Safety.

    def stop_protective(self, why: str) -> None:
        """Stop with a protective stop; it ends the program."""
        if self.safety_mode == NORMAL:
            self.note(f"protective stop: {why}")
            self.safety_mode, self._t_protective = PROTECTIVE_STOP, time.monotonic()
            self.stop_program("protective stop")
            self.motion.stop(_PROTECTIVE_DECELERATION)

    def set_safety(self, mode: int) -> None:
        """Be in a mode of the safety system; 4, 8 and 9 are recovery, violation and fault, 6 the system's stop."""
        self.safety_mode = mode
        if mode != NORMAL:
            self.stop_program(f"safety mode {mode}")
            self.motion.stop(_PROTECTIVE_DECELERATION)

    def stop_emergency(self, pressed: bool) -> None:
        """Press or release the emergency stop; once released, the power is off."""
        self.safety_mode = EMERGENCY_STOP if pressed else NORMAL
        self.robot_mode = POWER_OFF
        self.stop_program("emergency stop")
        self.motion.stop(_PROTECTIVE_DECELERATION)
        self.note("emergency stop " + ("pressed" if pressed else "released"))

    def set_safeguard(self, active: bool) -> None:
        """Switch the safeguard stop (a light curtain) on or off: it pauses a program, which then goes on by itself."""
        if self.safety_mode in (NORMAL, SAFEGUARD_STOP):
            self.safety_mode = SAFEGUARD_STOP if active else NORMAL
            self.pause(active)

    def pause(self, paused: bool) -> None:
        """Pause the program, or let it go on, as at the pendant."""
        self.paused, self._t_written = paused and bool(self.program), self.now
        if paused:
            self.motion.stop(_PROGRAM_STOP)

    def push(self, force: Sequence[float]) -> None:
        """Push the arm with a force (3,), N in the controller's base."""
        self.force = [*force, 0.0, 0.0, 0.0]

    def jog(self, joint: int, angle: float) -> None:
        """Move a joint by hand, rad. Raises ValueError while a program runs."""
        if self.program:
            raise ValueError("a program is running")
        self.motion.place([q + angle * (k == joint) for k, q in enumerate(self.motion.q)])

    def set_remote(self, remote: bool) -> None:
        """Switch between remote and local control; a switch to local ends a program that was sent."""
        self.remote = remote
        if not remote:
            self.stop_program("local control")

    def answer_dashboard(self, line: str) -> str:
        e_series = self.version[0] == 5
        answers = {
            "polyscopeversion": f"URSoftware {'.'.join(map(str, self.version))} (Jun 01 2024)",
            "running": f"Program running: {str(bool(self.program)).lower()}",
            "programstate": f"{'PLAYING' if self.program else 'STOPPED'} {self.program or 'null'}",
            "robotmode": "Robotmode: " + {RUNNING: "RUNNING", IDLE: "IDLE"}.get(self.robot_mode, "POWER_OFF"),
            "safetymode": "Safetymode: "
            + {NORMAL: "NORMAL", PROTECTIVE_STOP: "PROTECTIVE_STOP", SAFEGUARD_STOP: "SAFEGUARD_STOP"}.get(
                self.safety_mode, "ROBOT_EMERGENCY_STOP"
            ),
            "is in remote control": str(self.remote).lower() if e_series else "could not understand: is in remote",
            "get serial number": "20195500001",
            "get robot model": self.robot.rstrip("e").upper(),
            "close safety popup": "closing safety popup",
        }
        if line in answers:
            return answers[line]
        if line == "unlock protective stop":
            return self._unlock()
        act: dict[str, tuple[Callable[[], None], str]] = {
            "power on": (lambda: self.set_power(IDLE), "Powering on"),
            "power off": (lambda: self.set_power(POWER_OFF), "Powering off"),
            "brake release": (self._release_brakes, "Brake releasing"),
            "stop": (lambda: self.stop_program("dashboard"), "Stopped"),
        }
        if line not in act:
            return f"could not understand: '{line}'"
        call, answer = act[line]
        call()
        return answer

    def _release_brakes(self) -> None:
        if self.robot_mode == IDLE:
            self.set_power(RUNNING)

    def _unlock(self) -> str:
        if self.safety_mode == PROTECTIVE_STOP and time.monotonic() - self._t_protective < _UNLOCK:
            return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"
        if self.safety_mode == PROTECTIVE_STOP:
            self.safety_mode = NORMAL
            self.note("protective stop unlocked")
        return "Protective stop releasing"

    def set_power(self, mode: int) -> None:
        """Switch the arm on, release its brakes, or switch it off. Not while the emergency stop is pressed."""
        if self.safety_mode != EMERGENCY_STOP:
            self.robot_mode = mode
            if mode != RUNNING:
                self.stop_program("power")

    # Each cycle.

    def step(self) -> None:
        self.now += self.dt
        if self._starts is not None and self.now >= self._starts[0]:
            _, self.program, self.offset = self._starts
            self._starts, self._t_written = None, self.now
            self.note(f"program {self.program} runs")
            self.outputs[f"output_int_register_{self.offset}"] = 1
        running = self.program if not self.paused else ""
        if running and self._watchdog is not None and self.now - self._t_written > self._watchdog:
            self.stop_program("watchdog")
        elif running == "rtde_control":
            self._run_script()
        why = self.motion.step()
        if why is not None:
            self.stop_protective(f"{why}: the position deviates from the path")

    def _run_script(self) -> None:
        """Run the main loop of the uploaded script once."""
        if self._busy is not None:
            if not self._busy():
                return
            self._busy = None
            self._signal(2)
        command = int(self.inputs.get(f"input_int_register_{self.offset}", 0))
        if command in _REALTIME:
            self._process(command)
            self._signal(1)
        elif command == 0:
            self._executing = False
            self._signal(1)
        elif not self._executing:
            self._executing = True
            self._process(command)
            if self.program and self._busy is None:
                self._signal(2)

    def _signal(self, value: int) -> None:
        self.outputs[f"output_int_register_{self.offset}"] = value

    def _x(self, first: int, count: int = 1) -> list[float]:
        return [self.inputs.get(f"input_double_register_{self.offset + first + k}", 0.0) for k in range(count)]

    def _process(self, command: int) -> None:
        """Do what ``process_cmd`` of the script does."""
        motion, x = self.motion, self._x
        if command == 1:  # movej
            motion.move(x(0, 6), *x(6, 2))
            if not self.inputs.get(f"input_int_register_{self.offset + 1}", 0):
                self._busy = lambda: motion.at_rest
        elif command == 11 and not self.stuck:  # servoj
            motion.servo([value + self.jump for value in x(0, 6)], *x(9))
            self.jump = 0.0
        elif command == 9:  # speedj
            motion.speed(x(0, 6), *x(6))
        elif command in (15, 16, 33, 34):  # speed_stop, servo_stop, stopl, stopj
            motion.stop(*x(0))
            self._busy = lambda: motion.at_rest
        elif command == 17:
            self.payload = x(0)[0]
            self.cog = x(1, 3) if any(x(1, 3)) else self.cog
        elif command == 29:
            self.tcp = x(0, 6)
        elif command == 31:
            self.stop_protective("requested by the program")
        elif command == 35:
            self._watchdog, self._t_written = 1.0 / max(x(0)[0], 0.1), self.now
        elif command == 255:
            self.stop_program("stop script")

    def read_state(self) -> dict[str, Any]:
        """Return the variables of RTDE that are not 0, by name."""
        motion = self.motion
        return {
            "timestamp": self.now,
            "target_q": motion.q,
            "target_qd": motion.dq,
            "target_qdd": motion.ddq,
            "actual_q": motion.actual_q,
            "actual_qd": motion.actual_dq,
            "actual_TCP_pose": forward(self.dh, motion.actual_q, self.tcp),
            "target_TCP_pose": forward(self.dh, motion.q, self.tcp),
            "actual_TCP_force": self.force,
            "robot_mode": self.robot_mode,
            "safety_mode": self.safety_mode,
            "safety_status": self.safety_mode,
            "robot_status_bits": (self.robot_mode == RUNNING) | (2 if self.program else 0),
            "safety_status_bits": _SAFETY_BITS.get(self.safety_mode, 0),
            "runtime_state": PAUSED if self.paused else PLAYING if self.program else STOPPED,
            "speed_scaling": motion.scale * motion.limit,
            "target_speed_fraction": motion.scale,
            "payload": self.payload,
            "payload_cog": self.cog,
            "tcp_offset": self.tcp,
            **self.outputs,
        }
