"""Many copies of one simulated rig, in a few processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'robot-hal[gym]'")

from gymnasium.vector import AutoresetMode  # noqa: E402
from gymnasium.wrappers.vector import DictInfoToList  # noqa: E402

from hal.gym import EnvSettings, RigEnv, RigVectorEnv, make_vec  # noqa: E402

RIG: dict[str, Any] = {"sim": True, "overrides": ("cameras={}",)}
COUNT = 3


def make_class() -> type[RigEnv]:
    class Ahead(RigEnv):  # copied into the processes, as it is in no module
        settings = EnvSettings(action="twist", objects=["cube"], max_steps=3)
        broken = False

        def reward(self) -> float:
            if self.broken:
                raise ValueError("no reward")
            assert self.observation is not None
            return float(self.observation.robots["panda"].tcp.position[0])

    return Ahead


@pytest.fixture(scope="module")
def envs() -> Iterator[RigVectorEnv]:
    made = make_vec(make_class(), COUNT, processes=2, **RIG)
    yield made
    made.close()


def test_each_world_is_to_the_bit_a_rig_with_its_own_seed(envs: RigVectorEnv) -> None:
    """Past the end of an episode: the step after it resets, and ignores its action."""
    worlds = DictInfoToList(envs)
    singles = [make_class()(**RIG) for _ in range(COUNT)]
    try:
        assert envs.single_observation_space == singles[0].observation_space
        assert envs.single_action_space == singles[0].action_space
        assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP

        def compare(seen: Any, infos: Any, expected: list[Any]) -> None:
            assert envs.observation_space.contains(seen)
            for k, (alone, info) in enumerate(expected):
                assert all(seen[key][k].tobytes() == values.tobytes() for key, values in alone.items())
                assert infos[k].keys() == info.keys()
                assert infos[k]["elapsed"] == info["elapsed"]
                assert all((infos[k]["poses"][key] == pose).all() for key, pose in info.get("poses", {}).items())

        compare(*worlds.reset(seed=7), [env.reset(seed=7 + k) for k, env in enumerate(singles)])
        assert envs.np_random_seed == (7, 8, 9)
        random, ended = np.random.default_rng(1), False
        for _ in range(6):
            actions = random.uniform(-0.2, 0.2, (COUNT, 7)).astype(np.float32)
            seen, rewards, terminated, truncated, infos = worlds.step(actions)
            if ended:
                results = [(seen, 0.0, False, False, info) for seen, info in (env.reset() for env in singles)]
            else:
                results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
            compare(seen, infos, [(result[0], result[4]) for result in results])
            assert rewards.tolist() == [result[1] for result in results]
            assert terminated.tolist() == [result[2] for result in results]
            assert truncated.tolist() == [result[3] for result in results]
            ended = bool(truncated[0])
        assert envs.np_random_seed == (7, 8, 9)
    finally:
        for env in singles:
            env.close()


def test_seeds_and_resets_of_some_worlds(envs: RigVectorEnv) -> None:
    first, _ = envs.reset(seed=[5, 5, 6])
    assert (first["object_cube"][0] == first["object_cube"][1]).all()
    assert (first["object_cube"][0] != first["object_cube"][2]).any()
    envs.step(np.full((COUNT, 7), 0.2, np.float32))
    seen, infos = envs.reset(seed=[5, None, None], options={"reset_mask": np.array([True, False, False])})
    assert (seen["q"][0] == first["q"][0]).all()
    assert (seen["q"][1:] != first["q"][1:]).any(), "they were not reset"
    assert infos["_elapsed"].tolist() == [True, False, False]
    for wrong, code in (
        ({"seed": [1, 2]}, "bad_seed"),
        ({"options": {"reset_mask": [0, 0, 1]}}, "bad_reset_mask"),
        ({"options": {"reset_mask": np.zeros(COUNT, bool)}}, "bad_reset_mask"),
    ):
        with raises_code(hal.CommandError, code):
            envs.reset(**wrong)
    with raises_code(hal.CommandError, "bad_action"):
        envs.step(np.zeros(7, np.float32))


def make_bare() -> type[gymnasium.Env]:
    class Bare(gymnasium.Env):
        """An environment without a rig."""

        observation_space = gymnasium.spaces.Dict({"x": gymnasium.spaces.Box(0.0, 1.0)})
        action_space = gymnasium.spaces.Box(0.0, 1.0)

        def reset(self, **_: Any) -> Any:
            return {"x": np.zeros(1, np.float32)}, {}

        def step(self, action: Any) -> Any:
            return {"x": np.ones(1, np.float32)}, 1.0, False, False, {}

    return Bare


def test_an_environment_may_have_no_rig_and_a_rig_is_none() -> None:
    envs = make_vec(make_bare(), 2, processes=1)
    try:
        envs.reset()
        seen, rewards, *_, infos = envs.step(envs.action_space.sample())
        assert (seen["x"].tolist(), rewards.tolist()) == ([[1.0], [1.0]], [1.0, 1.0])
        assert not infos["_elapsed"].any()
    finally:
        envs.close()
    for rig in ({"robots": {}}, Path("rig.yaml")):
        with pytest.raises(hal.CommandError, match=r"make_vec\(RigEnv, 4, rig=[{P]") as caught:
            make_vec(rig, 2)  # type: ignore[arg-type]
        assert caught.value.code == "unknown_environment"


def test_an_error_in_one_world_names_it_and_a_reset_starts_again(envs: RigVectorEnv) -> None:
    envs.reset(seed=1)
    envs.set_attr("broken", [False, False, True])
    with pytest.raises(hal.HalError, match=r"world 2: ValueError: no reward\n(.*\n)+.*in reward"):
        envs.step(envs.action_space.sample())
    envs.set_attr("broken", False)
    assert envs.get_attr("broken") == (False, False, False)
    with raises_code(hal.CommandError, "bad_action"):  # the type and code of an error of the rig stay
        envs.call("step", np.zeros(3))
    seen, _ = envs.reset(seed=1)
    assert envs.call("has_wrapper_attr", "rig") == (True, True, True)
    assert envs.observation_space.contains(seen)
    with raises_code(hal.CommandError, "bad_count"):
        envs.set_attr("broken", [True, False])


def test_same_step_resets_at_once_and_keeps_the_last_pictures() -> None:
    overrides = ("cameras.scene.output={width: 32, height: 24}", "cameras.wrist.output={width: 32, height: 24}")
    settings = EnvSettings(action="twist", max_steps=2)
    options: dict[str, Any] = {"driver": "mock", "settings": settings, "overrides": overrides}
    envs = make_vec(RigEnv, 2, processes=1, autoreset_mode="SameStep", **options)
    try:
        first, _ = envs.reset(seed=1)
        first = {key: values.copy() for key, values in first.items()}
        action = np.full((2, 7), 0.1, np.float32)
        middle, *_ = envs.step(action)
        seen, _, _, truncated, infos = envs.step(action)
        assert truncated.all()
        assert infos["final_info"]["elapsed"] == pytest.approx([0.1, 0.1])
        assert infos["elapsed"] == pytest.approx([0.0, 0.0])
        for k in range(2):
            final = infos["final_obs"][k]
            assert envs.single_observation_space.contains(final)
            assert (final["tcp"] != seen["tcp"][k]).any()
            assert (final["scene_color"] != middle["scene_color"][k]).any(), "a mock's pictures show its time"
            assert seen["q"][k] == pytest.approx(first["q"][k], abs=1e-3)
        pictures = envs.render()
        assert all((picture == seen["scene_color"][k]).all() for k, picture in enumerate(pictures))
    finally:
        envs.close()


def test_a_killed_process_is_an_error_and_leaves_nothing_behind() -> None:
    envs = make_vec(RigEnv, 2, processes=2, driver="mock", overrides=("cameras={}",))
    try:
        envs.reset(seed=1)
        children = envs._children
        os.kill(children[1].process.pid, signal.SIGKILL)
        with raises_code(hal.ConnectionLost, "process_ended"):
            for _ in range(3):
                envs.step(envs.action_space.sample())
        assert [child.process.poll() is None for child in children] == [False, False]
        assert envs.closed
        with raises_code(hal.HalError, "closed"):
            envs.reset()
    finally:
        envs.close()


def test_what_cannot_be_is_refused() -> None:
    for options, error, code in (
        ({"num_envs": 0}, hal.CommandError, "bad_count"),
        ({"num_envs": 1.5}, hal.CommandError, "bad_count"),
        ({"processes": 0}, hal.CommandError, "bad_count"),
        ({"autoreset_mode": "never"}, hal.CommandError, "bad_autoreset"),
        ({"driver": "mock", "deadman": len}, hal.NotSupported, "not_simulated"),
        ({"sim": False, "overrides": ("robots.panda.real.host=172.16.0.2",)}, hal.NotSupported, "not_simulated"),
        ({"driver": "mock", "settings": EnvSettings(robots=[])}, hal.CommandError, "bad_robots"),
        ({"env": "hal/PickCup-v0"}, hal.CommandError, "unknown_environment"),
        ({"env": "CartPole-v1"}, hal.NotSupported, "no_dict"),
    ):
        with raises_code(error, code):
            make_vec(**{"env": RigEnv} | options)
