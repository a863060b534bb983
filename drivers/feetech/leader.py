"""Driver of a leader arm with Feetech STS3215 servos without torque, such as that of an SO-101. It writes nothing."""

from __future__ import annotations

from collections.abc import Iterator

from hal.config.files import Problems, check_record, validate
from hal.config.schema import Strict
from hal.errors import ConnectionLost
from hal.leader import Angles, LeaderDriver
from hal.specs import PadSpec

from .chain import COUNT, Chain, Registers
from .settings import FeetechSettings, MotorId

_WIDEST = 3.0
"""Widest range of a calibrated lever, rad."""


class FeetechLeaderSettings(Strict):
    """Options of a leader on a Feetech bus (``leaders.<name>.options``, and its ``port``)."""

    port: str
    ids: tuple[MotorId, ...] = (1, 2, 3, 4, 5)
    """Ids of the joints' motors, from base to tip."""
    lever: MotorId = 6
    """Id of the lever's motor."""


def check_leader(spec: PadSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a leader's record: key in its entry of the rig file, message and code."""
    problems = Problems()
    settings = validate(FeetechLeaderSettings, spec.options, "", problems, "options")
    for problem in problems.found:
        yield problem.key.replace("options.port", "port"), problem.message, problem.code
    if not problems.found and spec.leader is not None and len(settings.ids) != len(spec.leader.joints):
        message = f"has {len(settings.ids)} motors for {len(spec.leader.joints)} joints"
        yield "options.ids", message, "wrong_count"


class _LeaderChain(Chain):
    """The motors of a leader, whose ranges are no arm's."""

    def _check_registers(self, id: int, found: Registers) -> Iterator[tuple[str, str]]:
        yield from (known for known in super()._check_registers(id, found) if known[1] != "not_calibrated")
        span = (found.calibration.range_max - found.calibration.range_min) * COUNT
        if id == self.ids[-1] and not 0.0 < span < _WIDEST:
            yield f"its range is {span:.2f} rad; calibrate it: lerobot-calibrate", "not_calibrated"


class FeetechLeader(LeaderDriver):
    """A leader on a servo bus (options: :class:`FeetechLeaderSettings`)."""

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        settings = check_record(FeetechLeaderSettings, spec.options, f"leaders.{spec.name}.options")
        labels = (*self.leader.joints, "the lever")
        ids = (*settings.ids, settings.lever)
        self.chain = _LeaderChain(spec.name, FeetechSettings(port=settings.port), ids, labels, [1.0] * len(ids))

    def read_angles(self, now: float) -> Angles:
        chain = self.chain
        try:
            if chain.bus is None:
                chain.open()
            states = chain.read(now)
            holding = [label for label, state in zip(chain.labels.values(), states, strict=True) if state.on]
            if holding:
                text = f"{', '.join(holding)} has torque: this may be a follower; if not, switch its supply off and on"
                raise ConnectionLost(text, code="has_torque")
        except BaseException:
            chain.close()
            raise
        stored = [registers.calibration for registers in chain.registers]
        counts = [state.position for state in states]
        q = [COUNT * (x - 0.5 * (c.range_min + c.range_max)) for x, c in zip(counts[:-1], stored[:-1], strict=True)]
        opened = (counts[-1] - stored[-1].range_min) / (stored[-1].range_max - stored[-1].range_min)
        return Angles(min(state.t for state in states), q, min(max(1.0 - opened, 0.0), 1.0))

    def close(self) -> None:
        super().close()
        self.chain.close()
