"""A rig as a Gymnasium environment, the same for the simulated and for the real arm.

    from hal.gym import EnvSettings, RigEnv

    env = RigEnv("panda_table", EnvSettings(action="twist", rate_hz=20))
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

Simulated rigs run in lock-step, as fast as the machine allows; real ones in real time, with the same dead-man, limits
and watchdog as teleoperation. Needs ``pip install 'robot-hal[gym]'``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from ..arguments import choice, number
from ..camera import Camera
from ..commands import FIRST_STEP_ANGLE, CartesianTarget, Command, JointTarget, JointTorque, JointVelocity, Twist
from ..control import Control
from ..deadman import Deadman
from ..errors import CommandError, DriverMissing, MotionStopped, NotSupported, RobotFault
from ..geometry import Pose, apply_rotation
from ..observation import Observation
from ..rig import Rig, open_rig
from ..robot import Robot
from .episode import reset_scene, stands_in_world

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict

    from .spaces import (
        IN_JOINTS,
        ActionKind,
        ObservationDict,
        action_names,
        action_space,
        entry_key,
        list_streams,
        numbers_and_pictures,
        observation_space,
        pose_array,
    )
except ImportError as error:
    text = "RigEnv needs gymnasium; install with: pip install 'robot-hal[gym]'"
    raise DriverMissing(text, name="gymnasium") from error

if TYPE_CHECKING:
    from ..servo.controllers import Controller

Result = tuple[ObservationDict, dict[str, Any]]

simulated_only = False
"""Whether this process refuses real arms, as those of :func:`hal.gym.make_vec` do."""
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
        self.size = (robot.n if kind in IN_JOINTS else 6) + int(robot.gripper is not None)
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


@dataclass(frozen=True, kw_only=True)
class EnvSettings:
    """How a :class:`RigEnv` acts and observes.

    Raises:
        CommandError: A value is wrong.
    """

    robots: str | Sequence[str] | None = None
    """Name of the arm, or a list of the names of several; None for the rig's first."""
    action: ActionKind = "joint"
    """Kind of action, see :data:`ActionKind`."""
    controller: Controller | None = None
    """What makes the arms follow: :class:`hal.Position` by default, :class:`hal.JointImpedance` or
    :class:`hal.OperationalSpace`. Not for torques."""
    cameras: Collection[str] | None = None
    """Names of the observed cameras; None for all."""
    streams: Collection[str] | None = None
    """Observed streams: some of ``color``, ``depth``, ``infrared``, ``infrared_right``, ``segmentation`` and
    ``points``; None for colour and depth."""
    objects: Collection[str] = ()
    """Names of the objects of the simulated world whose poses are observed."""
    rate_hz: float = 20.0
    """Steps per second."""
    max_steps: int | None = None
    """Steps after which an episode is truncated; None for no limit."""
    speeds: tuple[float, float] = (0.25, 1.0)
    """Greatest speeds of the tcp for ``twist`` and, per step, for ``tcp_delta``: m/s and rad/s."""

    def __post_init__(self) -> None:
        for name in ("cameras", "streams", "objects"):
            if isinstance(value := getattr(self, name), str):
                raise CommandError(f"{name} must be a list of names: [{value!r}]", code="not_a_list")
        choice("action", self.action, get_args(ActionKind), "unknown_action")
        number("rate_hz", self.rate_hz, "Hz", least=0.0, above=True)


class RigEnv(gymnasium.Env[ObservationDict, NDArray[np.float32]]):
    """An arm of a rig, or several, with their grippers and cameras, as a Gymnasium environment.

    Your own environment is a subclass with :meth:`reward`, :meth:`success` and, if the scene varies, :meth:`arrange`.

    Observations are a dict: ``q`` and ``dq`` (n,), rad and rad/s; ``tcp`` (7,), position in m and quaternion xyzw in
    the arm's base frame; ``gripper`` (1,), width in m; per camera, of the streams that it has, ``<name>_color`` (H, W,
    3) uint8, ``<name>_depth`` (H, W, 1) float32 in m, ``<name>_infrared`` and ``<name>_infrared_right`` (H, W, 1)
    uint8, ``<name>_segmentation`` (H, W, 1) int32 (see :class:`~hal.types.Frame`), ``<name>_points`` (H, W, 3) float32,
    m, in the first arm's base frame, 0 where nothing was measured; per observed object
    ``object_<name>`` (7,), its pose in the world. A dash in a name becomes an underscore. :attr:`observation` is the
    complete record behind it, with every stamp; ``info["elapsed"]`` is its time since the reset, s.

    With a list of ``robots`` an action has the numbers of each arm, one arm after the other (:attr:`action_names`), and
    the arm's name leads its entries of the observation: ``left_q``. A stop of one arm ends the episode for all.

    ``step`` sends the action, lets one period pass and waits for an observation that was taken after that, so that no
    observation is returned twice. If the arm is stopped (releasing the dead-man is not a stop), the episode is
    truncated and ``info["stopped"]`` has the reason.

    Args:
        rig: The rig's configuration, as for :func:`hal.open`.
        settings: How the environment acts and observes; None for the class's :attr:`settings`.
        sim: True for simulated drivers, as for :func:`hal.open`.
        driver: Driver of all devices, as for :func:`hal.open`.
        engine: Engine of the simulated world, as for :func:`hal.open`.
        overrides: Changes of the configuration, ``key=value``.
        deadman: Makes the dead-man from the open rig, for example ``lambda rig: rig.gamepads["pad"].hold("l2")``;
            something that really moves needs it, or ``unattended=True``.
        unattended: Let a real arm move without a dead-man.
        render_mode: None or ``rgb_array``.

    Raises:
        CommandError: An argument is wrong, also one of the control session (see :meth:`hal.robot.Robot.control`).
        NotSupported: The rig lacks a stream (code ``unknown_stream``) or a world (``no_world``); the arm takes no
            controller.
        DriverMissing: gymnasium is not installed.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # Gymnasium's own name and type
    settings: EnvSettings = EnvSettings()
    """How the environment acts and observes."""

    def __init__(
        self,
        rig: str | Path | Mapping[str, Any] = "panda_table",
        settings: EnvSettings | None = None,
        *,
        sim: bool | None = None,
        driver: str | None = None,
        engine: str | None = None,
        overrides: tuple[str, ...] = (),
        deadman: Callable[[Rig], Deadman] | None = None,
        unattended: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            text = f"render_mode {render_mode!r}: use rgb_array, the first camera's picture"
            raise NotSupported(text, code="render_mode")
        if deadman is not None and not callable(deadman):
            raise CommandError(f"deadman must be a function of the rig, not {deadman!r}", code="not_callable")
        self.render_mode, self._unattended = render_mode, unattended
        if settings is not None:
            self.settings = settings
        chosen = self.settings
        self.rig = self._open(rig, deadman is not None, sim=sim, driver=driver, engine=engine, overrides=overrides)
        try:
            robots = _choose_robots(self.rig, chosen.robots)
            several = not isinstance(chosen.robots, str | None)
            self.robot: Robot = robots[0]
            """The arm; the first of several."""
            self._arms = tuple(_EnvArm(arm, chosen.action) for arm in robots)
            self._leads = {entry_key(arm.name, "") if several else "": arm for arm in robots}
            self.action_names = action_names(robots, chosen.action, several)
            """Name of each number of an action; with several arms after the arm's name, as in recordings."""
            self._deadman = deadman(self.rig) if deadman is not None else None
            self._cameras = tuple(self.rig.cameras if chosen.cameras is None else chosen.cameras)
            self._objects = _check_objects(chosen.objects, self.rig)
            cameras = [self.rig.cameras[name] for name in self._cameras]
            streams = chosen.streams
            self._streams = ("color", "depth") if streams is None else _check_streams(streams, cameras)
            self.action_space: Box = action_space(  # type: ignore[assignment]  # invariant in their types
                robots, chosen.action, chosen.rate_hz, chosen.speeds
            )
            self.observation_space: Dict = observation_space(  # type: ignore[assignment]
                self._leads, cameras, self._streams, self._objects
            )
            self._check_sessions()
        except BaseException:
            self.rig.close()
            raise
        self._steps, self._due, self._start = 0, 0.0, 0.0
        self.observation: Observation | None = None
        """The complete record behind the newest observation."""

    # What a subclass overrides.

    def reward(self) -> float:
        """Return the reward of a step; called after each, when :attr:`observation` is new."""
        return 0.0

    def success(self) -> bool:
        """Return whether the task is done, which ends the episode; called after each step, before :meth:`reward`."""
        return False

    def arrange(self, options: dict[str, Any]) -> None:
        """Arrange the scene; called in each reset before the first observation, with the reset's ``options``.

        It is the time for the operator to arrange a real bench, or to move simulated objects with ``self.rig.world``
        and ``self.np_random``.
        """

    # Gymnasium's interface.

    def _check_sessions(self) -> None:
        """Check the arguments of the arms' control sessions, and open none. Raises CommandError."""
        from ..servo.controllers import Position

        # Whether a pad can be trusted is checked at the reset: it may be asleep.
        free = self._unattended or self._deadman is not None
        for arm in self._arms:
            checked = arm.robot.control(
                rate_hz=self.settings.rate_hz, unattended=free, controller=self.settings.controller
            )
            if self.settings.action == "torque" and checked.controller != Position():
                raise CommandError("action='torque' takes no controller", code="torques_by_controller")

    @staticmethod
    def _open(rig: str | Path | Mapping[str, Any], pads: bool, **options: Any) -> Rig:
        """Open the rig, in lock-step if nothing real is in it; ``options`` are those of :func:`hal.open`."""
        from ..config import load

        plan = load(rig, **options).resolve()
        attended = [arm.name for arm in plan.robots if arm.attended]
        if simulated_only and (attended or pads):
            what = f"{', '.join(attended)} really moves; pass sim=True" if attended else "deadman= is for real arms"
            raise NotSupported(f"make_vec: {what}", code="not_simulated")
        clock = None if attended or pads else "lock_step"
        return open_rig(rig, clock=clock, pad=None if pads else "none", **options)

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
            MotionStopped: After ``rig.stop()``, until :meth:`rearm`.
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
                vary=last,
            )
        self._place(starts)
        self.arrange(options)
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
                deadman=self._deadman,
                rate_hz=self.settings.rate_hz,
                unattended=self._unattended,
                controller=self.settings.controller,
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
        if numbers.shape != (count := (sum(arm.size for arm in self._arms),)):
            raise CommandError(f"an action has shape {count}, not {numbers.shape}", code="bad_action")
        clock = self.rig.clock
        stops, first = [], 0
        for arm in self._arms:
            if arm.control is None:
                raise CommandError("call reset before step", code="not_reset")
            command, grip = arm.command(numbers[first : first + arm.size])
            first += arm.size
            stops += self._list_stops(arm, partial(arm.control.send, command, grip=grip))
        now = clock.now()
        self._due = max(self._due + 1.0 / self.settings.rate_hz, now)  # a late turn is not caught up
        clock.sleep_until(self._due)
        for arm in self._arms:
            assert arm.control is not None
            stops += self._list_stops(arm, arm.control.check)
        observation = self.rig.observe(after=self._find_oldest(now), cameras=self._cameras)
        self._steps += 1
        shown, most = self._observation_dict(observation), self.settings.max_steps
        terminated, reward = bool(self.success()), float(self.reward())
        truncated = bool(stops) or (most is not None and self._steps >= most)
        info = self._info(observation)
        if stops:
            info["stopped"] = stops[0]
        return shown, reward, terminated, truncated, info

    def _list_stops(self, arm: _EnvArm, call: Callable[[], object]) -> list[str]:
        """Return why a call to the session of an arm finds it stopped; empty if it does not."""
        try:
            call()
        except (MotionStopped, RobotFault) as stop:
            reason = stop.reason if isinstance(stop, MotionStopped) else stop.cause
            return [f"{arm.robot.name}: {reason}" if len(self._arms) > 1 else reason]
        return []

    def rearm(self) -> None:
        """Acknowledge ``rig.stop()``, so that :meth:`reset` drives again; in worlds of ``make_vec``: ``call("rearm")``.

        Only the operator, or a program that is responsible for safety, may do so.
        """
        self.rig.rearm()

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


def _choose_robots(rig: Rig, robots: str | Sequence[str] | None) -> list[Robot]:
    """Return the arms of an environment. Raises CommandError if none is named, or one twice."""
    if robots is None:
        return [next(iter(rig.robots.values()))]
    if isinstance(robots, str):
        return [rig.robots[robots]]
    if not robots or len(set(robots)) < len(robots):
        raise CommandError("robots='left', or robots=['left', 'right']: each arm once", code="bad_robots")
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
    there = {stream for camera in cameras for stream in list_streams(camera.spec)}
    if missing := [stream for stream in streams if stream not in there]:
        message = (
            f"streams=: no observed camera has {', '.join(missing)}; they have: {', '.join(sorted(there)) or 'none'}"
        )
        raise NotSupported(
            f"{message}. The streams of a camera are chosen in its entry of the rig", code="unknown_stream"
        )
    return tuple(streams)
