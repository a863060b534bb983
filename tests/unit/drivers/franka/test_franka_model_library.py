"""The model library that an emulated Panda sends, loaded as its client does, against pinocchio."""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hal.config.data_files import find_data
from hal_emulators.franka.model_library import write_model_library
from hal_emulators.franka.plant import arm_only

pytestmark = pytest.mark.skipif(platform.machine() != "x86_64", reason="needs an x86-64 processor")

URDF = arm_only(find_data("robots", "panda.urdf").read_text(encoding="utf-8"))
TIGHT = {"rtol": 0.0, "atol": 1e-12}
Call = Callable[..., np.ndarray]


@pytest.fixture(scope="module")
def call(tmp_path_factory: pytest.TempPathFactory) -> Call:
    """Call a function by its name, with the length of its result and its arguments."""
    path: Path = tmp_path_factory.mktemp("library") / "model.so"
    path.write_bytes(write_model_library(URDF))
    library = ctypes.CDLL(str(path))

    def call(name: str, size: int, *arguments: float | np.ndarray) -> np.ndarray:
        result = np.full(size, np.nan)
        values = [ctypes.c_double(x) if isinstance(x, float) else np.ascontiguousarray(x) for x in arguments]
        pointers = [x if isinstance(x, ctypes.c_double) else x.ctypes.data_as(ctypes.c_void_p) for x in values]
        getattr(library, name)(*pointers, result.ctypes.data_as(ctypes.c_void_p))
        return result

    return call


@pytest.fixture(params=range(3))
def random(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def test_inertia_coriolis_and_gravity_with_a_load(call: Call, random: np.random.Generator) -> None:
    q, dq, centre, gravity = (
        random.uniform(-2, 2, 7),
        random.uniform(-2, 2, 7),
        random.normal(size=3),
        random.normal(size=3),
    )
    mass, root = 1.3, random.normal(size=(3, 3))
    inertia = root @ root.T
    model = pin.buildModelFromXML(URDF)
    flange = model.frames[model.getFrameId("link8")].placement
    model.appendBodyToJoint(7, pin.Inertia(mass, centre, inertia), flange)
    data = model.createData()
    model.gravity.linear = np.zeros(3)
    upper = np.triu(pin.crba(model, data, q))
    found = call("M_NE", 49, q, inertia, mass, centre).reshape(7, 7)
    np.testing.assert_allclose(found, upper + np.triu(upper, 1).T, **TIGHT)
    coriolis = pin.rnea(model, data, q, dq, np.zeros(7))
    np.testing.assert_allclose(call("c_NE", 7, q, dq, inertia, mass, centre), coriolis, **TIGHT)
    model.gravity.linear = gravity
    weight = pin.computeGeneralizedGravity(model, data, q)
    np.testing.assert_allclose(call("g_NE", 7, q, gravity, mass, centre), weight, **TIGHT)


def test_poses_and_jacobians_of_every_frame(call: Call, random: np.random.Generator) -> None:
    q = random.uniform(-2, 2, 7)
    model = pin.buildModelFromXML(URDF)
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    tool = pin.SE3(pin.rpy.rpyToMatrix(random.normal(size=3)), random.normal(size=3))
    flange = data.oMf[model.getFrameId("link8")]
    for k, pose in enumerate([*list(data.oMi)[1:], flange, flange * tool], 1):
        arguments = (q, tool.homogeneous.T) if k == 9 else (q,)
        matrix = call(f"O_T_J{k}", 16, *arguments).reshape(4, 4).T
        np.testing.assert_allclose(matrix, pose.homogeneous, **TIGHT)
        arguments = arguments if k > 1 else ()
        world = pin.getJointJacobian(model, data, min(k, 7), pin.WORLD)
        body = pose.inverse().toActionMatrix() @ world
        zero = np.vstack([pose.rotation @ body[:3], pose.rotation @ body[3:]])
        np.testing.assert_allclose(call(f"Ji_J_J{k}", 42, *arguments).reshape(7, 6).T, body, **TIGHT)
        np.testing.assert_allclose(call(f"O_J_J{k}", 42, *arguments).reshape(7, 6).T, zero, **TIGHT)


def test_a_joint_about_another_axis_is_refused() -> None:
    with pytest.raises(ValueError, match="z axis"):
        write_model_library(URDF.replace('xyz="0 0 1"', 'xyz="0 1 0"', 1))
