"""The base classes of LeRobot: its own where it is installed, else stand-ins, since it is 2 GB and CI has none."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import ModuleType
from typing import Any, ClassVar


class _Choice:
    """As draccus.ChoiceRegistry: configurations by name."""

    id: str | None = None
    choices: ClassVar[dict[tuple[type, str], Any]] = {}

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        return lambda subclass: cls.choices.setdefault((cls, name), subclass)

    @classmethod
    def get_choice_class(cls, name: str) -> Any:
        return cls.choices[cls, name]


def _make_robot(config: Any) -> Any:
    return vars(sys.modules[type(config).__module__])[type(config).__name__.removesuffix("Config")](config)


class _Device:
    def __init__(self, config: Any) -> None:
        self.id = config.id


if find_spec("lerobot") is None:
    for module, names in {
        "lerobot": {},
        "lerobot.robots": {
            "Robot": _Device,
            "RobotConfig": type("RobotConfig", (_Choice,), {}),
            "make_robot_from_config": _make_robot,
        },
        "lerobot.cameras": {"CameraConfig": type("CameraConfig", (_Choice,), {"fps": None, "width": 0, "height": 0})},
        "lerobot.cameras.utils": {
            "make_cameras_from_configs": lambda configs: {name: _make_robot(config) for name, config in configs.items()}
        },
        "lerobot.teleoperators": {
            "Teleoperator": _Device,
            "TeleoperatorConfig": type("TeleoperatorConfig", (_Choice,), {}),
        },
    }.items():
        sys.modules[module] = ModuleType(module)
        vars(sys.modules[module]).update(names)
