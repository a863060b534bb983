"""Ark's global file and all that it names, into a rig's file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..config import load
from ..config.data_files import list_data
from ..config.files import nearest
from ..errors import CommandError, ConfigError, Problem
from .arm_model import ArmModel
from .arms import Arm, import_arm
from .items import Work
from .ledger import Ledger, Row
from .options import Options
from .places import Places
from .reading import Node, Reading, Wrong
from .sensors import import_camera
from .simulator import import_simulator
from .text import Commented, Inline, Remark, yaml_text
from .things import import_object

__all__ = ["Imported", "import_ark"]


@dataclass(frozen=True)
class Imported:
    """A rig made of Ark's files, checked; nothing is written yet."""

    source: Path
    """Ark's global file."""
    entries: Mapping[str, Any]
    rows: tuple[Row, ...]
    """What became of every key."""
    models: Mapping[str, ArmModel]
    """Robot -> a model that was made for it."""
    left_out: tuple[str, ...]

    def texts(self, path: Path) -> dict[Path, str]:
        """The rig's file ``path``, and those of the models beside it, with their texts. The rig is the last."""
        entries = dict(self.entries)
        texts: dict[Path, str] = {}
        if self.models:
            robots = dict(entries["robots"])
            for name, model in self.models.items():
                file = _model_file(path, name)
                texts[file] = yaml_text(model.entries, path.parent)
                robots[name] = {**robots[name], "model": Commented(file.name, robots[name]["model"].comment)}
            entries["robots"] = robots
        texts[path] = yaml_text(entries, path.parent)
        return texts


SECTIONS = ("simulator", "robots", "sensors", "objects")
"""Of a global file."""


def import_ark(path: str | Path, options: Options | None = None) -> Imported:
    """Read Ark's global file ``path`` and what it names, and make a rig of it. Nothing is written.

    Raises ConfigError with every problem, each with file and line; CommandError for options that fit nothing.
    """
    options = options or Options()
    _check_options(options)
    path = Path(path).expanduser().resolve()
    work = Work(Reading(), Ledger(), Places(path, options.start), options)
    try:
        root = work.reading.file(path)
    except Wrong:
        work.reading.raise_any()
        raise AssertionError("wrong, and no problem noted") from None
    _check_generation(root)
    entries: dict[str, Any] = {}
    with suppress(Wrong):
        entries = import_simulator(root, work.reading, work.ledger)

    problems = work.reading.problems.found
    before = len(problems)
    arms: dict[str, Arm] = {}
    for item in work.items(root, "robots"):
        with suppress(Wrong):
            arms[item.given] = import_arm(item, work)
    all_arms = len(problems) == before
    objects = []
    for item in work.items(root, "objects"):
        with suppress(Wrong):
            objects.append(import_object(item, work))
    cameras: dict[str, Any] = {}
    for item in work.items(root, "sensors"):
        with suppress(Wrong):
            cameras[item.name] = import_camera(item, work, arms, all_arms)
    work.reading.raise_any()
    _check_names(work)

    simulation = entries.pop("simulation", None)
    entries["sim"] = Commented(True, "the one flag: false for the real arm and cameras")
    sections: dict[str, Any] = {
        "robots": {arm.name: arm.entry for arm in arms.values()},
        "cameras": cameras,
        "gamepads": {
            "#pad": Remark(
                "Ark has pads in programs of their own. Found when the rig opens; else a page in the browser."
            ),
            work.own_name("pad"): Inline(model="auto"),
        },
        "objects": objects,
        "simulation": simulation,
    }
    entries |= {name: section for name, section in sections.items() if section}
    models = {arm.name: arm.made for arm in arms.values() if arm.made is not None}
    rows = work.ledger.close(work.reading.files.values())
    imported = Imported(path, entries, rows, models, tuple(work.left_out))
    _check(imported, work.ledger)
    return imported


def _check_generation(root: Node) -> None:
    """Raise ConfigError for a file that is not a global file: the files of Ark since June 2026, or anything else."""
    if any(section in root.children for section in SECTIONS):
        return
    keys = {key for child in root.children.values() for key in child.children}
    recent = "local" in root.children or "external" in root.children or keys & {"main", "simulator", "n_envs"}
    if recent:
        message = (
            "is of the Ark that hosts.yaml, nodes.yaml and sim_envs.yaml belong to (since June 2026). These files list "
            "computers, programs and simulators; arms, cameras and objects are in that Ark's Python classes, so there "
            "is nothing here to make a rig of. Write the rig's file (docs/rig-file.md), or import the "
            "global_config.yaml of the Ark of 2025"
        )
    else:
        message = f"is not a global file of Ark: it has none of {', '.join(SECTIONS)}"
    raise ConfigError([Problem(str(root.file), "", message)])


def _model_file(rig: Path, robot: str) -> Path:
    """Where the model of a robot is written that the hal does not know."""
    return rig.with_name(f"{rig.stem}_{robot}.yaml")


def _check_options(options: Options) -> None:
    models = list_data("sensors", "cameras")
    if options.camera_model not in models:
        raise CommandError(f"there is no camera model {options.camera_model!r}{nearest(options.camera_model, models)}")
    if options.start is not None and not options.start.is_dir():
        raise CommandError(f"--start {options.start}: there is no such folder")


def _check_names(work: Work) -> None:
    """Every name that an option gives is one of the files'."""
    robots, sensors, objects = (work.given[section] for section in ("robots", "sensors", "objects"))
    asked = [
        *(("--without", name, [*robots, *sensors, *objects]) for name in sorted(work.options.without)),
        *(("--arm", name, robots) for name in work.options.arms),
        *(("--urdf", name, [*robots, *objects]) for name in work.options.urdfs),
    ]
    for option, name, names in asked:
        if name not in names:
            raise CommandError(f"{option} {name}: Ark's files have nothing of that name{nearest(name, names)}")


def _check(imported: Imported, ledger: Ledger) -> None:
    """Is it a rig? What is wrong is told as Ark's files have it."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder).resolve() / "rig.yaml"
        for file, text in imported.texts(rig).items():
            file.write_text(text, encoding="utf-8")
        try:
            load(rig).resolve()
        except ConfigError as error:
            raise ConfigError([_in_ark(problem, imported, rig, ledger) for problem in error.problems]) from None


def _in_ark(problem: Problem, imported: Imported, rig: Path, ledger: Ledger) -> Problem:
    """A problem of the rig that was made, as one of the line in Ark's files that it comes from."""
    if problem.file == str(rig):
        node, where = ledger.origin(problem.key), f"as {problem.key} of the rig"
    else:
        made = [name for name in imported.models if str(_model_file(rig, name)) == problem.file]
        if not made:
            return problem
        node, where = ledger.origin(f"robots.{made[0]}.model"), f"as {problem.key} of the model made for it"
    place, key = (node.place, node.key) if node is not None else (str(imported.source), "")
    return Problem(place, key, f"{problem.message} ({where})")
