"""Where OpenGL draws to: a context without a window, and the pictures of one size."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import DriverMissing
from hal.specs import CameraSpec

from .rendering import Images
from .shaders import OUTPUTS

__all__ = ["NEAR", "Target", "create_context", "projection"]

NEAR, FAR = 0.01, 100.0
"""What is drawn at all, m. A camera's own range only blanks its depth."""
_MENDING = "apt install libegl1 libgl1-mesa-dri"


def create_context() -> Any:
    """An OpenGL context, current in the calling thread. Raises DriverMissing, which names the mending command."""
    try:
        import moderngl
    except ImportError as error:
        raise DriverMissing(f"{error}; pip install moderngl") from error
    options: dict[str, Any] = {"standalone": True, "backend": "egl"}
    try:
        with _one_thread():
            context: Any = moderngl.create_context(require=330, **options)
    except Exception as error:  # glcontext raises bare Exceptions
        raise DriverMissing(f"{error}; {_MENDING}") from error
    context.front_face = "cw"  # the picture is drawn upside down, which turns every triangle over
    return context


@contextmanager
def _one_thread() -> Iterator[None]:
    """Mesa's software renderer reads this when it starts; more threads would only fight with the servo's process."""
    name = "LP_NUM_THREADS"
    before = os.environ.get(name)
    os.environ.setdefault(name, "1")
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]


class Target:
    """Where pictures of one size and one set of streams are drawn."""

    def __init__(self, context: Any, width: int, height: int, streams: tuple[str, ...]) -> None:
        self._streams = streams
        self._shape = (height, width)
        depth = context.depth_renderbuffer((width, height))
        layers = [context.texture((width, height), OUTPUTS[s].components, dtype=OUTPUTS[s].dtype) for s in streams]
        # One for each layer too: a clear fills all layers of what it clears with one colour.
        self._depth = context.framebuffer([], depth)
        self._all = context.framebuffer(layers, depth)
        self._each = [context.framebuffer([layer]) for layer in layers]

    def clear(self) -> None:
        for name, layer in zip(self._streams, self._each, strict=True):
            layer.clear(*OUTPUTS[name].background)
        self._depth.clear(depth=1.0)
        self._all.use()

    def read(self) -> Images:
        found: dict[str, NDArray[Any]] = {}
        for place, name in enumerate(self._streams):
            output = OUTPUTS[name]
            image = np.empty((*self._shape, 3) if name == "color" else self._shape, output.array)
            self._all.read_into(
                image,
                components=image.shape[2] if image.ndim == 3 else 1,
                attachment=place,
                alignment=1,
                dtype=output.dtype,
            )
            found[name] = image
        segmentation = found.get("segmentation")
        return Images(
            found.get("color"),
            found.get("depth"),
            found.get("infrared"),
            None if segmentation is None else segmentation.astype(np.int32),
        )


def projection(camera: CameraSpec) -> NDArray[np.float64]:
    """From the camera's frame (x right, y down, z forward) to clip space, rows of the picture upwards.

    The centre of pixel (u, v) lies at ((u + 0.5) 2 / W - 1, (v + 0.5) 2 / H - 1).
    """
    width, height = camera.width, camera.height
    K = np.array(camera.K)
    matrix = np.zeros((4, 4))
    matrix[0, :3] = (K[0] + [0, 0, 0.5]) * 2 / width - [0, 0, 1]
    matrix[1, :3] = (K[1] + [0, 0, 0.5]) * 2 / height - [0, 0, 1]
    matrix[2, 2:] = (FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    matrix[3, 2] = 1
    return matrix
