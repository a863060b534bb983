"""A policy that thinks elsewhere while the arm moves: asked in the background, its chunks joined in time.

:class:`RemotePolicy` is a policy for :class:`~hal.learning.policy.PolicyRunner`. Every chunk has times, counted from
the observation that it answers: targets that became due while the policy computed are left out, and the others replace
the old chunk from their first one on. If the answers stop, the arm comes to rest at the end of the last chunk.
"""

from __future__ import annotations

import contextlib
import uuid
from collections import deque
from concurrent.futures import Future, wait
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arguments import number
from ..commands import CHUNK_AHEAD, CHUNK_POINTS, FIRST_STEP_ANGLE, JointChunk
from ..errors import ConfigError, NotSupported, PolicyError
from ..histogram import Histogram
from .policy_config import PolicyConfig, load_policy_config
from .remote import PolicyClient, check_actions

if TYPE_CHECKING:
    from ..observation import Observation
    from ..rig import Rig
    from ..robot import Robot
    from .policy import PolicyAnswer

__all__ = ["RemotePolicy"]

Array = NDArray[np.float64]

_LATENCIES = 100
"""Number of latencies of which the greatest is expected next."""
_MARGIN = 1.0
"""Steps of the policy by which it is asked earlier than its latency requires."""
_ONSET = 1e-3
"""A target must be due so much later than now, s."""


class _Pending(NamedTuple):
    """A request under way."""

    reply: Future[Any]
    observation: Observation
    t: float
    """Time at which it was sent, s."""


class _Chunk(NamedTuple):
    """Targets that the arm follows."""

    t: Array
    """(k,) s on ``rig.clock``."""
    q: Array
    """(k, n) rad."""
    grip: Array | None
    t_next: float
    """Time from which the next chunk should take over, s."""


class RemotePolicy:
    """A policy on a server, asked in time to have its next chunk before the present one ends.

    In real time a call never waits for the server. In lock-step it does, so that results repeat; ``latency`` then says
    after how much simulated time an answer arrives.
    """

    def __init__(
        self,
        rig: Rig,
        client: PolicyClient,
        config: PolicyConfig | None = None,
        *,
        robot: Robot | None = None,
        task: str = "",
        latency: float = 0.0,
    ) -> None:
        """Prepare a policy. Without a ``config`` it connects now, otherwise in :meth:`rehearse` or :meth:`reset`.

        Args:
            rig: An open rig.
            client: Connection to the server.
            config: What the policy sees, and what its actions mean. None: as the server describes it, which those of
                ``hal-serve-lerobot`` do.
            robot: The arm; None for the rig's first.
            task: The task in words, for policies that follow instructions.
            latency: Simulated time until an answer arrives, s; in lock-step only.

        Raises:
            DeviceNotFound: The rig lacks a camera that the policy needs.
            NotSupported: The policy uses a gripper, and the arm has none; or ``latency`` in real time.
            PolicyError: Without ``config``: the server does not answer or does not describe itself, or its policy is
                for other joints.
            CommandError: ``latency`` is negative.
        """
        self.rig, self.client = rig, client
        self.robot = next(iter(rig.robots.values())) if robot is None else robot
        self.config = config or self._described(client.connect())
        self.task = task
        self._latency = number("latency", latency, "s", least=0.0)
        if latency and not rig.lock_step:
            raise NotSupported("latency= is for lock-step: in real time an answer takes as long as it takes")
        self.config.check(rig, self.robot)
        self._dt = 1.0 / self.config.rate_hz
        self._numbers = self.config.numbers(self.robot.n)
        self._fastest = self.robot.limits.velocity
        self._roboarena = False
        self._session_id = ""
        self._pending: _Pending | None = None
        self._overtaken = False
        """Whether the answer under way is for a time before a pause."""
        self._chunk: _Chunk | None = None
        self._grip: float | None = None
        self._called = -np.inf
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._latency_counts = Histogram(1e-3, 10_000)
        self._chunks = self._late = 0
        self._splice = 0.0

    # What the runner calls.

    def rehearse(self, observation: Observation) -> PolicyAnswer:
        """Connect, ask once and wait for the answer, which is checked and not used; so errors show before a motion.

        Raises:
            PolicyError: The server does not answer, speaks something else, or asks for what the policy's file lacks.
        """
        self._connect()
        self._ask(observation, self.rig.clock.now())
        assert self._pending is not None
        reply, self._pending = self._pending.reply, None
        self.config.decode(check_actions(self._result(reply), self._numbers), observation, self.robot)
        return None

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode: connect again if the connection is lost, and reset the policy if its server can.

        Raises:
            PolicyError: As :meth:`rehearse`.
        """
        self.restart()
        if self._pending is not None:  # replies bear no number: the last one must be off the line
            with contextlib.suppress(PolicyError):
                self._result(self._pending.reply)
        self._pending, self._overtaken = None, False
        self._latency_counts = Histogram(1e-3, 10_000)
        self._chunks = self._late = 0
        self._splice = 0.0
        self._connect()
        self._session_id = str(uuid.UUID(int=0 if seed is None else seed))
        if self._roboarena:
            self._result(self.client.request({"endpoint": "reset", "session_id": self._session_id}))

    def restart(self) -> None:
        """Forget the present chunk, after a pause; an answer under way is not used, and the policy is asked again."""
        self._overtaken = self._pending is not None
        self._chunk, self._grip = None, None
        self._called = -np.inf

    def __call__(self, observation: Observation) -> PolicyAnswer:
        """Return the next chunk if one has arrived, and the grip that is due.

        Raises:
            PolicyError: The answers have stopped and the present chunk is about to end, or an answer is unusable.
        """
        now = self.rig.clock.now()
        command = self._receive(now)
        if self._pending is None and (self._chunk is None or now >= self._chunk.t_next - self._lead()):
            self._ask(observation, now)
            if command is None and not self._latency and self.rig.lock_step:
                command = self._receive(now)
        self._check_end(now)
        self._called = now
        return command, self._due_grip(now)

    def statistics(self) -> dict[str, Any]:
        """Return figures of this episode.

        ``chunks``: number of answers; ``latency``: p50, p99 and max from a question to its use, s; ``late``: number of
        chunks that came after the time at which they should have taken over; ``splice``: greatest step between two
        chunks at the same time, rad.
        """
        latency = self._latency_counts.summary()
        return {"chunks": self._chunks, "latency": latency, "late": self._late, "splice": self._splice}

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self.client.close()

    # The connection.

    def _connect(self) -> None:
        """Connect, and check what the server asks for in its metadata; only RoboArena's servers ask for anything."""
        metadata = self.client.connect()
        self._roboarena = "action_space" in metadata
        if not self._roboarena:
            return
        wanted = [f"observation/exterior_image_{k}_left" for k in range(int(metadata.get("n_external_cameras", 0)))]
        if metadata.get("needs_wrist_camera"):
            wanted.append("observation/wrist_image_left")
        if metadata.get("needs_stereo_camera"):
            wanted += [key.replace("_left", "_right") for key in wanted]
        there = self.config.observation
        lacking = [key for key in wanted if key not in there]
        space, kind = metadata["action_space"], self.config.action.kind
        if lacking or space != kind:
            raise PolicyError(
                f"{self.client.url} needs {', '.join(wanted) or 'no pictures'} and answers with {space}; the policy's "
                f"file has {', '.join(there)} and the action {kind}",
                code="policy_mismatch",
            )
        size = metadata.get("image_resolution")
        if size is not None:
            self._resize(int(size[0]), int(size[1]))

    def _described(self, metadata: dict[str, Any]) -> PolicyConfig:
        """Return the configuration that a server describes in its metadata."""
        if "policy_config" not in metadata:
            raise PolicyError(
                f"{self.client.url} does not describe its policy; pass a configuration (--policy-config)",
                code="policy_mismatch",
            )
        joints = list(metadata.get("joints", self.robot.joints))
        if joints != list(self.robot.joints):
            raise PolicyError(
                f"the policy at {self.client.url} moves {', '.join(map(str, joints))}; {self.robot.name} has "
                f"{', '.join(self.robot.joints)}",
                code="policy_mismatch",
            )
        try:
            return load_policy_config(metadata["policy_config"])
        except (ConfigError, TypeError) as error:
            raise PolicyError(
                f"{self.client.url} describes its policy wrongly: {error}", code="policy_protocol"
            ) from error

    def _resize(self, height: int, width: int) -> None:
        """Send pictures in the size that the server asks for."""
        update = {
            key: source if source.camera is None else source.model_copy(update={"size": (height, width)})
            for key, source in self.config.observation.items()
        }
        self.config = self.config.model_copy(update={"observation": update})

    def _ask(self, observation: Observation, now: float) -> None:
        request = self.config.request(observation, self.robot, self.task)
        if self._roboarena:
            request |= {"endpoint": "infer", "session_id": self._session_id}
        self._pending = _Pending(self.client.request(request), observation, now)
        if self.rig.lock_step:  # the server computes now, whenever its answer is used
            wait([self._pending.reply], self.client.timeout + 1.0)

    def _result(self, reply: Future[Any]) -> Any:
        try:
            return reply.result(self.client.timeout + 1.0)
        except FutureTimeoutError:
            raise PolicyError(f"{self.client.url} does not answer", code="policy_timeout") from None

    # Chunks.

    def _lead(self) -> float:
        """Return how long before a chunk is needed the policy is asked, s."""
        return max(self._latencies, default=0.0) + _MARGIN * self._dt

    def _receive(self, now: float) -> JointChunk | None:
        """Return the chunk of the answer, if it has arrived."""
        pending = self._pending
        if pending is None or now < pending.t + self._latency or not (self.rig.lock_step or pending.reply.done()):
            return None
        self._pending = None
        reply = self._result(pending.reply)
        if self._overtaken:
            self._overtaken = False
            return None
        if self._chunks == 1:
            self._latencies.clear()  # that of the first answer, which is the slowest
        self._latencies.append(now - pending.t)
        self._latency_counts.add(now - pending.t)
        self._chunks += 1
        return self._follow(check_actions(reply, self._numbers), pending.observation, now)

    def _follow(self, actions: Array, observation: Observation, now: float) -> JointChunk:
        q, grip, first = self.config.decode(actions, observation, self.robot)
        execute = self.config.execute or max(1, len(q) // 2)
        # An arm that has stood still since the observation starts at the beginning, not where it would have been.
        start = now if self._chunk is None else observation.t
        t: Array = start + self._dt * np.arange(first, first + len(q), dtype=float)
        ahead = (t > now + _ONSET) & (t < now + CHUNK_AHEAD - self._dt)
        ahead[min(len(t), 2 * execute + int(np.argmax(ahead))) :] = False  # not for long after the server's death
        if not ahead.any():
            raise PolicyError(
                f"the policy's answer took {now - observation.t:.2f} s, longer than its {len(q)} actions last",
                code="policy_too_late",
            )
        t, q = t[ahead][:CHUNK_POINTS], q[ahead][:CHUNK_POINTS]
        self._check_splice(t, q, now)
        self._chunk = _Chunk(t, q, None if grip is None else grip[ahead][:CHUNK_POINTS], start + execute * self._dt)
        return JointChunk(t, q)

    def _check_splice(self, t: Array, q: Array, now: float) -> None:
        """Refuse a chunk that begins farther away than the arm can be when its first target is due."""
        old = self._chunk
        if old is None:
            return
        self._late += now > old.t_next
        planned = np.array([np.interp(t[0], old.t, old.q[:, j]) for j in range(q.shape[1])])
        step = np.abs(q[0] - planned)
        self._splice = max(self._splice, float(step.max()))
        if (step > FIRST_STEP_ANGLE + np.asarray(self._fastest) * (t[0] - now)).any():
            joint = self.robot.joints[int(step.argmax())]
            raise PolicyError(
                f"the policy's next chunk begins {step.max():.2f} rad away from the present one at {joint}",
                code="policy_jump",
            )

    def _check_end(self, now: float) -> None:
        """Raise an error in the last turn before the chunk ends without a next one, so that the cause has a name."""
        chunk, pending = self._chunk, self._pending
        if chunk is None:
            return
        turn = now - self._called if np.isfinite(self._called) else 0.0
        if now + 1.5 * turn < chunk.t[-1]:
            return
        if pending is not None and pending.reply.done() and not self._latency:
            self._result(pending.reply)  # raises the reason if there is one; otherwise it is used in the next turn
            return
        raise PolicyError("the policy did not answer before its last chunk ended", code="policy_too_late")

    def _due_grip(self, now: float) -> float | None:
        """Return the grip that is due, if it differs from the last one."""
        chunk = self._chunk
        if chunk is None or chunk.grip is None:
            return None
        k = max(0, int(np.searchsorted(chunk.t, now, side="right")) - 1)
        grip = float(chunk.grip[k])
        if self._grip is not None and abs(grip - self._grip) < 0.01:
            return None
        self._grip = grip
        return grip
