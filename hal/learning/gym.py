"""A rig as a Gymnasium environment, the same for the simulated and for the real arm.

    from hal.gym import RigEnv

    env = RigEnv("panda_table", action="twist", rate_hz=20)
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

Simulated rigs run in lock-step, as fast as the machine allows; real ones in real time, with the same dead-man, limits
and watchdog as teleoperation. Needs ``pip install 'robot-hal[gym]'``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..arguments import number
from ..camera import Camera
from ..commands import FIRST_STEP_ANGLE, CartesianTarget, Command, JointTarget, JointTorque, JointVelocity, Twist
from ..control import Control
from ..deadman import Deadman
from ..errors import CommandError, DriverMissing, MotionStopped, NotSupported, RobotFault
from ..geometry import Pose, apply_rotation
from ..observation import Observation
from ..rig import Rig, open_rig
from ..robot import Robot
from ..specs import CameraSpec
from .episode import reset_scene, stands_in_world

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.spaces import Box, Dict
except ImportError as error:
    text = "RigEnv needs gymnasium; install with: pip install 'robot-hal[gym]'"
    raise DriverMissing(text, name="gymnasium") from error

if TYPE_CHECKING:
    from ..servo.controllers import Controller

__all__ = [
    "ActionKind",
    "RigEnv",
    "ObservationDict",
    "action_space",
    "pose_array",
    "entry_key",
    "numbers_and_pictures",
    "observation_space",
]

ActionKind = Literal["joint", "tcp_delta", "twist", "velocity", "torque"]
"""``joint``: positions (n,), rad; more than 0.1 rad from the set-point they are clipped, and ``info["clipped"]`` is
True. ``tcp_delta``: translation (m) and rotation vector (rad) of the tcp's goal in this step, along the base's axes.
``twist``: velocity of the tcp, m/s and rad/s, along the base's axes. ``velocity``: joint velocities (n,), rad/s.
``torque``: joint torques (n,), Nm, on top of those that carry the arm's weight (see :class:`hal.JointTorque`). With a
gripper one more number follows, 0 (open) to 1 (closed)."""

ObservationDict = dict[str, NDArray[Any]]


def action_space(robots: Sequence[Robot], kind: ActionKind, rate_hz: float, speeds: tuple[float, float]) -> spaces.Box:
    """Return the box of actions: the numbers of each arm, one arm after the other.

    Args:
        robots: The arms.
        kind: Kind of action.
        rate_hz: Steps per second.
        speeds: Greatest speeds of the tcp, m/s and rad/s.

    Raises:
        CommandError: An unknown ``kind`` (code ``unknown_action``).
        NotSupported: Torques, for an arm that has no limits for them (``no_torque_limits``).
    """
    linear, angular = speeds
    low: list[float] = []
    high: list[float] = []
    for robot in robots:
        if kind == "joint":
            low += robot.limits.lower
            high += robot.limits.upper
        elif kind in ("velocity", "torque"):
            most = _find_limits(robot, kind)
            low += [-value for value in most]
            high += most
        elif kind in ("tcp_delta", "twist"):
            share = 1.0 / rate_hz if kind == "tcp_delta" else 1.0
            most = [linear * share] * 3 + [angular * share] * 3
            low += [-value for value in most]
            high += most
        else:
            known = ", ".join(get_args(ActionKind))
            raise CommandError(f"action must be one of {known}, not {kind!r}", code="unknown_action")
        if robot.gripper is not None:
            low.append(0.0)
            high.append(1.0)
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def _find_limits(robot: Robot, kind: ActionKind) -> list[float]:
    """Return the greatest joint velocities of a session (n,), rad/s, or the greatest torques (n,), Nm."""
    if kind == "velocity":
        return [robot.spec.speed * value for value in robot.limits.velocity]
    if robot.limits.torque is None:
        raise NotSupported(f"{robot.name}: its model has no limits.torque, Nm per joint", code="no_torque_limits")
    return list(robot.limits.torque)


_IN_JOINTS = ("joint", "velocity", "torque")
"""Kinds of action with one number for each joint."""


def action_names(robots: Sequence[Robot], kind: ActionKind, several: bool) -> tuple[str, ...]:
    """Return the name of each number of an action; with ``several`` arms the arm's name leads, as in recordings."""
    names: list[str] = []
    for robot in robots:
        own = [
            *(robot.joints if kind in _IN_JOINTS else _TCP_NAMES),
            *(["gripper"] if robot.gripper is not None else []),
        ]
        names += [f"{robot.name}.{name}" if several else name for name in own]
    return tuple(names)


POINTS = "points"
"""Name of the stream of points, which follows from the depth."""
_TCP_NAMES = ("x", "y", "z", "roll", "pitch", "yaw")


def observation_space(
    robots: Mapping[str, Robot], cameras: Iterable[Camera], streams: Collection[str], objects: Collection[str]
) -> spaces.Dict:
    """Return a box for each entry of :func:`numbers_and_pictures`, and for the pose of each of ``objects``.

    Raises:
        CommandError: Two entries would have the same key (code ``duplicate_name``).
    """

    def make_box(size: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (size,), np.float64)

    parts: list[tuple[str, spaces.Space[Any]]] = []
    for lead, robot in robots.items():
        sizes = {"q": robot.n, "dq": robot.n, "tcp": 7} | ({"gripper": 1} if robot.gripper is not None else {})
        parts += [(lead + name, make_box(size)) for name, size in sizes.items()]
    for camera in cameras:
        found = [stream for stream in streams if stream in _list_streams(camera.spec)]
        parts += [(entry_key(camera.name, stream), _picture_space(camera.spec, stream)) for stream in found]
    parts += [(entry_key("object", name), make_box(7)) for name in objects]
    keys = [name for name, _ in parts]
    if twice := sorted({name for name in keys if keys.count(name) > 1}):
        raise CommandError(
            f"two parts of the observation would be called {', '.join(twice)}: rename an arm, a camera or an object",
            code="duplicate_name",
        )
    return spaces.Dict(dict(parts))


def _picture_space(camera: CameraSpec, stream: str) -> spaces.Box:
    """Return the box of one camera's pictures: (H, W, 3) colour and points, (H, W, 1) anything else."""
    size = (camera.height, camera.width)
    if stream == POINTS:
        return spaces.Box(-np.inf, np.inf, (*size, 3), np.float32)
    if stream == "color":
        return spaces.Box(0, 255, (*size, 3), np.uint8)
    if stream == "depth":
        return spaces.Box(0.0, camera.depth_max, (*size, 1), np.float32)
    if stream == "segmentation":
        return spaces.Box(-1, np.iinfo(np.int32).max, (*size, 1), np.int32)
    return spaces.Box(0, 255, (*size, 1), np.uint8)


def numbers_and_pictures(
    observation: Observation, robots: Mapping[str, Robot], cameras: Collection[str], streams: Collection[str]
) -> ObservationDict:
    """Return the entries of an observation: the arms, their grippers and these streams of these cameras.

    ``robots`` maps what leads the names of an arm's entries to the arm. Points are in the base frame of the first.
    """
    shown: ObservationDict = {}
    for lead, robot in robots.items():
        state = observation.robots[robot.name]
        shown |= {f"{lead}q": np.array(state.q), f"{lead}dq": np.array(state.dq), f"{lead}tcp": pose_array(state.tcp)}
        if robot.gripper is not None:
            shown[f"{lead}gripper"] = np.array([observation.grippers[robot.name].width])
    for name in cameras:
        frame = observation.cameras[name].frame
        for stream in streams:
            if stream != POINTS:
                picture = getattr(frame, stream)
            else:
                picture = None if frame.depth is None else frame.point_image(next(iter(robots.values())).base)
            if picture is not None:
                shown[entry_key(name, stream)] = picture if picture.ndim == 3 else picture[..., None]
    return shown


def _list_streams(camera: CameraSpec) -> tuple[str, ...]:
    """Return the streams of a camera that can be observed: its own, and points where it has depth."""
    return (*camera.streams, POINTS) if "depth" in camera.streams else tuple(camera.streams)


def entry_key(*parts: str) -> str:
    """Return the key of an entry: an identifier, because PyTorch modules that are named by keys allow no dots."""
    return "_".join(parts).replace("-", "_")


def pose_array(pose: Pose) -> NDArray[np.float64]:
    """Return a pose as (7,): position in m, and quaternion xyzw."""
    return np.concatenate([pose.position, pose.orientation])


Result = tuple[ObservationDict, dict[str, Any]]

_MAX_LEAD = (0.03, 0.12)
"""Distance of a goal ahead of the set-point above which it is reset, m and rad."""
_MAX_STEP = 0.999 * FIRST_STEP_ANGLE  # the servo refuses more, also after rounding


class _EnvArm:
    """One arm of an environment: its control session, and the goal of its last action."""

    def __init__(self, robot: Robot, kind: ActionKind) -> None:
        self.robot = robot
        self.control: Control | None = None
        self.goal = Pose()
        self.clipped = False
        self.size = (robot.n if kind in _IN_JOINTS else 6) + int(robot.gripper is not None)
        """Count of numbers in an action."""
        self._kind = kind
        self._lower, self._upper = np.array(robot.limits.lower), np.array(robot.limits.upper)

    def restart(self, observation: Observation) -> None:
        """Begin an episode where the arm is."""
        self.goal = observation.robots[self.robot.name].tcp_set
        self.clipped = False

    def command(self, action: NDArray[np.float64]) -> tuple[Command, float | None]:
        """Return the command of an action, and the grip from 0 (open) to 1 (closed); None without a gripper."""
        grip = min(max(float(action[-1]), 0.0), 1.0) if self.robot.gripper is not None else None
        numbers = action if grip is None else action[:-1]
        if self._kind == "joint":
            q_set = self.robot.state().q_set
            q = np.minimum(np.maximum(numbers, q_set - _MAX_STEP), q_set + _MAX_STEP)
            q = np.minimum(np.maximum(q, self._lower), self._upper)
            self.clipped = bool((q != numbers).any())
            return JointTarget(q), grip
        if self._kind == "velocity":
            return JointVelocity(numbers), grip
        if self._kind == "torque":
            return JointTorque(numbers), grip
        if self._kind == "twist":
            return Twist(numbers[:3], numbers[3:]), grip
        reached = self.robot.state().tcp_set
        distance, turn = reached.distance(self.goal)
        if distance > _MAX_LEAD[0] or turn > _MAX_LEAD[1]:  # the arm was held back: the goal must not run ahead
            self.goal = reached
        turned = apply_rotation(self.goal.orientation.tolist(), numbers[3:].tolist())
        self.goal = Pose(self.goal.position + numbers[:3], turned)
        return CartesianTarget(self.goal), grip


def _check_lists(**arguments: Collection[str] | None) -> None:
    """Raise CommandError for one name in the place of a list of them."""
    for argument, names in arguments.items():
        if isinstance(names, str):
            raise CommandError(f"{argument} must be a list of names: [{names!r}]", code="not_a_list")


def _check_functions(**arguments: object) -> None:
    """Raise CommandError for anything that is neither None nor a function."""
    for argument, function in arguments.items():
        if function is not None and not callable(function):
            raise CommandError(f"{argument} must be a function, not {function!r}", code="not_callable")


class RigEnv(gymnasium.Env[ObservationDict, NDArray[np.float32]]):
    """An arm of a rig, or several, with their grippers and cameras, as a Gymnasium environment.

    Observations are a dict: ``q`` and ``dq`` (n,), rad and rad/s; ``tcp`` (7,), position in m and quaternion xyzw in
    the arm's base frame; ``gripper`` (1,), width in m; per camera, of the streams that it has, ``<name>_color`` (H, W,
    3) uint8, ``<name>_depth`` (H, W, 1) float32 in m, ``<name>_infrared`` and ``<name>_infrared_right`` (H, W, 1)
    uint8, ``<name>_segmentation`` (H, W, 1) int32 (see :class:`~hal.types.Frame`), ``<name>_points`` (H, W, 3) float32,
    m, in the first arm's base frame, 0 where nothing was measured; per observed object
    ``object_<name>`` (7,), its pose in the world. A dash in a name becomes an underscore. :attr:`observation` is the
    complete record behind it, with every stamp; ``info["elapsed"]`` is its time since the reset, s.

    With ``robots`` an action has the numbers of each arm, one arm after the other (:attr:`action_names`), and the arm's
    name leads its entries of the observation: ``left_q``. A stop of one arm ends the episode for all.

    ``step`` sends the action, lets one period pass and waits for an observation that was taken after that, so that no
    observation is returned twice. If the arm is stopped (releasing the dead-man is not a stop), the episode is
    truncated and ``info["stopped"]`` has the reason.

    Args:
        config: The rig's configuration, as for :func:`hal.open`.
        sim: True for simulated drivers, as for :func:`hal.open`.
        driver: Driver of all devices, as for :func:`hal.open`.
        engine: Engine of the simulated world, as for :func:`hal.open`.
        robot: Name of the arm; None for the rig's first.
        robots: Names of several arms, instead of ``robot``.
        action: Kind of action, see :data:`ActionKind`.
        controller: What makes the arm follow: :class:`hal.Position` by default, :class:`hal.JointImpedance` or
            :class:`hal.OperationalSpace`. Not for torques.
        cameras: Names of the observed cameras; None for all.
        streams: Observed streams: some of ``color``, ``depth``, ``infrared``, ``infrared_right``,
            ``segmentation`` and ``points``; None for colour and depth.
        objects: Names of the objects of the simulated world whose poses are observed.
        rate_hz: Steps per second.
        max_steps: Steps after which an episode is truncated; None for no limit.
        speeds: Greatest speeds of the tcp for ``twist`` and, per step, for ``tcp_delta``: m/s and rad/s.
        reward: Called as ``reward(env, observation)`` after each step; None for a reward of 0.
        terminated: Called as ``terminated(env, observation)`` after each step.
        on_reset: Called as ``on_reset(env, options)`` after the reset and before the first observation: time for
            the operator to arrange a real bench, or for a task to move objects with ``env.rig.world`` and
            ``env.np_random``.
        deadman: Makes the dead-man from the open rig, for example ``lambda rig: rig.gamepads["pad"].hold("l2")``;
            something that really moves needs it, or ``unattended=True``.
        unattended: Let a real arm move without a dead-man.
        overrides: Changes of the configuration, ``key=value``.
        render_mode: None or ``rgb_array``.

    Raises:
        CommandError: An argument is wrong, also one of the control session (see :meth:`hal.robot.Robot.control`).
        NotSupported: The rig lacks a stream (code ``unknown_stream``) or a world (``no_world``); the arm takes no
            controller.
        DriverMissing: gymnasium is not installed.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # Gymnasium's own name and type

    def __init__(
        self,
        config: str | Path | Mapping[str, Any] = "panda_table",
        *,
        sim: bool | None = None,
        driver: str | None = None,
        engine: str | None = None,
        robot: str | None = None,
        robots: Sequence[str] | None = None,
        action: ActionKind = "joint",
        controller: Controller | None = None,
        cameras: Collection[str] | None = None,
        streams: Collection[str] | None = None,
        objects: Collection[str] = (),
        rate_hz: float = 20.0,
        max_steps: int | None = None,
        speeds: tuple[float, float] = (0.25, 1.0),
        reward: Callable[[RigEnv, Observation], float] | None = None,
        terminated: Callable[[RigEnv, Observation], bool] | None = None,
        on_reset: Callable[[RigEnv, dict[str, Any]], None] | None = None,
        deadman: Callable[[Rig], Deadman] | None = None,
        unattended: bool = False,
        overrides: tuple[str, ...] = (),
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            text = f"render_mode {render_mode!r}: use rgb_array, the first camera's picture"
            raise NotSupported(text, code="render_mode")
        _check_lists(cameras=cameras, streams=streams, objects=objects)
        _check_functions(reward=reward, terminated=terminated, on_reset=on_reset, deadman=deadman)
        rate_hz = number("rate_hz", rate_hz, "Hz", least=0.0, above=True)
        self.render_mode = render_mode
        self._reward, self._terminated, self._on_reset = reward, terminated, on_reset
        self._kind, self._rate, self._max_steps, self._speeds = action, rate_hz, max_steps, speeds
        self._unattended, self._controller = unattended, controller
        self.rig = self._open(config, deadman is not None, sim=sim, driver=driver, engine=engine, overrides=overrides)
        try:
            chosen_robots = _choose_robots(self.rig, robot, robots)
            self.robot: Robot = chosen_robots[0]
            """The arm; the first of several."""
            self._arms = tuple(_EnvArm(arm, action) for arm in chosen_robots)
            self._leads = {"" if robots is None else entry_key(arm.name, ""): arm for arm in chosen_robots}
            self.action_names = action_names(chosen_robots, action, robots is not None)
            """Name of each number of an action; with ``robots`` after the arm's name, as in recordings."""
            self._deadman = deadman(self.rig) if deadman is not None else None
            self._cameras = tuple(self.rig.cameras) if cameras is None else tuple(cameras)
            self._objects = _check_objects(objects, self.rig)
            chosen = [self.rig.cameras[name] for name in self._cameras]
            self._streams = ("color", "depth") if streams is None else _check_streams(streams, chosen)
            self.action_space: Box = action_space(chosen_robots, action, rate_hz, speeds)  # type: ignore[assignment]
            self.observation_space: Dict = observation_space(  # type: ignore[assignment]  # invariant in their types
                self._leads, chosen, self._streams, self._objects
            )
            self._check_sessions()
        except BaseException:
            self.rig.close()
            raise
        self._steps, self._due, self._start = 0, 0.0, 0.0
        self.observation: Observation | None = None
        """The complete record behind the newest observation."""

    def _check_sessions(self) -> None:
        """Check the arguments of the arms' control sessions, and open none. Raises CommandError."""
        from ..servo.controllers import Position

        # Whether a pad can be trusted is checked at the reset: it may be asleep.
        free = self._unattended or self._deadman is not None
        for arm in self._arms:
            checked = arm.robot.control(rate_hz=self._rate, unattended=free, controller=self._controller)
            if self._kind == "torque" and checked.controller != Position():
                raise CommandError("action='torque' takes no controller", code="torques_by_controller")

    @staticmethod
    def _open(config: str | Path | Mapping[str, Any], pads: bool, **options: Any) -> Rig:
        """Open the rig, in lock-step if nothing real is in it; ``options`` are those of :func:`hal.open`."""
        from ..config import load

        plan = load(config, **options).resolve()
        attended = any(arm.attended for arm in plan.robots)
        clock = None if attended or pads else "lock_step"
        return open_rig(config, clock=clock, pad=None if pads else "none", **options)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Result:
        """Reset the scene; a real arm drives to its start, and opens its gripper.

        Objects with random ranges start at poses sampled from ``np_random``. What ``simulation.randomize`` of the rig
        varies is drawn with the seed, or with one from ``np_random``.

        Args:
            seed: Seed of ``np_random``; None continues its sequence.
            options: ``q`` (n,), start position, rad (with several arms: name -> position); ``poses``, name of an object
                -> :class:`~hal.geometry.Pose`, instead of a sampled one.

        Returns:
            The observation and ``info``; ``info["poses"]`` has the poses of the placed objects, if any: name -> (7,),
            position in m and quaternion xyzw in the world; ``info["randomization"]`` has the seed and the values of
            ``rig.world.randomize``, if the rig varies.

        Raises:
            MotionStopped: After ``rig.stop()``. Only the operator, or a program that is responsible for safety, may
                call ``env.rig.rearm()``.
        """
        super().reset(seed=seed)
        options = options or {}
        self._close_sessions()
        q, put = options.get("q"), {}
        starts = q if isinstance(q, Mapping) else {self.robot.name: q}
        for k, arm in enumerate(self._arms):
            robot, last = arm.robot, k == len(self._arms) - 1
            start = starts.get(robot.name)
            put = reset_scene(
                self.rig,
                robot,
                robot.spec.initial if start is None else start,
                poses=options.get("poses") if last else None,  # each reset places the objects again
                random=self.np_random if last else None,
                seed=seed if last else None,
                deadman=self._deadman,
                unattended=self._unattended,
            )
        self._place(starts)
        if self._on_reset is not None:
            self._on_reset(self, options)
        self._open_sessions()
        self.rig.forget_observations()
        observation = self.rig.observe(after=self.rig.clock.now(), cameras=self._cameras)
        for arm in self._arms:
            arm.restart(observation)
        self._steps = 0
        self._due = self.rig.clock.now()
        self._start = observation.t
        info = self._info(observation)
        if put:
            info["poses"] = {name: pose_array(pose) for name, pose in put.items()}
        if self.rig.has_world and (drawn := self.rig.world.randomization) is not None:
            info["randomization"] = drawn
        return self._observation_dict(observation), info

    def _place(self, starts: Mapping[str, Any]) -> None:
        """Place the simulated arms that were given a start: the reset of the last arm put all others back."""
        for arm in self._arms[:-1]:
            q = starts.get(arm.robot.name)
            if q is not None and stands_in_world(self.rig, arm.robot):
                self.rig.world.reset(arm.robot.name, q=np.asarray(q, float))

    def _open_sessions(self) -> None:
        for arm in self._arms:
            control = arm.robot.control(
                deadman=self._deadman, rate_hz=self._rate, unattended=self._unattended, controller=self._controller
            )
            arm.control = control.__enter__()

    def _close_sessions(self) -> None:
        with ExitStack() as closing:  # each is closed, whatever happens to the others
            for arm in self._arms:
                control, arm.control = arm.control, None
                if control is not None:
                    control.brake()
                    closing.callback(control.close)

    def step(self, action: NDArray[np.float32]) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Send an action and wait one period; returns Gymnasium's five values.

        Raises:
            CommandError: ``reset`` was not called (code ``not_reset``), or the action's shape is wrong
                (``bad_action``).
        """
        numbers = np.asarray(action, float)
        if numbers.shape != self.action_space.shape:
            raise CommandError(f"an action has shape {self.action_space.shape}, not {numbers.shape}", code="bad_action")
        clock = self.rig.clock
        stopped, first = "", 0
        for arm in self._arms:
            if arm.control is None:
                raise CommandError("call reset before step", code="not_reset")
            command, grip = arm.command(numbers[first : first + arm.size])
            first += arm.size
            try:
                arm.control.send(command, grip=grip)
            except (MotionStopped, RobotFault) as stop:
                reason = stop.reason if isinstance(stop, MotionStopped) else stop.cause
                stopped = stopped or (f"{arm.robot.name}: {reason}" if len(self._arms) > 1 else reason)
        now = clock.now()
        self._due = max(self._due + 1.0 / self._rate, now)  # a late turn is not caught up
        clock.sleep_until(self._due)
        observation = self.rig.observe(after=self._find_oldest(now), cameras=self._cameras)
        self._steps += 1
        terminated = self._terminated is not None and bool(self._terminated(self, observation))
        truncated = bool(stopped) or (self._max_steps is not None and self._steps >= self._max_steps)
        info = self._info(observation)
        if stopped:
            info["stopped"] = stopped
        reward = float(self._reward(self, observation)) if self._reward is not None else 0.0
        return self._observation_dict(observation), reward, terminated, truncated, info

    def _find_oldest(self, sent: float) -> float | None:
        """Return the oldest time of an acceptable picture, s; None in lock-step, where all show the present.

        It is after the action, and as new as the rate of the slowest camera allows.
        """
        if self.rig.lock_step:
            return None
        slowest = min((self.rig.cameras[name].spec.rate_hz for name in self._cameras), default=np.inf)
        return max(float(np.nextafter(sent, np.inf)), self._due - 1.0 / slowest)

    def _observation_dict(self, observation: Observation) -> ObservationDict:
        self.observation = observation
        shown = numbers_and_pictures(observation, self._leads, self._cameras, self._streams)
        if self._objects and self.rig.world is not None:
            poses = self.rig.world.poses(self._objects).poses
            shown |= {entry_key("object", name): pose_array(poses[name]) for name in self._objects}
        return shown

    def _info(self, observation: Observation) -> dict[str, Any]:
        info: dict[str, Any] = {"elapsed": round(observation.t - self._start, 6)}
        return info | {"clipped": True} if any(arm.clipped for arm in self._arms) else info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the first camera's newest colour picture (H, W, 3)."""
        if self.observation is None or not self._cameras:
            return None
        color = self.observation.cameras[self._cameras[0]].frame.color
        return None if color is None else np.array(color)

    def close(self) -> None:
        """Bring the arms to rest and close the rig. Idempotent."""
        try:
            self._close_sessions()
        finally:
            self.rig.close()


def _choose_robots(rig: Rig, robot: str | None, robots: Sequence[str] | None) -> list[Robot]:
    """Return the arms of an environment. Raises CommandError if both arguments are given, or a name twice."""
    if robots is None:
        return [rig.robots[robot] if robot else next(iter(rig.robots.values()))]
    if robot is not None or isinstance(robots, str) or len(set(robots)) < len(robots) or not robots:
        raise CommandError("pass robot='left', or robots=['left', 'right']: each arm once", code="bad_robots")
    return [rig.robots[name] for name in robots]


def _check_objects(objects: Collection[str], rig: Rig) -> tuple[str, ...]:
    """Return the names of objects whose poses can be observed. Raises NotSupported or DeviceNotFound."""
    if not objects:
        return ()
    if not rig.has_world:
        raise NotSupported("objects=: only a simulated world has the poses of objects", code="no_world")
    return tuple(rig.world.poses(objects).poses)


def _check_streams(streams: Collection[str], cameras: Collection[Camera]) -> tuple[str, ...]:
    """Return the observed streams. Raises NotSupported for one that none of the cameras has."""
    there = {stream for camera in cameras for stream in _list_streams(camera.spec)}
    if missing := [stream for stream in streams if stream not in there]:
        message = (
            f"streams=: no observed camera has {', '.join(missing)}; they have: {', '.join(sorted(there)) or 'none'}"
        )
        raise NotSupported(
            f"{message}. The streams of a camera are chosen in its entry of the rig", code="unknown_stream"
        )
    return tuple(streams)
