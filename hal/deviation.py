"""How far an arm was from where it should have been, measured along the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Deviation"]

Array = NDArray[np.float64]


class Deviation:
    """Root mean square and greatest deviation of each joint, rad, and of the tcp, m."""

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self.samples = 0
        self._squares = np.zeros(len(self.joints) + 1)
        self._most = np.zeros(len(self.joints) + 1)

    def add(self, joints: Array, tcp: Array) -> None:
        """One sample: by how much the joints (n,) are off, rad, and the tcp (3,), m."""
        off = np.append(np.abs(joints), np.linalg.norm(tcp))
        self._squares += off * off
        np.maximum(self._most, off, out=self._most)
        self.samples += 1

    @property
    def rms(self) -> Array:
        """(n,) rad; zeros where nothing was measured (see :attr:`samples`)."""
        found: Array = np.sqrt(self._squares[:-1] / max(1, self.samples))
        return found

    @property
    def most(self) -> Array:
        """(n,) rad"""
        return self._most[:-1]

    @property
    def tcp(self) -> tuple[float, float]:
        """Root mean square and greatest distance, m."""
        return float(np.sqrt(self._squares[-1] / max(1, self.samples))), float(self._most[-1])

    def lines(self) -> list[str]:
        """For people."""
        if not self.samples:
            return ["nothing was measured"]
        pairs = zip(self.joints, self.rms, self.most, strict=True)
        lines = [f"{name:16s} rms {rms:.4f} rad   max {most:.4f} rad" for name, rms, most in pairs]
        rms, most = self.tcp
        return [*lines, f"{'tcp':16s} rms {1e3 * rms:6.2f} mm    max {1e3 * most:6.2f} mm"]

    def as_json(self) -> dict[str, Any]:
        """For programs; None where nothing was measured."""
        if not self.samples:
            return {"samples": 0, "joints_rad": None, "tcp_mm": None}
        pairs = zip(self.joints, self.rms.tolist(), self.most.tolist(), strict=True)
        rms, most = self.tcp
        return {
            "samples": self.samples,
            "joints_rad": {name: {"rms": r, "max": m} for name, r, m in pairs},
            "tcp_mm": {"rms": 1e3 * rms, "max": 1e3 * most},
        }
