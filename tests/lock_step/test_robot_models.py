"""Every built-in model of an arm whose package is installed, alone in a world, on one engine or the other.

The contract of each model on each engine is in tests/contract/test_robot_models.py.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from benchmark_kit import load_benchmark
from engines_kit import Engine, has_engine

import hal
from hal import registry
from hal.config.data_files import list_data
from hal.errors import ConfigError
from hal.types import Trip

robots = load_benchmark("robots")
pytestmark = pytest.mark.slow
INSTALLED = [name for name in registry.ENGINES if has_engine(name)]
ENTRIES = [entry for model in list_data("robots") for entry in robots.entries(model)]


@contextmanager
def installed() -> Iterator[None]:
    """Skip the test if the package with the model's files is not installed."""
    try:
        yield
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise


@pytest.mark.parametrize(
    ("entry", "engine"),
    [
        pytest.param(entry, INSTALLED[turn % len(INSTALLED)], id="-".join(entry.values()))
        for turn, entry in enumerate(ENTRIES)
    ],
    indirect=["engine"],
)
def test_a_model_drives_closes_its_gripper_and_stays_where_a_reset_put_it(
    engine: Engine, entry: dict[str, Any]
) -> None:
    with installed():
        rig = robots.open_model(entry, engine.name)
    with rig:
        found = robots.drive_model(rig, poses=10, tour=0.05)
        assert found.found == 10
        assert found.moved > 0.05
        assert found.position <= 1e-5
        assert found.trip is Trip.NONE
        assert found.lag < 0.01
        if found.widths is not None:
            assert abs(found.widths[1] - found.width_min) < 2e-3
            assert found.widths[0] - found.width_min > 0.02
        if rig.robots["arm"].limits.torque is not None:
            check_that_it_stays(rig)


def test_a_hand_whose_fingers_are_cut_into_slices_needs_no_scipy() -> None:
    """trimesh asks for it where it makes a hull; the extra ``robots`` does not bring it."""
    pytest.importorskip("mujoco")
    code = (
        "import sys; sys.modules['scipy'] = None; import hal\n"
        "rig = {'sim': True, 'robots': {'arm': {'model': 'so101'}}}\n"
        "try: hal.open(rig, engine='mujoco', clock='lock_step').close()\n"
        "except hal.ConfigError as error: print(error.problems[0].code)\n"
    )
    said = subprocess.run([sys.executable, "-c", code], check=True, timeout=120.0, stdout=subprocess.PIPE, text=True)
    assert said.stdout.strip() in ("", "missing_package")


def check_that_it_stays(rig: hal.Rig) -> None:
    """Without torques, from the first step on: what the motors left undone in it would be a speed of the arm."""
    arm, rng, room = rig.robots["arm"], np.random.default_rng(2), 0.05
    for _ in range(2):
        q = arm.home + rng.uniform(-0.3, 0.3, arm.n)
        rig.world.reset("arm", q=np.clip(q, np.add(arm.limits.lower, room), np.subtract(arm.limits.upper, room)))
        start = arm.state().q
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.JointTorque([0.0] * arm.n))
                if tick.elapsed >= 2.0:
                    break
        assert np.abs(arm.state().q - start).max() < 2e-3
