"""Scenes that vary: from ranges in a rig file to episodes that name their values, and back to the same picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines_kit import need_engine

import hal
from hal.apps import generate, replay
from hal.learning.episode import reset_scene
from hal.recording import Dataset

pytestmark = pytest.mark.timeout(120)
RIG = """
robots: {panda: {model: panda, base: {position: [-0.55, 0, 0.6]}}}
cameras:
  scene:
    model: pinhole
    capture: {width: 96, height: 96, rate_hz: 30}
    field_of_view: {vertical_deg: 50}
    look_at: {target: [-0.1, 0, 0.75], distance: 1.5, yaw_deg: -60, pitch_deg: -35}
objects: [floor, table, cube]
simulation:
  randomize:
    light: {count: [1, 3], azimuth_deg: [-180, 180], elevation_deg: [30, 80], intensity: [0.7, 1.5], ambient: [0.6, 1]}
    background: {color: [[0.2, 0.2, 0.2], [1, 1, 1]], texture: [none, marble, wall.png]}
    objects:
      "*": {color: [[0.1, 0.1, 0.1], [1, 1, 1]], texture: [none, checker, wood]}
      cube: {color: [[0.5, 0, 0], [1, 0.2, 0.2]], mass_scale: [0.5, 2], friction_scale: [0.7, 1.3]}
    robots:
      panda:
        links: {hand: {color: [[0, 0, 0], [1, 1, 1]]}}
        command_latency_s: [0.01, 0.03]
        position_noise: [0, 1e-4]
    cameras:
      scene: {position_m: [-0.02, 0.02], rotation_deg: [-2, 2], field_of_view_scale: [0.9, 1.1], exposure: [0.7, 1.3],
              color_noise: [0, 0.03], depth_noise: [0, 0.004]}
    distractors:
      objects:
        - {name: ball, shape: sphere, radius: 0.03, mass: 0.1, position: [0.2, 0.3, 0.655], random: {x: [0.1, 0.3]}}
        - {name: can, shape: cylinder, radius: 0.03, length: 0.1, mass: 0.3, position: [0.2, -0.3, 0.675],
           random: {x: [0.1, 0.3], y: [-0.4, -0.2]}}
      count: [1, 2]
"""
ENGINES = ("mujoco", "pybullet")


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from PIL import Image

    folder = tmp_path_factory.mktemp("rig")
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)).save(folder / "wall.png")
    (folder / "rig.yaml").write_text(RIG)
    return folder / "rig.yaml"


def opened(rig: Path | dict[str, Any], engine: str) -> hal.Rig:
    return hal.open(rig, sim=True, clock="lock_step", pad="none", engine=engine)


def pictures(rig: hal.Rig) -> dict[str, np.ndarray]:
    frame = rig.cameras["scene"].read()
    assert frame.color is not None
    assert frame.depth is not None
    return {"scene.color": frame.color, "scene.depth": frame.depth}


def same(one: Any, other: Any) -> bool:
    return all(np.array_equal(one[key], other[key]) for key in ("scene.color", "scene.depth"))


def reset(rig: hal.Rig, seed: int | None) -> dict[str, np.ndarray]:
    random = None if seed is None else np.random.default_rng(seed)
    reset_scene(rig, rig.robots["panda"], random=random, seed=seed)
    return pictures(rig)


def test_an_episode_names_what_was_drawn_and_its_seed_draws_its_picture_again(
    rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HAL_TEST_PICTURES", str(tmp_path))
    out = tmp_path / "out"
    options = ["--config", str(rig_file), "--sim", "--engine", ENGINES[0], "--skill", "demonstrations:look"]
    assert generate.main([*options, "--episodes", "2", "--seed", "7", "--seconds", "5", "--out", str(out)]) == 0
    episodes = Dataset(out).episodes
    drawn = [episode.info["randomization"] for episode in episodes]
    assert [record["seed"] for record in drawn] == [7, 8] == [episode.info["seed"] for episode in episodes]
    first, second = (record["values"] for record in drawn)
    assert first["objects.cube.mass_scale"] != second["objects.cube.mass_scale"]
    assert all(0.01 <= values["robots.panda.command_latency_s"] <= 0.03 for values in (first, second))

    seen = dict(np.load(tmp_path / "8.npz"))
    for engine in ENGINES:
        with opened(rig_file, engine) as rig:
            plain = reset(rig, None)
            mass, K = rig.world.dynamics("cube")["mass"], rig.cameras["scene"].K
            again = reset(rig, 8)
            if engine == ENGINES[0]:
                assert same(again, seen)
            else:  # an engine may place a body, and its box, where another one does to within a rounding error
                different = (again["scene.color"] != seen["scene.color"]).any(axis=2)
                assert different.mean() < 0.002
            assert rig.world.randomization == drawn[1]
            assert rig.world.dynamics("cube")["mass"] == pytest.approx(mass * second["objects.cube.mass_scale"])
            assert rig.cameras["scene"].K[0, 0] == pytest.approx(K[0, 0] / second["cameras.scene.field_of_view_scale"])
            assert {"ball", "can"} & set(rig.world.bodies) == set(second["distractors"])

            other = reset(rig, 7)
            assert not same(other, again)
            assert same(reset(rig, 8), again), "the same seed is the same scene, whatever came before"
            rig.world.randomize(drawn[0])
            assert rig.world.randomization == drawn[0]
            assert same(reset(rig, None), plain), "without a seed the scene is that of the rig file"
            assert rig.world.dynamics("cube")["mass"] == mass
            assert rig.cameras["scene"].K[0, 0] == K[0, 0]
            assert rig.world.randomization is None

    overrides = ["--config", str(rig_file), "--sim", "--engine", ENGINES[0], "--set", "simulation.clock=lock_step"]
    assert replay.main([str(out), "--episode", "1", *overrides]) == 0


@pytest.fixture(params=ENGINES)
def late(request: pytest.FixtureRequest) -> Iterator[hal.Rig]:
    robot = {
        "command_latency_s": [0.05, 0.05],
        "state_latency_s": [0.025, 0.025],
        "gripper": {"state_latency_s": [0.05] * 2},
    }
    camera = {
        "model": "pinhole",
        "capture": {"width": 16, "height": 16, "rate_hz": 30},
        "pose": {"position": [0, 0, 2]},
    }
    varies = {"robots": {"*": robot}, "cameras": {"*": {"latency_s": [0.1, 0.1]}}}
    config = {
        "robots": {"panda": {"model": "panda"}},
        "cameras": {"eye": camera | {"field_of_view": {"vertical_deg": 50}, "streams": ["color"]}},
        "simulation": {"physics_hz": 240, "randomize": varies},
    }
    with opened(config, request.param) as rig:
        yield rig


def test_sensors_and_commands_are_as_late_as_was_asked(late: hal.Rig) -> None:
    arm, dt = late.robots["panda"], 1.0 / 240.0
    assert arm.gripper is not None
    late.world.randomize(0)
    states = []
    with arm.control(rate_hz=240) as control:
        for _ in late.clock.rate(240):
            control.send(hal.JointVelocity([0.3, 0, 0, 0, 0, 0, 0]))
            states.append(arm.state())
            if len(states) == 120:
                break
        eye, grip, now = late.cameras["eye"].read(), arm.gripper.state(), late.clock.now()
    assert states[-1].stamp.t - states[-1].stamp.t_device == pytest.approx(0.025)
    assert now - eye.stamp.t == pytest.approx(0.1)
    assert grip.stamp.t - grip.stamp.t_device == pytest.approx(0.05)
    # A set-point is followed in the step after it was written, and is measured after the latencies of both.
    steps = 1 + round((0.05 + 0.025) / dt)
    q, q_set = np.array([state.q[0] for state in states]), np.array([state.q_set[0] for state in states])
    assert q_set[-1] - q_set[0] > 0.05, "it moved"
    assert np.abs(q[60:] - q_set[60 - steps : -steps]).max() < 1e-4

    late.world.randomize(None)
    late.clock.sleep(0.2)
    state = arm.state()
    assert state.stamp.t == pytest.approx(state.stamp.t_device)
    assert late.cameras["eye"].read().stamp.t == pytest.approx(late.clock.now())


def test_an_environment_varies_with_the_seed_of_its_reset(rig_file: Path) -> None:
    gym = pytest.importorskip("hal.gym", reason="pip install 'robot-hal[gym]'")
    env = gym.RigEnv(rig_file, sim=True, engine=ENGINES[0])
    try:
        first, info = env.reset(seed=3)
        drawn = info["randomization"]
        assert drawn["seed"] == 3
        _, following = env.reset()
        assert following["randomization"]["values"] != drawn["values"], "the next episode is another scene"
        again, info = env.reset(seed=3)
        assert info["randomization"] == drawn
        assert all(np.array_equal(again[key], value) for key, value in first.items())
    finally:
        env.close()


def test_each_value_changes_what_it_is_for_and_a_record_holds_what_can_be_drawn(rig_file: Path) -> None:
    with opened(rig_file, ENGINES[0]) as rig:
        plain = pictures(rig)
        drawn = next(record["values"] for seed in range(20) if _shows_much(record := rig.world.randomize(seed)))
        for key in (
            "light.0.azimuth_deg",
            "light.ambient",
            "background.color",
            "objects.table.texture",
            "objects.cube.color",
            "robots.panda.links.panda_hand.color",
            "cameras.scene.exposure",
            "cameras.scene.color_noise",
            "cameras.scene.depth_noise",
        ):
            rig.world.randomize({"seed": 1, "values": {key: drawn[key]}})
            seen = pictures(rig)
            changed = [name for name in seen if not np.array_equal(seen[name], plain[name])]
            assert changed == ["scene.depth" if "depth" in key else "scene.color"], key
        rig.world.randomize(None)
        assert same(pictures(rig), plain)
        for wrong in (
            {"robots.panda.command_latency_s": -3.0},
            {"robots.panda.command_latency_s": "2"},
            {"cameras.scene.position_m": [0.0]},
            {"distractors": ["mug"]},
            {"light.hue": 1.0},
        ):
            with pytest.raises(hal.CommandError) as found:
                rig.world.randomize({"seed": 1, "values": wrong})
            assert found.value.code == "bad_record"
        assert same(pictures(rig), plain)


def _shows_much(record: Any) -> bool:
    values = record["values"]
    return bool(values["objects.table.texture"]) and abs(values["cameras.scene.exposure"] - 1.0) > 0.1


def test_commands_under_way_move_no_arm_after_its_link_was_lost(late: hal.Rig) -> None:
    arm, device = late.robots["panda"], late.driver("panda")
    late.world.randomize(0)
    with pytest.raises(hal.HalError), arm.control(rate_hz=240) as control:
        for tick in late.clock.rate(240):
            control.send(hal.JointVelocity([0.5, 0, 0, 0, 0, 0, 0]))
            if tick.elapsed > 0.5:
                device.inject(disconnect=True)
    late.clock.sleep(0.5)
    there = late.world.pose("panda", "panda_hand")
    arm.recover()
    late.clock.sleep(0.5)
    assert there.distance(late.world.pose("panda", "panda_hand"))[0] < 1e-3


def test_late_fingers_do_one_command_after_the_other() -> None:
    varies = {"robots": {"*": {"gripper": {"command_latency_s": [0.2, 0.2]}}}}
    config = {"robots": {"panda": {"model": "panda"}}, "simulation": {"physics_hz": 240, "randomize": varies}}
    with opened(config, ENGINES[0]) as rig:
        gripper = rig.robots["panda"].gripper
        assert gripper is not None
        rig.world.randomize(0)
        gripper.start(0.0)
        rig.clock.sleep(0.19)
        assert gripper.state().width > 0.078, "the first command has not arrived"
        gripper.start(0.08)
        rig.clock.sleep(0.19)
        assert gripper.state().width < 0.07, "the second one has not arrived"
        rig.clock.sleep(1.5)
        assert gripper.state().width > 0.078


def test_noise_of_commands_takes_no_joint_over_its_limits() -> None:
    varies = {"robots": {"*": {"command_noise": [0.1, 0.1]}}}
    config = {"robots": {"panda": {"model": "panda"}}, "simulation": {"physics_hz": 240, "randomize": varies}}
    with opened(config, ENGINES[0]) as rig:
        arm = rig.robots["panda"]
        goal = np.array(arm.home)
        goal[0] = arm.limits.upper[0] - 1e-4
        arm.move_to(goal)
        rig.world.randomize(0)
        seen = []
        with arm.control(rate_hz=240) as control:
            for tick in rig.clock.rate(240):
                control.send(hal.JointTarget(goal))
                seen.append(arm.state().q[0])
                if tick.elapsed > 0.5:
                    break
        assert np.ptp(seen) > 1e-3, "the arm shakes"
        assert max(seen) < arm.limits.upper[0] + 2e-3


def test_a_late_arm_follows_from_where_a_reset_put_it() -> None:
    """Its following error is that of the set-points that arrived, also before the first one has."""
    varies = {"robots": {"*": {"command_latency_s": [0.4, 0.4]}}}
    config = {"robots": {"panda": {"model": "panda"}}, "simulation": {"physics_hz": 240, "randomize": varies}}
    with opened(config, ENGINES[0]) as rig:
        arm = rig.robots["panda"]
        rig.world.randomize(0)
        rig.world.reset()
        with arm.control(rate_hz=60) as control:
            for tick in rig.clock.rate(60):
                control.send(hal.JointVelocity([1.0, 0, 0, 0, 0, 0, 0]))
                if tick.elapsed > 1.0:
                    break
        assert arm.state().q[0] - arm.home[0] > 0.3


def test_a_thin_rod_casts_a_shadow(tmp_path: Path) -> None:
    """All of its corners are within one cell of the coarse mesh that casts shadows."""
    rod = '<visual><origin xyz="0.02 0.02 0"/><geometry><cylinder radius="0.005" length="0.5"/></geometry></visual>'
    (tmp_path / "rod.urdf").write_text(f'<robot name="rod"><link name="base">{rod}</link></robot>')
    down = {"position": [0, 0, 2], "orientation": [1, 0, 0, 0]}
    eye = {"model": "pinhole", "capture": {"width": 64, "height": 64, "rate_hz": 30}, "pose": down}
    eye |= {"field_of_view": {"vertical_deg": 50}, "streams": ["color"]}
    objects = ["floor", {"name": "rod", "urdf": str(tmp_path / "rod.urdf"), "position": [0, 0, 1], "fixed": True}]
    seen = []
    for shadows in (True, False):
        config = {"cameras": {"eye": eye}, "objects": objects, "simulation": {"shadows": shadows}}
        with opened(config, ENGINES[0]) as rig:
            seen.append(rig.cameras["eye"].read().color)
    assert not np.array_equal(*seen)


def test_a_renderer_that_cannot_vary_the_light_says_so() -> None:
    need_engine("pybullet")
    eye = {"model": "pinhole", "capture": {"width": 16, "height": 16, "rate_hz": 30}, "pose": {"position": [0, 0, 2]}}
    eye |= {"field_of_view": {"vertical_deg": 50}, "streams": ["color"]}
    varies = {"light": {"ambient": [0.5, 1.0]}, "cameras": {"eye": {"exposure": [0.5, 1.5]}}}
    for name, told in (("tiny", True), ("gl", False)):
        simulation = {"renderer": name, "randomize": varies}
        with opened({"cameras": {"eye": eye}, "objects": ["floor"], "simulation": simulation}, "pybullet") as rig:
            assert any("light, exposure: without effect" in note for note in rig.notes) == told, rig.notes
