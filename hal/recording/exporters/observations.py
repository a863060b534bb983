"""The numbers that a policy looks at, under the names that robomimic and diffusion policy use for them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .content import EpisodeContent, Pictures

__all__ = ["observations", "picture_name", "with_channel"]

_OF_AN_ARM = {
    "joint_vel": "observation.velocity",
    "joint_effort": "observation.effort",
    "eef_vel": "observation.twist",
}


def observations(content: EpisodeContent) -> dict[str, NDArray[Any]]:
    """``robot0_joint_pos``, ``robot0_eef_pos`` and so on, each (rows, n), SI units, quaternions xyzw; a second arm is
    ``robot1``. ``object`` has the poses of all objects of a simulation, one after the other."""
    found: dict[str, NDArray[Any]] = {}
    for k, arm in enumerate(content.arms):
        lead = f"robot{k}_"
        found[lead + "joint_pos"] = content.of(arm, "observation.state")
        pose = content.of(arm, "observation.tcp")
        found[lead + "eef_pos"], found[lead + "eef_quat"] = pose[:, :3], pose[:, 3:]
        for name, key in _OF_AN_ARM.items():
            if content.has(key) and (values := content.of(arm, key)).shape[1]:
                found[lead + name] = values
        if (width := content.width(arm)) is not None:
            found[lead + "gripper_width"] = width[:, None]
    if objects := content.objects:
        found["object"] = np.concatenate(list(objects.values()), axis=1)
    return found


def picture_name(stream: Pictures) -> str:
    """``wrist_image`` or ``wrist_depth``."""
    return f"{stream.camera}_{'image' if stream.what == 'rgb' else 'depth'}"


def with_channel(picture: NDArray[Any]) -> NDArray[Any]:
    """Channels last, for depth too: (H, W, 3) or (H, W, 1)."""
    return picture if picture.ndim == 3 else picture[:, :, None]
