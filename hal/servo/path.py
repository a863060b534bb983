"""The motion of ``move_to``: a straight line in joint space, run by one number."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

from ruckig import InputParameter, OutputParameter, Result, Ruckig, RuckigError

from ..commands import CommandRecord
from ..errors import CommandError
from .envelope import Envelope
from .motions import Motion
from .smoothing import JointSmoother

__all__ = ["PathMotion"]

Floats = Sequence[float]

_SAMPLE = 0.05
_SAMPLES = 64
"""The path is looked at every so many rad, at most so many times: planning must fit into a tick."""

_SLOWER = 0.8
"""After a step that the guard refused, the rest of the path is planned at this share of the speed before."""

_HERE = 1e-9
"""A goal this near needs no motion, rad."""


class PathMotion(Motion):
    """From where the arm rests along ``q0 + (s / length) (goal - q0)``, s running from 0 to length in rad.

    Each joint's limits, seen along the path, bound s; so do the session's speed and the tcp's. Ruckig's time-optimal s
    then makes every joint start and arrive together. A set-point on the way lies between start and goal, and so does
    the end of every stop: joint limits need no further check.
    """

    size = 0

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self.arrived = False
        self._goal: Floats = ()
        self._from: list[float] = []
        self._direction: list[float] = []
        self._planned = False
        self._share = 1.0
        """Share of the greatest speed at which the path is planned."""
        self._ruckig = Ruckig(1, smoother.dt)
        self._input = InputParameter(1)
        self._output = OutputParameter(1)

    def aim(self, goal: Floats) -> None:
        """Take a new goal (n,), rad. CommandError, and nothing changes, when the arm may not go there."""
        smoother = self.smoother
        if len(goal) != smoother.n:
            raise CommandError(f"move_to needs {smoother.n} joint positions, not {len(goal)}")
        for i, (x, low, high) in enumerate(zip(goal, smoother.lower, smoother.upper, strict=True)):
            if not low - 1e-6 <= x <= high + 1e-6:
                raise CommandError(f"joint {i} of the goal is {x:.4f} rad; its limits are {low:.4f} to {high:.4f}")
        inside = [max(low, min(high, x)) for x, low, high in zip(goal, smoother.lower, smoother.upper, strict=True)]
        self._check_workspace(inside)
        self._goal = inside
        self._share = 1.0
        self.arrived = False
        self._planned = False

    def start(self) -> None:
        self._planned = False

    def reanchored(self) -> None:
        self._planned = False

    def accept(self, command: CommandRecord) -> None:
        raise CommandError("a move_to session takes no commands")

    def step(self, now: float) -> None:
        smoother = self.smoother
        if not self._planned:
            if not smoother.at_rest():
                smoother.stop()
                return
            self._plan()
        if self.arrived:
            smoother.stop()
            return
        inputs, output = self._input, self._output
        try:
            result = self._ruckig.update(inputs, output)
        except RuckigError:  # never seen; the same goal can be reached joint by joint
            if not smoother.reach(self._goal, self.envelope.velocity, self.envelope.allows):
                smoother.stop()
            self._planned = False
            return
        output.pass_to_input(inputs)
        if result == Result.Finished:
            self.arrived = True
            smoother.adopt(self._goal, [0.0] * smoother.n, [0.0] * smoother.n)
            return
        s, ds, dds = output.new_position[0], output.new_velocity[0], output.new_acceleration[0]
        along = self._direction
        q = [x + s * d for x, d in zip(self._from, along, strict=True)]
        if not smoother.adopt(q, [ds * d for d in along], [dds * d for d in along], self.envelope.keeps_tcp_speed):
            # It stops, and goes on more slowly from there: at the same speed the same step might be refused for ever.
            self._share *= _SLOWER
            self._planned = False

    def _plan(self) -> None:
        smoother, envelope = self.smoother, self.envelope
        self._planned = True
        self._from = list(smoother.q)
        delta = [goal - x for goal, x in zip(self._goal, self._from, strict=True)]
        length = max(map(abs, delta))
        self.arrived = length < _HERE
        if self.arrived:
            return
        self._direction = along = [d / length for d in delta]

        def slowest(limits: Floats) -> float:
            return min(limit / abs(d) for limit, d in zip(limits, along, strict=True) if d)

        speed = slowest(envelope.velocity)
        fastest_tcp = envelope.stop_speed(along, self._samples(self._goal))
        if fastest_tcp * speed > envelope.goal_tcp_speed:
            speed = envelope.goal_tcp_speed / fastest_tcp
        speed *= self._share
        inputs = self._input
        inputs.current_position, inputs.current_velocity, inputs.current_acceleration = [0.0], [0.0], [0.0]
        inputs.target_position = [length]
        inputs.max_velocity = [speed]
        inputs.max_acceleration = [slowest(smoother.acceleration)]
        inputs.max_jerk = [slowest(smoother.jerk)]
        self._ruckig.reset()

    def _samples(self, goal: Floats) -> list[list[float]]:
        start = self.smoother.q
        count = min(_SAMPLES, 1 + ceil(max(abs(b - a) for a, b in zip(start, goal, strict=True)) / _SAMPLE))
        return [[a + k / count * (b - a) for a, b in zip(start, goal, strict=True)] for k in range(count + 1)]

    def _check_workspace(self, goal: Floats) -> None:
        """The tcp must stay inside the workspace on its way, or come back in from where it starts."""
        box = self.envelope.workspace
        if box is None:
            return
        fk = self.envelope.kinematics.fk
        before = fk(self.smoother.q)
        for q in self._samples(goal):
            at = fk(q)
            for x, x0, low, high, axis in zip(at, before, box.lower, box.upper, "xyz", strict=False):
                if x > max(high, x0) + 1e-6 or x < min(low, x0) - 1e-6:
                    raise CommandError(
                        f"the way there leaves the workspace: {axis} = {x:.3f} m, allowed {low:.3f} to {high:.3f}"
                    )
