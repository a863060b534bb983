"""Small configurations in the shape of Ark's, and the tutorial's own."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from hal_import_ark import ArkOptions, Imported, import_ark
from hal_import_ark.reading import ArkNode

from hal.config.files import parse_yaml
from hal.errors import ConfigError

DATA = Path(__file__).resolve().parent / "data"
TUTORIAL = DATA / "tutorial" / "config" / "global_config.yaml"
PANDA_URDF = DATA / "franka_panda" / "panda_with_gripper.urdf"

SIMULATOR: dict[str, Any] = {"name": "test", "backend_type": "pybullet", "config": {"connection_mode": "DIRECT"}}
PANDA: dict[str, Any] = {
    "urdf_path": "panda_with_gripper.urdf",
    "merge_fixed_links": False,
    "base_position": [0, 0, 0],
    "joint_groups": {"arm": {"control_mode": "position", "joints": [f"panda_joint{k}" for k in range(1, 8)]}},
}
CAMERA: dict[str, Any] = {
    "type": "Camera",
    "camera_type": "fixed",
    "streams": {"color": {"enable": True, "format": "bgr8"}},
}
FIX = {"camera_target_position": [0, 0, 0], "distance": 1, "yaw": 0, "pitch": -30, "roll": 0, "up_axis_index": 2}
CAMERA["sim_config"] = {"fix": FIX}
BALL: dict[str, Any] = {
    "source": "primitive",
    "collision": {"shape_type": "GEOM_SPHERE", "collision_shape": {"radius": 0.05}},
    "visual": {"shape_type": "GEOM_SPHERE", "visual_shape": {"radius": 0.05, "rgbaColor": [0, 1, 0, 1]}},
    "multi_body": {"baseMass": 0.1},
    "base_position": [0, 0, 1],
    "base_orientation": [0, 0, 0, 1],
}


def changed(data: dict[str, Any], **values: Any) -> dict[str, Any]:
    """A copy with some keys changed; ``a__b`` is key b inside a. None takes a key out."""
    data = copy.deepcopy(data)
    for path, value in values.items():
        *parents, key = path.split("__")
        inside = data
        for parent in parents:
            inside = inside.setdefault(parent, {})
        inside.pop(key, None)
        if value is not None:
            inside[key] = value
    return data


def write(
    folder: Path,
    *,
    robots: dict[str, Any] | None = None,
    sensors: dict[str, Any] | None = None,
    objects: dict[str, Any] | None = None,
    **others: Any,
) -> Path:
    """A global file with everything in it."""
    sections = {"robots": robots, "sensors": sensors, "objects": objects}
    data: dict[str, Any] = {"simulator": SIMULATOR, **others}
    for section, items in sections.items():
        if items:
            data[section] = [{"name": name, "config": config} for name, config in items.items()]
    path = folder / "global_config.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


def imported(folder: Path, options: ArkOptions | None = None, **sections: Any) -> tuple[dict[str, Any], Imported]:
    """The rig made of a configuration, as it would be read back, and the import."""
    result = import_ark(write(folder, **sections), options)
    path = folder / "rig.yaml"
    for file, text in result.texts(path).items():
        file.write_text(text, encoding="utf-8")
    return dict(parse_yaml(path.read_text())), result


def row(result: Imported, key: str, file: str = "") -> tuple[str, str]:
    """What became of a key, and where it is."""
    (found,) = [r for r in result.rows if r.node.key == key and r.node.file.name.startswith(file)]
    return found.outcome, found.here


def leaves(node: ArkNode, above: tuple[ArkNode, ...] = ()) -> Iterator[tuple[ArkNode, ...]]:
    """Every plain value below a node, with what it is in, from the outside in."""
    path = (*above, node)
    if not node.children:
        yield path
    for child in node.children.values():
        yield from leaves(child, path)


@contextmanager
def raises_problems(*codes: str) -> Iterator[None]:
    """Fail unless the block raises a ConfigError with problems of these codes, in their order."""
    with pytest.raises(ConfigError) as caught:
        yield
    assert tuple(problem.code for problem in caught.value.problems) == codes
