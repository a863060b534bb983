"""What every renderer offers, and which one is taken."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.errors import ConfigError, DriverMissing, Problem
from hal.geometry import Pose
from hal.specs import CameraSpec

from .scene import Scene

__all__ = ["BACKGROUND", "Images", "Renderer", "choose_renderer"]

BACKGROUND = (0.72, 0.76, 0.80)
"""Colour where there is nothing."""


class Images(NamedTuple):
    """One picture of the world; None for what the camera does not stream. Upright, aligned pixel by pixel."""

    color: NDArray[np.uint8] | None
    """(H, W, 3) RGB."""
    depth: NDArray[np.float32] | None
    """(H, W) m along the optical axis; 0 where nothing is within the camera's range."""
    infrared: NDArray[np.uint8] | None
    """(H, W): the luminance."""
    segmentation: NDArray[np.int32] | None
    """(H, W) ``index`` of the body, -1 for none."""


class Renderer(ABC):
    """Draws the present state of one world. Calls may come from any thread, one at a time."""

    description: str
    """What draws, in one line, for a banner."""

    @abstractmethod
    def render(self, camera: CameraSpec, T_world_camera: Pose) -> Images:
        """A picture by the pinhole ``camera.K``, without distortion; computes only what ``camera.streams`` asks for."""

    def close(self) -> None:  # noqa: B027  # not every renderer holds something
        """Let go of what it holds. Idempotent."""


def choose_renderer(scene: Scene, name: str = "auto") -> Renderer:
    """The renderer ``gl``, ``tiny``, or with ``auto`` the first of them that works here.

    ``description`` of the one returned says why ``gl`` was not taken, and what would mend it.

    Raises:
        ConfigError: no renderer of that name.
        DriverMissing: ``gl`` was asked for by name and is not to be had.
    """
    if name not in ("auto", "gl", "tiny"):
        raise ConfigError([Problem("simulation", "simulation.renderer", f"is {name!r}; renderers: auto, gl, tiny")])
    reason = ""
    if name != "tiny":
        from .gl import GLRenderer

        try:
            return GLRenderer(scene)
        except DriverMissing as error:
            if name == "gl":
                raise
            reason = f"; OpenGL is not to be had: {error}"
    from .tiny import TinyRenderer

    renderer = TinyRenderer(scene)
    renderer.description += reason
    return renderer
