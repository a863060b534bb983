"""A leader arm in memory, moved by a test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from hal.errors import CommandError
from hal.leader import Angles, LeaderDriver
from hal.specs import PadSpec

from .faults import MockDevice, MockPadFaults


class MockLeader(MockDevice[MockPadFaults], LeaderDriver):
    """A leader that a test moves: ``move`` its joints, ``pull`` its lever. Any thread may. At first it is at zero.

    Faults: :class:`~hal.drivers.mock.faults.MockPadFaults`.
    """

    kind: ClassVar[str] = "leader"
    simulated: ClassVar[bool] = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self.faults = MockPadFaults()
        self._q: tuple[float, ...] = self.leader.middles
        self._pulled = 0.0
        self._angles: Angles | None = None

    def move(self, q: Sequence[float]) -> None:
        """Move its joints to these positions (n,), rad, at once. Raises CommandError for another number of joints."""
        if len(q) != len(self.leader.joints):
            raise CommandError(f"{self.spec.name} has {len(self.leader.joints)} joints, not {len(q)}")
        self._q = tuple(map(float, q))

    def pull(self, share: float) -> None:
        """Put its lever to 0 (open, released) to 1."""
        self._pulled = min(max(float(share), 0.0), 1.0)

    def read_angles(self, now: float) -> Angles:
        self._expect_connected()
        if self._angles is None or not self.faults.freeze:
            terms = zip(self._q, self.leader.gains, self.leader.offsets, strict=True)
            self._angles = Angles(now, [q / gain + offset for q, gain, offset in terms], self._pulled)
        return self._angles

    def describe(self) -> str:
        return "a mock leader"
