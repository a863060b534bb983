"""Tasks with a name for Gymnasium: :class:`.TaskEnv`, their base, and one file for each of them.

Importing this package, as ``import hal.gym`` does, registers them: ``gymnasium.make("hal/PickCube-v0")``.
"""

from __future__ import annotations

import gymnasium

TASKS = {
    "PickCube": ("pick_cube", 200),
    "PushCube": ("push_cube", 200),
    "StackCubes": ("stack_cubes", 300),
    "PegInHole": ("peg_in_hole", 300),
    "OpenDrawer": ("open_drawer", 200),
    "HandOver": ("hand_over", 400),
}
"""Module and steps of an episode of each task; ``hal/<name>-v0`` in Gymnasium."""

for _name, (_module, _steps) in TASKS.items():
    gymnasium.register(f"hal/{_name}-v0", f"{__name__}.{_module}:{_name}", max_episode_steps=_steps)
