"""Scores of random and of scripted actions in each task, and verdicts by depth beside the truth.

Goals: the scripted solution of each task succeeds with 19 of 20 seeds on each engine, and a verdict by depth is that of
the simulation in each of 100 states.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from importlib import import_module

import gymnasium
import numpy as np

from hal.errors import CommandError
from hal.gym import TaskEnv
from hal.learning.tasks import TASKS
from hal.learning.tasks.by_depth import DepthJudge

from .kit import ENGINES, Table

PATHS = (
    "hal/learning/gym.py",
    "hal/learning/tasks",
    "config/objects",
    "hal/servo",
    "drivers/pybullet",
    "drivers/mujoco",
)
JUDGED = ("PickCube", "PushCube", "StackCubes")
"""Tasks with cubes, which depth finds."""
REST = 12
"""Steps without motion before a verdict."""


def run_episode(env: gymnasium.Env, seed: int, scripted: bool) -> tuple[float, bool]:
    """Return the sum of the rewards of one episode with scripted or random actions, and whether it succeeded."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    task = env.unwrapped
    assert isinstance(task, TaskEnv)
    total, info = 0.0, {"success": False}
    try:
        for action in task.solve() if scripted else (env.action_space.sample() for _ in itertools.count()):
            _, reward, terminated, truncated, info = env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
    except CommandError as error:  # an episode that fails, as any other
        if error.code != "not_arrived":
            raise
    return total, info["success"]


def scores(tasks: Iterable[str], engines: Iterable[str], episodes: int, few: int) -> Table:
    """Return the mean sum of dense rewards, and the successes, of random and of scripted actions."""
    names = ("", "random return", "random successes", "scripted return", "scripted successes")
    table = Table(f"{episodes} seeds of scripted and {few} of random actions", names)
    for name, engine in itertools.product(tasks, engines):
        env, row = gymnasium.make(f"hal/{name}-v0", engine=engine), []
        for scripted, count in ((False, few), (True, episodes)):
            totals, done = zip(*(run_episode(env, seed, scripted) for seed in range(count)), strict=True)
            row += [float(np.mean(totals)), sum(done)]
        table.add(f"{name}, {engine}", *row)
        env.close()
    return table


def make_unseen(name: str) -> TaskEnv:
    """Return a task whose goals no camera sees: on a real table there are none."""
    task: type[TaskEnv] = getattr(import_module(f"hal.learning.tasks.{TASKS[name][0]}"), name)
    hidden = tuple(dict(entry) | {"visible": entry.get("collision", True)} for entry in task.objects)
    return type(name, (task,), {"objects": hidden})(render_mode="rgb_array")


def judge_state(env: TaskEnv, judge: DepthJudge, seed: int) -> tuple[bool, bool, list[float]]:
    """Return the verdicts by depth and by the simulation after a part of the scripted solution, and the errors, m."""
    env._judge, env._cameras, cameras = None, (), env._cameras
    env.reset(seed=seed)
    end = int(np.random.default_rng(seed).integers(20, 120))
    action = env.move(np.zeros(4), -1.0)
    for action in itertools.islice(env.solve(), end):
        if env.step(action)[2]:
            break
    env._judge, env._cameras = judge, cameras
    for _ in range(REST):
        *_, info = env.step(env.move(np.zeros(4), action[4]))
    found, base = dict(env.poses), env.robot.base.inverse()
    env._judge = None
    env.poses |= {name: base @ env.rig.world.pose(name) for name in judge.names}
    off = [env.poses[name].distance(found[name])[0] for name in judge.names]
    return bool(info["success"]), bool(env.success()), off


def verdicts(tasks: Iterable[str], states: int) -> Table:
    """Return how many verdicts by depth are those of the simulation, and how far off the cubes are found."""
    table = Table(f"{states} states each", ("", "equal", "of them successes", "median error, mm", "greatest, mm"))
    for name in tasks:
        env = make_unseen(name)
        judge = DepthJudge(env, env.objects)
        by_depth, true, off = zip(*(judge_state(env, judge, seed) for seed in range(states)), strict=True)
        equal, errors = np.equal(by_depth, true), 1e3 * np.concatenate(off)
        table.add(name, int(equal.sum()), sum(true), float(np.median(errors)), float(errors.max()))
        env.close()
    return table


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    yield verdicts(JUDGED[:1] if quick else JUDGED, 1 if quick else 100)
    yield scores(JUDGED[:1], ENGINES[:1], 1, 1) if quick else scores(TASKS, ENGINES, 20, 3)
