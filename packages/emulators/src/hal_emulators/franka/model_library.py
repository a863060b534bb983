"""The model library of a Panda: a shared object with kinematics and dynamics, which the client downloads and calls.

``panda_py.Panda`` does not open without it. A real robot sends one of Franka's. This module writes one for the emulated
arm, without a compiler: it computes the formulas once with :class:`Number` in place of floats, and each operation is
recorded as machine code, for x86-64 Linux, the only system that the client's wheels are built for. Names, arguments and
results of the 30 functions are those of ``libfcimodels.h`` in libfranka 0.9.2.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Numbers = NDArray[Any]
"""An array of floats and :class:`Number`."""

# Machine code.

_POINTERS = (b"\xf2\x0f%c\x8f", b"\xf2\x0f%c\x8e", b"\xf2\x0f%c\x8a", b"\xf2\x0f%c\x89", b"\xf2\x41\x0f%c\x88")
"""movsd between xmm1 and [argument + distance], for the pointers in rdi, rsi, rdx, rcx and r8."""
_LOAD, _STORE, _ADD, _MULTIPLY, _SUBTRACT = 0x10, 0x11, 0x58, 0x59, 0x5C


class Number:
    """A number that a function computes when it is called; it is at its own place on the stack."""

    def __init__(self, function: Function, place: int) -> None:
        self._function = function
        self.place = place

    def __add__(self, other: Number | float) -> Number | float:
        return self if other == 0.0 else self._function.combine(_ADD, self, other)

    __radd__ = __add__

    def __sub__(self, other: Number | float) -> Number | float:
        return self if other == 0.0 else self._function.combine(_SUBTRACT, self, other)

    def __rsub__(self, other: float) -> Number | float:
        return self._function.combine(_SUBTRACT, other, self)

    def __neg__(self) -> Number | float:
        return -1.0 * self

    def __mul__(self, other: Number | float) -> Number | float:
        if other == 0.0:
            return 0.0
        return self if other == 1.0 else self._function.combine(_MULTIPLY, self, other)

    __rmul__ = __mul__

    def sin_cos(self) -> tuple[Number, Number]:
        """Return sine and cosine."""
        return self._function.sin_cos(self)


class Function:
    """Records the machine code of a C function: pointers to doubles, at most one double, a pointer to the result."""

    def __init__(self) -> None:
        self._code = bytearray()
        self._places = 0
        self._constants: dict[float, int] = {}
        self._arguments = iter(_POINTERS)

    def _add(self, code: bytes, place: int) -> None:
        self._code += code + struct.pack("<i", 8 * place)

    def _move(self, operation: int, place: int) -> None:
        """Load xmm1 from a place on the stack, store it there, or combine the two."""
        self._add(bytes((0xF2, 0x0F, operation, 0x8C, 0x24)), place)

    def _new(self) -> Number:
        self._places += 1
        return Number(self, self._places - 1)

    def _place(self, x: Number | float) -> int:
        if isinstance(x, Number):
            return x.place
        if x not in self._constants:
            self._constants[x] = place = self._new().place
            self._code += b"\x48\xb8" + struct.pack("<d", x)  # mov rax, x
            self._add(b"\x48\x89\x84\x24", place)  # mov [place], rax
        return self._constants[x]

    def take_number(self) -> Number:
        """Return the argument that is a double."""
        number = self._new()
        self._add(b"\xf2\x0f\x11\x84\x24", number.place)  # movsd [place], xmm0
        return number

    def take_array(self, size: int) -> Numbers:
        """Return the numbers (size,) behind the next argument that is a pointer."""
        pointer = next(self._arguments)
        numbers = [self._new() for _ in range(size)]
        for k, number in enumerate(numbers):
            self._add(pointer % _LOAD, k)
            self._move(_STORE, number.place)
        return np.array(numbers, dtype=object)

    def combine(self, operation: int, a: Number | float, b: Number | float) -> Number:
        """Return the sum, difference or product."""
        first, second, result = self._place(a), self._place(b), self._new()
        self._move(_LOAD, first)
        self._move(operation, second)
        self._move(_STORE, result.place)
        return result

    def sin_cos(self, x: Number) -> tuple[Number, Number]:
        """Return sine and cosine."""
        sine, cosine = self._new(), self._new()
        self._add(b"\xdd\x84\x24", x.place)  # fld
        self._code += b"\xd9\xfb"  # fsincos
        self._add(b"\xdd\x9c\x24", cosine.place)  # fstp
        self._add(b"\xdd\x9c\x24", sine.place)
        return sine, cosine

    def finish(self, result: Sequence[Number | float]) -> bytes:
        """Return the code, which writes ``result`` behind the last argument."""
        pointer = next(self._arguments)
        for k, x in enumerate(result):
            self._move(_LOAD, self._place(x))
            self._add(pointer % _STORE, k)
        stack = struct.pack("<i", 8 * self._places)
        return b"\x48\x81\xec" + stack + bytes(self._code) + b"\x48\x81\xc4" + stack + b"\xc3"  # sub, add rsp; ret


_PAGE = 4096


def _write_shared_object(functions: dict[str, bytes]) -> bytes:
    """Return an ELF shared object that exports the functions, with what a dynamic loader needs and nothing else.

    Format: System V gABI, chapters 4 and 5. The one bucket of the hash table lists all symbols.
    """
    count = len(functions) + 1
    names = b"\0" + b"".join(name.encode() + b"\0" for name in functions)
    at_symbols = 64 + 4 * 56
    at_names = at_symbols + 24 * count
    at_hash = -(-(at_names + len(names)) // 8) * 8
    at_code = at_hash + 4 * (3 + count)
    table = struct.pack(f"<{3 + count}I", 1, count, 1, 0, *range(2, count), 0)
    symbols, code, name_at = bytes(24), b"", 1
    for name, body in functions.items():
        symbols += struct.pack("<IBBHQQ", name_at, 0x12, 0, 1, at_code + len(code), len(body))  # global function
        name_at += len(name) + 1
        code += body
    at_dynamic = -(-(at_code + len(code)) // _PAGE) * _PAGE
    entries = {4: at_hash, 5: at_names, 6: at_symbols, 10: len(names), 11: 24, 0: 0}
    dynamic = b"".join(struct.pack("<qQ", *entry) for entry in entries.items())
    # A shared object (3) for x86-64 (62), with four segments from byte 64 on.
    header = struct.pack("<16sHHIQQQIHHHHHH", b"\x7fELF\2\1\1", 3, 62, 1, 0, 64, 0, 0, 64, 56, 4, 64, 0, 0)

    def segment(kind: int, flags: int, at: int, size: int, align: int) -> bytes:
        return struct.pack("<IIQQQQQQ", kind, flags, at, at, at, size, size, align)

    segments = (
        segment(1, 5, 0, at_code + len(code), _PAGE)  # code: read, execute
        + segment(1, 6, at_dynamic, len(dynamic), _PAGE)  # older loaders write into this one
        + segment(2, 6, at_dynamic, len(dynamic), 8)
        + segment(0x6474E551, 6, 0, 0, 16)  # the stack is not executable
    )
    parts = ((0, header + segments), (at_symbols, symbols), (at_names, names), (at_hash, table), (at_code, code))
    image = bytearray(at_dynamic)
    for at, part in parts:
        image[at : at + len(part)] = part
    return bytes(image) + dynamic


# The model.


def _cross(a: Numbers, b: Numbers) -> Numbers:
    return np.array([a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)], dtype=object)


def _constants(values: NDArray[np.float64]) -> Numbers:
    """Return constants, with the zeros and ones of right angles exact."""
    return np.round(values, 12).astype(object)


_ZERO, _STILL = _constants(np.zeros(3)), _constants(np.zeros(7))
_AXIS = _constants(np.eye(3)[2])


class _Arm:
    """The seven joints and links of an arm, from its URDF. Vectors and matrices are (3,) and (3, 3)."""

    def __init__(self, urdf: str) -> None:
        model = pin.buildModelFromXML(urdf)
        if any(joint.shortname() != "JointModelRZ" for joint in list(model.joints)[1:]):
            raise ValueError("the URDF has a joint that does not turn about the z axis of its link")
        placements = [*list(model.jointPlacements)[1:], model.frames[model.getFrameId("link8")].placement]
        self.rotations = [_constants(placement.rotation) for placement in placements]
        self.steps = [_constants(placement.translation) for placement in placements]
        """From each joint to the next one, the last to the flange."""
        self.bodies = [(i.mass, i.lever.astype(object), i.inertia.astype(object)) for i in list(model.inertias)[1:]]

    def turned(self, q: Numbers) -> list[Numbers]:
        """Return the rotation of each joint's frame in the one before, and that of the flange."""
        spins = [
            np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=object) for s, c in (x.sin_cos() for x in q)
        ]
        return [*(a @ b for a, b in zip(self.rotations, spins, strict=False)), self.rotations[-1]]

    def poses(self, q: Numbers, end: Numbers) -> list[tuple[Numbers, Numbers]]:
        """Return rotation and position of the joints' frames, the flange, and, at ``end`` (4, 4) from it, the tool."""
        rotation, position = _constants(np.eye(3)), _ZERO
        found = []
        for turn, step in zip([*self.turned(q), end[:3, :3]], [*self.steps, end[:3, 3]], strict=True):
            position = position + rotation @ step
            rotation = rotation @ turn
            found.append((rotation, position))
        return found

    def torques(
        self, turned: list[Numbers], dq: Numbers, ddq: Numbers, gravity: Numbers, load: tuple[Any, Numbers, Numbers]
    ) -> list[Any]:
        """Return the joint torques (7,), Nm, of a motion, by the recursive Newton-Euler equations.

        Args:
            turned: From :meth:`turned`.
            dq: Velocities (7,), rad/s.
            ddq: Accelerations (7,), rad/s2.
            gravity: In the base frame (3,), m/s2.
            load: Mass, kg; centre of mass in the flange's frame (3,), m; inertia about it (3, 3), kg m2.
        """
        flange, (mass, centre, inertia) = self.rotations[-1], load
        held = mass, self.steps[-1] + flange @ centre, flange @ inertia @ flange.T
        w, dw, a = _ZERO, _ZERO, -gravity
        inertial = []
        for k in range(7):
            back, spin = turned[k].T, _AXIS * dq[k]
            a = back @ (a + _cross(dw, self.steps[k]) + _cross(w, _cross(w, self.steps[k])))
            w, dw = back @ w, back @ dw
            dw = dw + _AXIS * ddq[k] + _cross(w, spin)
            w = w + spin
            total, moment = _ZERO, _ZERO
            for m, c, i in (self.bodies[k], held) if k == 6 else (self.bodies[k],):
                force = (a + _cross(dw, c) + _cross(w, _cross(w, c))) * m
                total = total + force
                moment = moment + i @ dw + _cross(w, i @ w) + _cross(c, force)
            inertial.append((total, moment))
        found: list[Any] = []
        force, moment = _ZERO, _ZERO
        for k in reversed(range(7)):
            force, moment = force + inertial[k][0], moment + inertial[k][1]
            found.insert(0, moment[2])
            force, moment = turned[k] @ force, turned[k] @ moment
            moment = moment + _cross(self.steps[k], force)
        return found


def write_model_library(urdf: str) -> bytes:
    """Return the shared object. Raises ValueError if a joint does not turn about the z axis of its link.

    ``urdf`` is the arm from base to flange, as :func:`~.plant.arm_only` returns it. What the flange carries is an
    argument of the functions.
    """
    arm = _Arm(urdf)
    functions = {"M_NE": _inertia(arm), "c_NE": _coriolis(arm), "g_NE": _gravity(arm)}
    for k in range(9):
        functions[f"O_T_J{k + 1}"] = _pose(arm, k)
        functions[f"O_J_J{k + 1}"] = _jacobian(arm, k, of_body=False)
        functions[f"Ji_J_J{k + 1}"] = _jacobian(arm, k, of_body=True)
    return _write_shared_object(functions)


def _inertia(arm: _Arm) -> bytes:
    """Return the code of (q, load's inertia, mass and centre; joint-space inertia 7x7)."""
    function = Function()
    mass = function.take_number()
    turned, inertia = arm.turned(function.take_array(7)), function.take_array(9).reshape(3, 3)
    load = mass, function.take_array(3), inertia
    columns = [arm.torques(turned, _STILL, unit, _ZERO, load) for unit in _constants(np.eye(7))]
    return function.finish([x for column in columns for x in column])


def _coriolis(arm: _Arm) -> bytes:
    """Return the code of (q, dq, load's inertia, mass and centre; torques 7)."""
    function = Function()
    mass = function.take_number()
    turned, dq = arm.turned(function.take_array(7)), function.take_array(7)
    inertia = function.take_array(9).reshape(3, 3)
    return function.finish(arm.torques(turned, dq, _STILL, _ZERO, (mass, function.take_array(3), inertia)))


def _gravity(arm: _Arm) -> bytes:
    """Return the code of (q, gravity, load's mass and centre; torques 7)."""
    function = Function()
    mass = function.take_number()
    turned, gravity = arm.turned(function.take_array(7)), function.take_array(3)
    load = mass, function.take_array(3), _constants(np.zeros((3, 3)))
    return function.finish(arm.torques(turned, _STILL, _STILL, gravity, load))


def _frames(function: Function, arm: _Arm, last: int) -> list[tuple[Numbers, Numbers]]:
    """Take the arguments of a function of poses, and return the frames up to ``last``: 7 is the flange, 8 the tool."""
    q = function.take_array(7)
    tool = function.take_array(16).reshape(4, 4).T if last == 8 else _constants(np.eye(4))
    return arm.poses(q, tool)[: last + 1]


def _pose(arm: _Arm, k: int) -> bytes:
    """Return the code of (q, for the tool its matrix; pose of frame ``k``), matrices 4x4 by columns."""
    function = Function()
    rotation, position = _frames(function, arm, k)[k]
    columns = zip([*rotation.T, position], (0.0, 0.0, 0.0, 1.0), strict=True)
    return function.finish([x for column, last in columns for x in (*column, last)])


def _jacobian(arm: _Arm, k: int, *, of_body: bool) -> bytes:
    """Return the code of the same arguments for the Jacobian 6x7 by columns, linear rows first.

    Its axes are those of the base, or of the frame. That of the first frame is constant, and has no argument.
    """
    function = Function()
    if k == 0:
        return function.finish([*_ZERO, *_AXIS, *[0.0] * 36])
    frames = _frames(function, arm, k)
    rotation, position = frames[k]
    values: list[Any] = []
    for turned, at in frames[:7]:
        axis = turned[:, 2]
        for part in (_cross(axis, position - at), axis):
            values += (rotation.T @ part if of_body else part).tolist()
    return function.finish(values + [0.0] * (42 - len(values)))
