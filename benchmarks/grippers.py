"""Whether every gripper holds a cube, a cylinder and a thin plate: at rest, lifted, shaken and pulled.

Models without a gripper, and those whose package is not installed, are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from hal.config.data_files import list_data
from hal.errors import ConfigError, NotSupported
from hal.testing.holding import HoldResult, Thing, hold_object

from .kit import ENGINES, Table
from .robots import entries

PATHS = ("robots", "hal/testing/holding.py", "drivers/scene/gripper.py", "drivers/pybullet", "drivers/mujoco")


def run(quick: bool) -> Iterator[Table]:
    """Yield the table: in each cell the worst of the objects."""
    things, seconds = (("cube",), 0.5) if quick else (get_args(Thing), 10.0)
    columns = ("width off, mm", "slip, mm", "turn, mrad", "slides at, share of 2 mu F", "wrong verdicts")
    table = Table(f"{', '.join(things)}, held {seconds:g} s at rest, lifted and shaken", ("", *columns))
    for entry in (entry for model in (["panda"] if quick else list_data("robots")) for entry in entries(model)):
        for engine in ENGINES[: 1 if quick else None]:
            try:
                held = [hold_object(entry, thing, engine=engine, seconds=seconds) for thing in things]
            except NotSupported:
                break
            except ConfigError as error:
                if not all(problem.code == "missing_package" for problem in error.problems):
                    raise
                break
            table.add(f"{' '.join(entry.values())}, {engine}", *describe_worst(held))
    yield table


def describe_worst(held: list[HoldResult]) -> tuple[Any, ...]:
    """Return the cells of a row."""
    errors = [1e3 * one.error for one in held]
    pulls = [one.strength for one in held]
    return (
        max(errors, key=abs),
        1e3 * max(one.slip for one in held),
        1e3 * max(one.turn for one in held),
        f"{min(pulls):.3f} to {max(pulls):.3f}",
        sum(one.wrong for one in held),
    )
