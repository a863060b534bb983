"""The quickest experiments of ``hal check --physics``; ``tests/apps/test_check.py`` runs all of them."""

from __future__ import annotations

import pytest
from engines_kit import Engine

from hal.apps._physics import ALLOWED, run_experiments

QUICK = ("free_fall", "momentum", "restitution", "tilted_plane", "rolling", "drawer", "load_on_arm")


@pytest.mark.parametrize("name", QUICK)
def test_the_world_agrees_with_theory(engine: Engine, name: str) -> None:
    rows = list(run_experiments(engine.name, [name]))
    assert rows
    assert [row for row in rows if abs(row.difference) > ALLOWED] == []
