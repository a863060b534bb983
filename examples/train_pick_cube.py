"""Train a policy for hal/PickCube-v0 on its state with PPO, and plot how it does with seeds it was not trained on.

pip install 'robot-hal[gym,mujoco]' stable-baselines3 matplotlib
python examples/train_pick_cube.py        # 80 minutes of processor time, 40 on two cores
"""

import argparse
import time

import gymnasium
import numpy as np

import hal.gym  # registers the tasks

SEEDS, STEPS, GAMMA = range(1000, 1020), 60, 0.95  # of the evaluations, of an episode, discount
TASK = {"rate_hz": 10, "max_episode_steps": STEPS, "engine": "mujoco", "overrides": ("simulation.physics_hz=60",)}


class State(gymnasium.Wrapper):
    """Observe 10 numbers: the ways from hand to cube and on to the goal, heights, fingers, and the turn to the cube."""

    observation_space = gymnasium.spaces.Box(-50.0, 50.0, (10,), np.float32)

    def select(self, seen):
        tcp, cube, goal = (hal.Pose(seen[name][:3], seen[name][3:]) for name in ("tcp", "object_cube", "object_goal"))
        x, y = (tcp.inverse() @ cube).matrix()[:2, 0]
        turn = (np.arctan2(y, x) + np.pi / 4) % (np.pi / 2) - np.pi / 4  # four turns of a cube look alike
        ways = cube.position - tcp.position, goal.position - cube.position
        return np.array([*ways[0], *ways[1], tcp.position[2], cube.position[2], *seen["gripper"], turn], np.float32)

    def reset(self, **options):
        seen, info = self.env.reset(**options)
        return self.select(seen), info

    def step(self, action):
        seen, reward, terminated, truncated, info = self.env.step(action)
        stopped = "stopped" in info  # must not be a way out of negative rewards
        return self.select(seen), reward - 5.0 * stopped, terminated or stopped, truncated, info

    def process_time(self):
        return time.process_time()


def make():
    return State(gymnasium.make("hal/PickCube-v0", **TASK))


def evaluate(model, env):
    """Return the mean sum of rewards, and the % of episodes that lift the cube, that succeed, and that a stop ends."""
    results = []
    for seed in SEEDS:
        (seen, info), total, ended = env.reset(seed=seed), 0.0, False
        while not ended:
            action, _ = model.predict(model.get_vec_normalize_env().normalize_obs(seen), deterministic=True)
            seen, reward, terminated, truncated, info = env.step(action)
            total, ended = total + reward, terminated or truncated
        lifted = env.unwrapped.poses["cube"].position[2] > 0.05
        results.append((total, 100 * lifted, 100 * info["success"], 100 * ("stopped" in info)))
    return np.mean(results, axis=0)


def plot(rows):
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    axes[0].plot([row[0] for row in rows], [row[2] for row in rows], ".-")
    axes[1].plot([row[0] for row in rows], [row[3:] for row in rows], ".-", label=["lifted", "success", "stopped"])
    axes[0].set(xlabel="processor time, min", ylabel="sum of rewards")
    axes[1].set(xlabel="processor time, min", ylabel="% of 20 episodes")
    axes[1].legend()
    plt.savefig("pick_cube.png", dpi=80)
    plt.close()


def train(minutes):
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

    torch.set_num_threads(1)
    env, worlds, rows, spent = make(), SubprocVecEnv([make] * 2, "spawn"), [], 0.0
    options = {"n_steps": 1024, "batch_size": 128, "gae_lambda": 0.9, "policy_kwargs": {"log_std_init": -0.7}}
    model = PPO("MlpPolicy", VecNormalize(worlds, gamma=GAMMA), gamma=GAMMA, seed=0, **options)
    while not rows or spent < minutes:
        model.learn(8192, reset_num_timesteps=False)
        spent = (time.process_time() + sum(worlds.env_method("process_time"))) / 60.0
        rows.append((spent, model.num_timesteps, *evaluate(model, env)))
        print("minutes, steps, reward, lifted, success, stopped:", *np.round(rows[-1], 1), flush=True)
        plot(rows)
    model.save("pick_cube.zip")
    worlds.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=80.0, help="processor time of all processes")
    train(parser.parse_args().minutes)
