"""Tasks with a name for Gymnasium: :class:`.TaskEnv`, their base, and one file for each of them.

Importing this package, as ``import hal.gym`` does, registers them: ``gymnasium.make("hal/PickCube-v0")``.
"""

from __future__ import annotations

import gymnasium

__all__ = ["TASKS"]

TASKS = ("PickCube", "PushCube", "StackCubes")
"""Names of the tasks: ``hal/<name>-v0`` in Gymnasium."""

for _name, _place, _steps in zip(TASKS, ("pick_cube", "push_cube", "stack_cubes"), (200, 200, 300), strict=True):
    gymnasium.register(f"hal/{_name}-v0", f"{__name__}.{_place}:{_name}", max_episode_steps=_steps)
