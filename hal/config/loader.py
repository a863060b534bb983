"""Read a rig's configuration, check it as a whole, and resolve it into a plan.

One :class:`~hal.errors.ConfigError` lists every problem in the rig's file, the models and objects that it names, their
URDFs and the caller's overrides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import PrivateAttr

from .. import registry
from ..errors import suggest
from ..specs import Plan
from .context import Context
from .files import Problems, apply_overrides, find_file, read_yaml, validate
from .resolve import resolve
from .rigfile import RigFile

CLOCKS = ("real_time", "lock_step")


class RigConfig(RigFile):
    """A checked rig file. :meth:`resolve` returns the plan that is opened."""

    _plan: Plan = PrivateAttr()

    def resolve(self) -> Plan:
        """Return every device with its driver."""
        return self._plan


def load(
    config: str | Path | Mapping[str, Any],
    *,
    sim: bool | None = None,
    driver: str | None = None,
    clock: str | None = None,
    engine: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
) -> RigConfig:
    """Read and check a rig.

    Args:
        config: A file (its path has a slash or ends in .yaml), the name of a built-in rig, or a dict. Paths in a dict
            are relative to the working directory.
        sim: True makes every arm, gripper and camera simulated, whatever its own flag; False sets the rig's flag and
            leaves each device its own; None changes nothing.
        driver: Replaces every driver (``"mock"``); then lock-step is the default clock.
        clock: ``"real_time"`` or ``"lock_step"``; None for the rig's.
        engine: Engine of the simulated world: ``"auto"``, ``"pybullet"``, ``"mujoco"``, or a driver with a world; None
            for the rig's. It need not be installed.
        overrides: ``"KEY=VALUE"`` with the value in YAML, or a mapping from dotted keys to values.

    Raises:
        ConfigError: The rig has problems; all are listed.
    """
    problems = Problems()
    _check_arguments(sim, clock, engine, problems)
    engine = None if problems.found else engine  # after a problem the rest is checked, too
    stand_in = _choose_stand_in(driver, problems)
    data, source, base = _read(config, problems)
    if data is None:
        problems.raise_any()
        raise AssertionError("no data and no problem")
    data = apply_overrides(data, overrides, problems)
    rig = validate(RigConfig, data, source, problems)
    rig._plan = resolve(Context(source, base, rig, sim, stand_in, clock, problems, engine))
    return rig


def _check_arguments(sim: object, clock: str | None, engine: str | None, problems: Problems) -> None:
    if sim is not None and not isinstance(sim, bool):
        problems.add("<arguments>", "sim", f"must be true, false or None, not {sim!r}", "wrong_type")
    if clock is not None and clock not in CLOCKS:
        problems.add("<arguments>", "clock", f"{clock!r} is not possible{suggest(clock, CLOCKS)}", "invalid_choice")
    if engine is not None and (message := registry.explain_engine(str(engine))):
        problems.add("<arguments>", "engine", message, "invalid_choice")


def _choose_stand_in(driver: str | None, problems: Problems) -> str | None:
    """Return the driver that replaces every other; after a problem one that can, so that the rest is checked, too."""
    if driver is None:
        return None
    fit = [name for name in registry.BUILT_IN if registry.driver(name).stands_in]
    if driver in fit:
        return driver
    message = f"only {', '.join(fit)} can replace every driver, not {driver!r}"
    problems.add("<arguments>", "driver", message, "wrong_driver")
    return fit[0]


def _read(config: str | Path | Mapping[str, Any], problems: Problems) -> tuple[dict[str, Any] | None, str, Path]:
    if isinstance(config, Mapping):
        return dict(config), "<dict>", Path.cwd()
    path = find_file(config, "rig", Path.cwd(), "config")
    if isinstance(path, str):
        problems.add("<arguments>", "config", path, "unknown_rig")
        return None, str(config), Path.cwd()
    return read_yaml(path, problems), str(path), path.parent
