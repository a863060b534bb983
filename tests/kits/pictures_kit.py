"""Worlds, cameras and a snapshot box for the tests of the simulated camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from engines_kit import need_engine

from hal.drivers.scene.camera import choose_renderer
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.renderer import Renderer
from hal.errors import DriverMissing
from hal.geometry import Pose
from hal.registry import choose_engine
from hal.specs import BodySpec, CameraSpec, RobotSpec, ViewSpec, WorldSpec
from hal.testing import camera_spec

STREAMS = ("color", "depth", "segmentation")
COLLADA = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="centimetre" meter="0.01"/><up_axis>Z_UP</up_axis></asset>
  <library_effects><effect id="fx"><profile_COMMON><technique sid="common"><lambert>
    <diffuse><color>1 0 0 1</color></diffuse></lambert></technique></profile_COMMON></effect></library_effects>
  <library_materials><material id="red"><instance_effect url="#fx"/></material></library_materials>
  <library_geometries><geometry id="corner"><mesh>
    <source id="points"><float_array id="numbers" count="12">0 0 0 2 0 0 0 2 0 0 0 2</float_array>
      <technique_common><accessor source="#numbers" count="4" stride="3"><param name="X" type="float"/>
      <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
    <vertices id="corners"><input semantic="POSITION" source="#points"/></vertices>
    <triangles count="4" material="paint"><input semantic="VERTEX" source="#corners" offset="0"/>
      <p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="scene"><node><scale>1 1 3</scale><instance_geometry
    url="#corner"><bind_material><technique_common><instance_material symbol="paint" target="#red"/></technique_common>
    </bind_material></instance_geometry></node></visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#scene"/></scene>
</COLLADA>
"""
"""The corner of a cube with sides of 2 cm, three times as high."""


def world(*bodies: BodySpec, robots: tuple[RobotSpec, ...] = ()) -> WorldSpec:
    """The record of a world."""
    return WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), bodies, robots)


def drawn(*bodies: BodySpec, robots: tuple[RobotSpec, ...] = ()) -> DrawnWorld:
    """What is drawn of a world, without physics."""
    return DrawnWorld(world(*bodies, robots=robots))


@contextmanager
def stepped(*bodies: BodySpec, robots: tuple[RobotSpec, ...] = ()) -> Iterator[Any]:
    """A world with physics, of an engine that is installed."""
    with closing(need_engine(choose_engine("auto")).world(*bodies, *robots)) as made:
        yield made


def box(
    name: str, half_extents: tuple[float, float, float], position: tuple[float, float, float], **more: Any
) -> BodySpec:
    """A box that stands still."""
    values: dict[str, Any] = {"orientation": (0.0, 0.0, 0.0, 1.0), "fixed": True, **more}
    return BodySpec(name=name, position=position, shape="box", half_extents=half_extents, **values)


def camera(
    width: int = 160, height: int = 120, *, name: str = "camera", focal: float | None = None, **more: Any
) -> CameraSpec:
    """A pinhole camera in the world's origin, looking along +z, unless ``view`` says otherwise."""
    fx = focal or 0.9 * width
    centre = more.pop("centre", ((width - 1) / 2, (height - 1) / 2))
    K = ((fx, 0.0, centre[0]), (0.0, more.pop("fy", fx), centre[1]), (0.0, 0.0, 1.0))
    view = ViewSpec((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    values = {"depth_max": 10.0, "streams": STREAMS, "view": view, **more}
    return camera_spec(name=name, driver="pybullet", width=width, height=height, K=K, **values)


def look_at(eye: tuple[float, ...], target: tuple[float, ...], up: tuple[float, ...] = (0.0, 0.0, 1.0)) -> Pose:
    """The pose of an optical frame (x right, y down, z forward)."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    matrix[:3, 3] = eye
    return Pose.from_matrix(matrix)


def renderer(name: str, scene: DrawnWorld) -> Renderer:
    """A renderer by name; skips the test where there is no OpenGL, or no PyBullet."""
    try:
        return choose_renderer(scene, name)
    except DriverMissing as error:
        pytest.skip(f"no renderer {name}: {error}")


def rays(spec: CameraSpec) -> np.ndarray:
    """(H, W, 3) directions with z = 1 through the centres of the pixels, in the camera's frame."""
    v, u = np.mgrid[: spec.height, : spec.width]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(np.array(spec.K)).T
