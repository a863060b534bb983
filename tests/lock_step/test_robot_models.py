"""Every built-in model of an arm whose package is installed, alone in a world, on each engine."""

from __future__ import annotations

from typing import Any

import pytest
from benchmark_kit import load_benchmark
from engines_kit import Engine

from hal.config.data_files import list_data
from hal.errors import ConfigError
from hal.types import Trip

robots = load_benchmark("robots")
pytestmark = pytest.mark.slow
ENTRIES = [entry for model in list_data("robots") for entry in robots.entries(model)]


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: "-".join(entry.values()))
def test_a_model_drives_and_closes_its_gripper(engine: Engine, entry: dict[str, Any]) -> None:
    try:
        found = robots.run_model(entry, engine.name, poses=10, tour=0.1)
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise
    assert found.found == 10
    assert found.position <= 1e-5
    assert found.trip is Trip.NONE
    assert found.lag < 0.01
    if found.widths is not None:
        assert found.widths[1] < 2e-3 < 0.02 < found.widths[0]
