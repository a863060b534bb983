"""Settings that a client sends to the emulated arm: decoded, checked and stored.

The ranges of impedances are those of the client library's documentation. What else a controller refuses is not
documented; that it refuses physically impossible values is an assumption.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

import numpy as np

from .plant import FLANGE_TO_HAND, IDENTITY, Pose16, multiply

Values = tuple[float, ...]

_ROTATION = 1e-5
"""Largest deviation of the columns of a rotation matrix from unit length and right angles."""
_HEAVIEST = 30.0
"""kg"""

SETTERS: dict[str, tuple[str, tuple[tuple[str, int], ...]]] = {
    "SetCollisionBehavior": (
        "52d",
        (
            ("lower_torque_acceleration", 7),
            ("upper_torque_acceleration", 7),
            ("lower_torque_nominal", 7),
            ("upper_torque_nominal", 7),
            ("lower_force_acceleration", 6),
            ("upper_force_acceleration", 6),
            ("lower_force_nominal", 6),
            ("upper_force_nominal", 6),
        ),
    ),
    "SetJointImpedance": ("7d", (("K_theta", 7),)),
    "SetCartesianImpedance": ("6d", (("K_x", 6),)),
    "SetGuidingMode": ("7B", (("guiding", 6), ("elbow", 1))),
    "SetEEToK": ("16d", (("EE_T_K", 16),)),
    "SetNEToEE": ("16d", (("NE_T_EE", 16),)),
    "SetLoad": ("13d", (("mass", 1), ("F_x_Cload", 3), ("I_load", 9))),
    "SetFilters": ("5d", (("frequencies", 5),)),
}
"""Request -> format of its payload, and names and sizes of the fields."""


class ClientSettings:
    def __init__(self, with_hand: bool) -> None:
        self.with_hand = with_hand
        self.given: dict[str, dict[str, Any]] = {}
        """Request -> field -> latest values."""
        self.F_T_NE: Pose16 = FLANGE_TO_HAND if with_hand else IDENTITY
        self.NE_T_EE: Pose16 = IDENTITY
        self.F_T_EE: Pose16 = self.F_T_NE
        """From the flange to the tcp."""
        self.EE_T_K: Pose16 = IDENTITY
        self.load: tuple[float, Values, Values] = (0.0, (0.0,) * 3, (0.0,) * 9)
        self.changes = 0

    def store(self, name: str, payload: bytes) -> str | None:
        """Decode, check and store the payload of a setter; return the reason if it is refused."""
        kinds, fields = SETTERS[name]
        values: Values = struct.unpack(f"<{kinds}", payload)
        if not all(isfinite(value) for value in values):
            return "a number is not finite"
        parts: dict[str, Values] = {}
        at = 0
        for field, count in fields:
            parts[field] = values[at : at + count]
            at += count
        reason = _CHECKS[name](parts)
        if reason is None:
            self.given[name] = {field: list(part) for field, part in parts.items()}
            self._apply(name, parts)
        return reason

    def _apply(self, name: str, parts: dict[str, Values]) -> None:
        if name == "SetNEToEE":
            self.NE_T_EE = parts["NE_T_EE"]
            self.F_T_EE = multiply(self.F_T_NE, self.NE_T_EE)
        elif name == "SetEEToK":
            self.EE_T_K = parts["EE_T_K"]
        elif name == "SetLoad":
            self.load = (parts["mass"][0], parts["F_x_Cload"], parts["I_load"])
        self.changes += 1


def _thresholds(parts: dict[str, Values]) -> str | None:
    for name, lower in parts.items():
        if any(value < 0.0 for value in lower):
            return f"{name} has a negative threshold"
        if name.startswith("lower"):
            upper = parts[name.replace("lower", "upper")]
            if any(a > b for a, b in zip(lower, upper, strict=True)):
                return f"{name} is above its upper threshold"
    return None


def _check_ranges(name: str, ranges: Sequence[tuple[float, float]]) -> Callable[[dict[str, Values]], str | None]:
    def check(parts: dict[str, Values]) -> str | None:
        for k, (value, (least, most)) in enumerate(zip(parts[name], ranges, strict=True)):
            if not least <= value <= most:
                return f"{name}[{k}] = {value:g} is not within {least:g}..{most:g}"
        return None

    return check


def _rigid(name: str) -> Callable[[dict[str, Values]], str | None]:
    def check(parts: dict[str, Values]) -> str | None:
        matrix = np.reshape(parts[name], (4, 4)).T
        turn = matrix[:3, :3]
        orthogonal = np.allclose(turn.T @ turn, np.eye(3), rtol=0.0, atol=_ROTATION)
        if matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0] or not orthogonal or np.linalg.det(turn) < 0.0:
            return f"{name} is not a rigid transformation"
        return None

    return check


def _load(parts: dict[str, Values]) -> str | None:
    mass, inertia = parts["mass"][0], parts["I_load"]
    if not 0.0 <= mass <= _HEAVIEST:
        return f"a load of {mass:g} kg"
    if any(inertia[k] < 0.0 for k in (0, 4, 8)):
        return "a moment of inertia is negative"
    if any(abs(inertia[a] - inertia[b]) > 1e-9 for a, b in ((1, 3), (2, 6), (5, 7))):
        return "the inertia is not symmetric"
    return None


def _anything(parts: dict[str, Values]) -> str | None:
    return None


_CHECKS: dict[str, Callable[[dict[str, Values]], str | None]] = {
    "SetCollisionBehavior": _thresholds,
    "SetJointImpedance": _check_ranges("K_theta", [(0.0, 14250.0)] * 7),
    "SetCartesianImpedance": _check_ranges("K_x", [(10.0, 3000.0)] * 3 + [(1.0, 300.0)] * 3),
    "SetGuidingMode": _anything,
    "SetEEToK": _rigid("EE_T_K"),
    "SetNEToEE": _rigid("NE_T_EE"),
    "SetLoad": _load,
    "SetFilters": _check_ranges("frequencies", [(0.0, 1000.0)] * 5),
}
