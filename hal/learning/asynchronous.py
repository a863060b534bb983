"""A policy that thinks elsewhere while the arm moves: asked in the background, its chunks joined in time.

:class:`RemotePolicy` is a policy for :class:`~hal.learning.policy.PolicyRunner`. Every chunk has times, counted from
the observation that it answers: targets that became due while the policy computed are left out, and the old chunk is
blended into the others over some steps. A policy that answers one action is asked once per step. If the answers stop,
the arm comes to rest at the end of the last chunk.
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
from .policy import check_targets
from .policy_config import Decoded, PolicyConfig, load_policy_config
from .remote import PolicyClient, check_actions

if TYPE_CHECKING:
    from ..observation import Observation
    from ..rig import Rig
    from ..robot import Robot
    from .policy import PolicyAnswer

Array = NDArray[np.float64]

_LATENCIES = 100
"""Number of latencies of which the greatest is expected next."""
_MARGIN = 1.0
"""Steps of the policy by which it is asked earlier than its latency requires."""
_ONSET = 1e-3
"""A target must be due so much later than now, s."""
_HOLD = CHUNK_AHEAD - 0.1
"""Time in which the arm stays at a single action, or goes there, until the next answer, s."""
_SINGLE_STEPS = 1.5
"""Steps in which the arm gets to a single action: the next answer comes before, so that it does not stop there."""
_REHEARSAL_TIMEOUT = 60.0
"""Longest wait for the answer of a rehearsal, s: some servers compile their policy at its first request."""
_MOST_CAMERAS = 8
"""Greatest number of cameras that a server may ask for."""


class _Pending(NamedTuple):
    """A request under way."""

    reply: Future[Any]
    observation: Observation
    t: float
    """Time at which it was sent, s."""


class _Chunk(NamedTuple):
    """Targets that the arms follow."""

    t: Array
    """(k,) s on ``rig.clock``."""
    targets: dict[str, Decoded]
    """Of each arm (k, n), rad."""
    t_next: float
    """Time from which the next chunk should take over, s."""
    t_ask: float
    """Time from which the policy is asked for it, s."""


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
                ``hal serve-lerobot`` do.
            robot: The arm; None for the rig's first. A ``config`` may name others, or several.
            task: The task in words, for policies that follow instructions.
            latency: Simulated time until an answer arrives, s; in lock-step only.

        Raises:
            DeviceNotFound: The rig lacks a camera or an arm that the policy needs.
            NotSupported: The policy uses a gripper, and the arm has none; its numbers do not fit the arm's joints; or
                ``latency`` in real time.
            PolicyError: Without ``config``: the server does not answer or does not describe itself, or its policy is
                for other joints.
            CommandError: ``latency`` is negative.
        """
        self.rig, self.client = rig, client
        self.robot = next(iter(rig.robots.values())) if robot is None else robot
        self.config = config or self._read_metadata(client.connect())
        self.task = task
        self._latency = number("latency", latency, "s", least=0.0)
        if latency and not rig.lock_step:
            raise NotSupported("latency= is for lock-step: in real time an answer takes as long as it takes")
        used = self.config.robots(rig, self.robot)
        self._used = used
        """Every arm that the policy moves or sees; its default first."""
        self.robots = {name: used[name] for name in (action.robot or self.robot.name for action in self.config.actions)}
        """The arms that the policy moves, by name."""
        self._dt = 1.0 / self.config.rate_hz
        self._numbers = self.config.numbers(used)
        self._roboarena = self._resets = False
        self._rtc_delay: int | None = None
        """Greatest number of actions that the server takes as given; None if it takes none."""
        self._session_id = ""
        self._pending: _Pending | None = None
        self._overtaken = False
        """Whether the answer under way is for a time before a pause."""
        self._chunk: _Chunk | None = None
        self._grips: dict[str, float] = {}
        self._called = -np.inf
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._latency_counts = Histogram(1e-3, 10_000)
        self._chunks = self._late = self._steep = 0
        self._splice = 0.0

    # What the runner calls.

    def rehearse(self, observation: Observation) -> PolicyAnswer:
        """Connect, ask once and wait for the answer, which is checked and not used; so errors show before a motion.

        Raises:
            PolicyError: The server does not answer, speaks something else, or asks for what the policy's file lacks.
        """
        self._connect()
        longest = max(_REHEARSAL_TIMEOUT, self.client.timeout)
        self._ask(observation, self.rig.clock.now(), longest)
        assert self._pending is not None
        reply, self._pending = self._pending.reply, None
        actions = check_actions(self._wait_result(reply, longest), self._numbers)
        self._decode(actions[:CHUNK_POINTS], observation)
        return None

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode: connect again if the connection is lost, and reset the policy if its server can.

        Raises:
            PolicyError: As :meth:`rehearse`.
        """
        self.restart()
        if self._pending is not None:  # replies bear no number: the last one must be off the line
            with contextlib.suppress(PolicyError):
                self._wait_result(self._pending.reply)
        self._pending, self._overtaken = None, False
        self._latency_counts = Histogram(1e-3, 10_000)
        self._chunks = self._late = self._steep = 0
        self._splice = 0.0
        self._connect()
        self._session_id = str(uuid.UUID(int=0 if seed is None else seed))
        if self._resets:
            self._wait_result(self.client.request({"endpoint": "reset", "session_id": self._session_id}))

    def restart(self) -> None:
        """Forget the present chunk, after a pause; an answer under way is not used, and the policy is asked again."""
        self._overtaken = self._pending is not None
        self._chunk, self._grips = None, {}
        self._called = -np.inf

    def __call__(self, observation: Observation) -> PolicyAnswer:
        """Return for each arm the next chunk if one has arrived, and the grip that is due.

        Raises:
            PolicyError: The answers have stopped and the present chunk is about to end, or an answer is unusable.
        """
        now = self.rig.clock.now()
        chunks = self._receive(now)
        if self._pending is None and (self._chunk is None or now >= self._chunk.t_ask):
            self._ask(observation, now)
            if not chunks and not self._latency and self.rig.lock_step:
                chunks = self._receive(now)
        self._check_end(now)
        self._called = now
        return {name: (chunks.get(name), self._find_due_grip(name, now)) for name in self.robots}

    def statistics(self) -> dict[str, Any]:
        """Return figures of this episode.

        ``chunks``: number of answers; ``latency``: p50, p99 and max from a question to its use, s; ``late``: number of
        chunks that came after the time at which they should have taken over; ``splice``: greatest step between two
        chunks at the same time, rad; ``steep``: number of chunks whose step was more than the arm's greatest speed
        covers in one step of the policy.
        """
        latency = self._latency_counts.summary()
        counts = {"chunks": self._chunks, "late": self._late, "steep": self._steep}
        return {**counts, "latency": latency, "splice": self._splice}

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self.client.close()

    # The connection.

    def _connect(self) -> None:
        """Connect, and check what the server asks for in its metadata; only RoboArena's servers ask for anything.

        A server of any kind may offer to continue from given actions (``rtc_max_delay_steps``).
        """
        metadata = self.client.connect()
        most = metadata.get("rtc_max_delay_steps")
        joints_only = all(action.kind != "tcp_delta" for action in self.config.actions)
        self._rtc_delay = most if type(most) is int and most > 0 and joints_only else None
        self._roboarena = "action_space" in metadata
        self._resets = self._roboarena or metadata.get("resets") is True
        if not self._roboarena:
            return
        count, size = metadata.get("n_external_cameras", 0), metadata.get("image_resolution")
        if count not in range(_MOST_CAMERAS + 1) or not (size is None or _is_size(size)):
            raise PolicyError(
                f"{self.client.url} describes its policy wrongly: {count!r} cameras, pictures of {size!r}",
                code="policy_protocol",
            )
        wanted = [f"observation/exterior_image_{k}_left" for k in range(count)]
        if metadata.get("needs_wrist_camera"):
            wanted.append("observation/wrist_image_left")
        if metadata.get("needs_stereo_camera"):
            wanted += [key.replace("_left", "_right") for key in wanted]
        there = self.config.observation
        lacking = [key for key in wanted if key not in there]
        space, kind = metadata["action_space"], self.config.actions[0].kind
        if lacking or space != kind:
            raise PolicyError(
                f"{self.client.url} needs {', '.join(wanted) or 'no pictures'} and answers with {space}; the policy's "
                f"file has {', '.join(there)} and the action {kind}",
                code="policy_mismatch",
            )
        if size is not None:
            self.config = self.config.resize_pictures(*size)

    def _read_metadata(self, metadata: dict[str, Any]) -> PolicyConfig:
        if "policy_config" not in metadata:
            raise PolicyError(
                f"{self.client.url} does not describe its policy; pass a configuration (--policy-config)",
                code="policy_mismatch",
            )
        described, wanted = metadata["policy_config"], metadata.get("joints")
        try:
            if not isinstance(described, dict) or not isinstance(wanted, list | None):
                raise TypeError("policy_config is a map, and joints a list")
            config = load_policy_config(described)
        except (ConfigError, TypeError) as error:
            raise PolicyError(
                f"{self.client.url} describes its policy wrongly: {error}", code="policy_protocol"
            ) from error
        robots, joints = config.robots(self.rig, self.robot), []
        for action in config.actions:
            lead = "" if action.robot is None else f"{action.robot}."
            joints += [lead + joint for joint in robots[action.robot or self.robot.name].joints]
        if wanted is not None and wanted != joints:
            raise PolicyError(
                f"the policy at {self.client.url} moves {', '.join(map(str, wanted))}; this rig has "
                f"{', '.join(joints)}",
                code="policy_mismatch",
            )
        return config

    def _ask(self, observation: Observation, now: float, timeout: float | None = None) -> None:
        request = self.config.request(self.rig, observation, self._used, self.task)
        if self._rtc_delay is not None and (prefix := self._prefix(observation, now)) is not None:
            request["rtc"] = prefix
        if self._roboarena:
            request |= {"endpoint": "infer", "session_id": self._session_id}
        self._pending = _Pending(self.client.request(request, timeout), observation, now)
        if self.rig.lock_step:  # the server computes now, whenever its answer is used
            wait([self._pending.reply], (timeout or self.client.timeout) + 1.0)

    def _prefix(self, observation: Observation, now: float) -> dict[str, Any] | None:
        """Return the actions of the present chunk from the observation on, and how many of them will be executed.

        These are due before the answer is expected; from the others the policy may depart.
        """
        chunk = self._chunk
        if chunk is None or self._rtc_delay is None:
            return None
        first = observation.t + self.config.due * self._dt
        if chunk.t[-1] < first:
            return None
        count = int((chunk.t[-1] - first) / self._dt + 1e-6) + 1
        t: Array = first + self._dt * np.arange(count, dtype=float)
        targets = {name: _sample(chunk.t, decoded, t) for name, decoded in chunk.targets.items()}
        delay = max(0, int((now + self._lead() + _ONSET - first) / self._dt + 1.0))
        return {
            "delay_steps": min(delay, self._rtc_delay, len(t)),
            "actions": self.config.encode(targets, observation, self._used).astype(np.float32),
        }

    def _wait_result(self, reply: Future[Any], timeout: float | None = None) -> Any:
        try:
            return reply.result((timeout or self.client.timeout) + 1.0)
        except FutureTimeoutError:
            raise PolicyError(f"{self.client.url} does not answer", code="policy_timeout") from None

    # Chunks.

    def _lead(self) -> float:
        """Return how long before a chunk is needed the policy is asked, s."""
        return max(self._latencies, default=0.0) + _MARGIN * self._dt

    def _receive(self, now: float) -> dict[str, JointChunk]:
        """Return the chunk of each arm if the answer has arrived, else nothing."""
        pending = self._pending
        if pending is None or now < pending.t + self._latency or not (self.rig.lock_step or pending.reply.done()):
            return {}
        self._pending = None
        reply = self._wait_result(pending.reply)
        if self._overtaken:
            self._overtaken = False
            return {}
        if self._chunks == 1:
            self._latencies.clear()  # that of the first answer, which is the slowest
        self._latencies.append(now - pending.t)
        self._latency_counts.add(now - pending.t)
        self._chunks += 1
        return self._follow(check_actions(reply, self._numbers), pending, now)

    def _follow(self, actions: Array, pending: _Pending, now: float) -> dict[str, JointChunk]:
        if len(actions) == 1:
            chunk = self._make_single(self._decode(actions, pending.observation), pending, now)
        else:
            chunk = self._make_chunk(actions, pending.observation, now)
        self._chunk = chunk
        return {name: JointChunk(chunk.t, arm.q) for name, arm in chunk.targets.items()}

    def _make_single(self, decoded: dict[str, Decoded], pending: _Pending, now: float) -> _Chunk:
        """Return the chunk of one action: the arm goes there, and stays."""
        t: Array = now + np.array([_SINGLE_STEPS * self._dt, _HOLD])
        chunk = _Chunk(t, {name: arm.rows([0, 0]) for name, arm in decoded.items()}, float(t[0]), pending.t + self._dt)
        if self._chunk is None:
            return chunk
        self._check_splice(self._chunk, chunk, now)
        planned = self._chunk.t_ask + self._dt  # turns are rounded up to those of the runner, without adding up
        return chunk._replace(t_ask=planned) if planned > pending.t else chunk

    def _make_chunk(self, actions: Array, observation: Observation, now: float) -> _Chunk:
        execute, first, old = self.config.execute or max(1, len(actions) // 2), self.config.due, self._chunk
        # An arm that has stood still since the observation starts at the beginning, not where it would have been.
        start = now if old is None else observation.t
        actions = actions[: int((now - start + CHUNK_AHEAD) / self._dt) + 1]
        decoded, steps = self._decode(actions, observation), len(actions)
        t: Array = start + self._dt * np.arange(first, first + steps, dtype=float)
        ahead = (t > now + _ONSET) & (t < now + CHUNK_AHEAD - self._dt)
        ahead[min(len(t), 2 * execute + int(np.argmax(ahead))) :] = False  # not for long after the server's death
        if not ahead.any():
            raise PolicyError(
                f"the policy's answer took {now - observation.t:.2f} s, longer than its {steps} actions last",
                code="policy_too_late",
            )
        used = np.flatnonzero(ahead)[:CHUNK_POINTS]
        targets = {name: arm.rows(used) for name, arm in decoded.items()}
        t_next = start + execute * self._dt
        chunk = _Chunk(t[used], targets, t_next, t_next - self._lead())
        if old is None:
            return chunk
        self._check_splice(old, chunk, now)
        return self._blend(old, t, decoded, chunk, now)

    def _blend(self, old: _Chunk, t: Array, decoded: dict[str, Decoded], new: _Chunk, now: float) -> _Chunk:
        """Return ``new`` at the times of the old chunk, which changes into it over the steps of ``blend``.

        Both have a target every step, but not at the same times: one that is due shortly after another of the other
        chunk would turn the noise of a policy into jerk. ``t`` (k,), s, and ``decoded`` are all targets of the answer,
        of which ``new`` has those that are ahead.
        """
        begin, end = (int(np.ceil((x - old.t[0]) / self._dt)) for x in (now + _ONSET, new.t[-1]))
        grid: Array = (old.t[0] + self._dt * np.arange(begin, max(begin, end) + 1))[:CHUNK_POINTS]
        over = min(self.config.blend * self._dt, old.t[-1] - now)
        share = np.clip((grid - now) / max(over, _ONSET), 0.0, 1.0) * (grid >= t[0] - _ONSET)
        share[grid > old.t[-1]] = 1.0
        targets = {}
        for name, arm in decoded.items():
            fresh = _sample(t, arm, grid)
            q = fresh.q + (1.0 - share)[:, None] * (_sample(old.t, old.targets[name], grid).q - fresh.q)
            k = np.maximum(np.searchsorted(t, grid + _ONSET) - 1, 0)
            targets[name] = Decoded(q, None if arm.grip is None else arm.grip[k])
        return new._replace(t=grid, targets=targets)

    def _decode(self, actions: Array, observation: Observation) -> dict[str, Decoded]:
        """Return the targets of each arm, all of them checked."""
        decoded = self.config.decode(actions, observation, self._used)
        for name, arm in decoded.items():
            check_targets(self._used[name], self._dt * np.arange(len(actions), dtype=float), arm.q)
        return decoded

    def _check_splice(self, old: _Chunk, new: _Chunk, now: float) -> None:
        """Refuse a chunk that begins farther away than an arm can be when its first target is due."""
        self._late += now > old.t_next
        steep = False
        for name, robot in self.robots.items():
            planned = _sample(old.t, old.targets[name], new.t[:1]).q[0]
            step, fastest = np.abs(new.targets[name].q[0] - planned), np.asarray(robot.limits.velocity)
            self._splice = max(self._splice, float(step.max()))
            steep = steep or bool((step > fastest * self._dt).any())
            most = FIRST_STEP_ANGLE + fastest * (new.t[0] - now)
            worst = int((step - most).argmax())
            if step[worst] > most[worst]:
                raise PolicyError(
                    f"the policy's next chunk begins {step[worst]:.2f} rad away from the present one at "
                    f"{robot.joints[worst]} of {name}; it may be {most[worst]:.2f} rad: let the policy drive more "
                    "slowly, lower 'execute', or use real-time chunking",
                    code="policy_jump",
                )
        self._steep += steep

    def _check_end(self, now: float) -> None:
        """Raise an error in the last turn before the chunk ends without a next one, so that the cause has a name."""
        chunk, pending = self._chunk, self._pending
        if chunk is None:
            return
        turn = now - self._called if np.isfinite(self._called) else 0.0
        if now + 1.5 * turn < chunk.t[-1]:
            return
        if pending is not None and pending.reply.done() and not self._latency:
            self._wait_result(pending.reply)  # raises the reason if there is one; otherwise it is used in the next turn
            return
        raise PolicyError("the policy did not answer before its last chunk ended", code="policy_too_late")

    def _find_due_grip(self, name: str, now: float) -> float | None:
        """Return the grip of an arm that is due, if it differs from the last one."""
        chunk = self._chunk
        if chunk is None or (grips := chunk.targets[name].grip) is None:
            return None
        k = max(0, int(np.searchsorted(chunk.t, now, side="right")) - 1)
        grip = float(grips[k])
        if abs(grip - self._grips.get(name, np.inf)) < 0.01:
            return None
        self._grips[name] = grip
        return grip


def _is_size(size: Any) -> bool:
    sound = isinstance(size, list | tuple) and len(size) == 2
    return sound and all(type(pixels) is int and 8 <= pixels <= 4096 for pixels in size)


def _sample(t: Array, targets: Decoded, at: Array) -> Decoded:
    """Return the targets at other times; before the first and after the last, these."""
    q = np.stack([np.interp(at, t, column) for column in targets.q.T], axis=1)
    return Decoded(q, None if targets.grip is None else np.interp(at, t, targets.grip))
