"""Values and paths that cannot be: each is one ConfigError that names the place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hal.config import load
from hal.config.mapping import load_mapping
from hal.errors import ConfigError, Problem


def problems(text: str, folder: Path) -> list[Problem]:
    (folder / "rig.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load(folder / "rig.yaml")
    return list(caught.value.problems)


@pytest.mark.parametrize(
    "value",
    [
        "2001-99-99",
        "2001-01-01T25:61:61Z",
        "0b_",
        "0x_",
        "9" * 5000,
        "1" + ":59" * 500,
        "!!int x",
        "!!float x",
        "!!bool x",
        "!!timestamp x",
        "!!binary ''''",
        "!!python/object/apply:os.system [ls]",
        "!!set [1]",
        "!!omap x",
        "{[1, 2]: 3}",
        "{{a: 1}: 3}",
    ],
)
@pytest.mark.parametrize("place", ["file", "override"])
def test_a_value_that_cannot_be_built_names_its_place(value: str, place: str, tmp_path: Path) -> None:
    if place == "file":
        (problem,) = problems(f"sim: true\nrobots:\n  arm: {{model: panda, speed: {value}}}\n", tmp_path)
        assert "line 3" in problem.message or problem.key == "robots.arm.speed"
    else:
        with pytest.raises(ConfigError) as caught:
            load("panda_table", overrides=[f"robots.panda.speed={value}"])
        (problem,) = caught.value.problems
        assert (problem.file, problem.key) == ("--set", "robots.panda.speed")
    assert len(str(problem)) < 500


@pytest.mark.parametrize("key", [None, "model", "objects", "urdf", "playback"])
@pytest.mark.parametrize("path", ["~nosuchuser/x.yaml", "a/\0.yaml", "loop.yaml", "d/" + "x" * 5000 + ".yaml", "."])
def test_a_path_that_cannot_be_followed(path: str, key: str | None, tmp_path: Path) -> None:
    (tmp_path / "loop.yaml").symlink_to(tmp_path / "loop.yaml")
    path = f"{tmp_path}/{path}" if path in ("loop.yaml", ".") else path
    rigs: dict[str | None, Any] = {
        None: path,
        "model": {"robots": {"arm": {"model": f"./{path}"}}, "cameras": {"eye": {"model": f"./{path}"}}},
        "objects": {"objects": [f"./{path}", {"file": f"./{path}", "mass": 1.0}]},
        "urdf": {"objects": [{"name": "it", "urdf": path}]},
        "playback": {"gamepads": {"pad": {"driver": "playback", "file": path}}},
    }
    with pytest.raises(ConfigError):
        load(rigs[key] if key is not None else f"./{path}")
    with pytest.raises(ConfigError):
        load_mapping(f"./{path}")


def test_a_rig_has_a_bounded_number_of_devices(tmp_path: Path) -> None:
    text = "robots:\n  r0: &r {model: panda}\n" + "".join(f"  r{k}: *r\n" for k in range(1, 100))
    (problem,) = problems(text, tmp_path)
    assert problem.key == "robots"
