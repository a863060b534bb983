"""Import of Ark's global file, and the files that it names, as a rig's file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.config import load
from hal.config.data_files import list_data
from hal.errors import CommandError, ConfigError, Problem, suggest

from .arm_model import ArmModel
from .entries import ArkOptions, ImportState
from .output import Commented, Inline, KeyReport, KeyRow, Remark, yaml_text
from .reading import ArkNode, ArkReader, FileFinder, InvalidValue
from .robots import ArkArm, import_arm
from .scene import import_camera, import_object, import_simulator


@dataclass(frozen=True)
class Imported:
    """A checked rig made from Ark's files; nothing is written yet."""

    source: Path
    """Ark's global file."""
    entries: Mapping[str, Any]
    rows: tuple[KeyRow, ...]
    """Outcome of every key."""
    models: Mapping[str, ArmModel]
    """Models that were made, by robot."""
    left_out: tuple[str, ...]

    def texts(self, path: Path) -> dict[Path, str]:
        """Return the texts of the rig's file ``path`` and of the models beside it; the rig is the last."""
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
"""Sections of a global file."""


def import_ark(path: str | Path, options: ArkOptions | None = None) -> Imported:
    """Read Ark's global file and the files that it names, and convert them to a rig. Nothing is written.

    Args:
        path: Ark's ``global_config.yaml``.
        options: Options of the import.

    Raises:
        ConfigError: The files cannot be converted; lists every problem with file and line.
        CommandError: An option names something that the files do not have.
    """
    options = options or ArkOptions()
    _check_options(options)
    path = Path(path).expanduser().resolve()
    work = ImportState(ArkReader(), KeyReport(), FileFinder(path, options.start), options)
    try:
        root = work.reading.file(path)
    except InvalidValue:
        work.reading.raise_any()
        raise AssertionError("wrong, and no problem noted") from None
    _check_generation(root)
    entries: dict[str, Any] = {}
    with suppress(InvalidValue):
        entries = import_simulator(root, work.reading, work.ledger)

    problems = work.reading.problems.found
    before = len(problems)
    arms: dict[str, ArkArm] = {}
    for item in work.items(root, "robots"):
        with suppress(InvalidValue):
            arms[item.given] = import_arm(item, work)
    all_arms = len(problems) == before
    objects = []
    for item in work.items(root, "objects"):
        with suppress(InvalidValue):
            objects.append(import_object(item, work))
    cameras: dict[str, Any] = {}
    for item in work.items(root, "sensors"):
        with suppress(InvalidValue):
            cameras[item.name] = import_camera(item, work, arms, all_arms)
    work.reading.raise_any()
    _check_names(work)

    simulation = entries.pop("simulation", None)
    entries["sim"] = Commented(True, "false for the real arm and cameras")
    sections: dict[str, Any] = {
        "robots": {arm.name: arm.entry for arm in arms.values()},
        "cameras": cameras,
        "gamepads": {
            "#pad": Remark(
                "Ark has gamepads in separate programs. Here: the one that is plugged in, else the web console."
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


def _check_generation(root: ArkNode) -> None:
    """Raise ConfigError for a file that is not a global file: the files of Ark since June 2026, or anything else."""
    if any(section in root.children for section in SECTIONS):
        return
    keys = {key for child in root.children.values() for key in child.children}
    recent = "local" in root.children or "external" in root.children or keys & {"main", "simulator", "n_envs"}
    if recent:
        message = (
            "belongs to the Ark since June 2026 (hosts.yaml, nodes.yaml, sim_envs.yaml). These files list computers, "
            "programs and simulators; its arms, cameras and objects are Python classes and cannot be imported. Write a "
            "rig's file (docs/rig-file.md), or import the global_config.yaml of the Ark of 2025"
        )
    else:
        message = f"is not a global file of Ark: it has none of {', '.join(SECTIONS)}"
    raise ConfigError([Problem(str(root.file), "", message, "newer_ark" if recent else "not_ark")])


def _model_file(rig: Path, robot: str) -> Path:
    """File of a model that was made for a robot."""
    return rig.with_name(f"{rig.stem}_{robot}.yaml")


def _check_options(options: ArkOptions) -> None:
    models = list_data("sensors", "cameras")
    if options.camera_model not in models:
        known = suggest(options.camera_model, models)
        raise CommandError(f"unknown camera model {options.camera_model!r}{known}", code="unknown_model")
    if options.start is not None and not options.start.is_dir():
        raise CommandError(f"--start {options.start}: there is no such folder", code="no_folder")


def _check_names(work: ImportState) -> None:
    """Raise CommandError unless every name in the options occurs in the files."""
    robots, sensors, objects = (work.given[section] for section in ("robots", "sensors", "objects"))
    asked = [
        *(("--without", name, [*robots, *sensors, *objects]) for name in sorted(work.options.without)),
        *(("--arm", name, robots) for name in work.options.arms),
        *(("--urdf", name, [*robots, *objects]) for name in work.options.urdfs),
    ]
    for option, name, names in asked:
        if name not in names:
            raise CommandError(
                f"{option} {name}: no such name in Ark's files{suggest(name, names)}", code="unknown_name"
            )


def _check(imported: Imported, ledger: KeyReport) -> None:
    """Raise ConfigError if it is not a valid rig; problems refer to Ark's files."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder).resolve() / "rig.yaml"
        for file, text in imported.texts(rig).items():
            file.write_text(text, encoding="utf-8")
        try:
            load(rig).resolve()
        except ConfigError as error:
            raise ConfigError([_in_ark(problem, imported, rig, ledger) for problem in error.problems]) from None


def _in_ark(problem: Problem, imported: Imported, rig: Path, ledger: KeyReport) -> Problem:
    """Return a problem of the new rig as one of the line in Ark's files that it comes from."""
    if problem.file == str(rig):
        node, where = ledger.origin(problem.key), f"as {problem.key} of the rig"
    else:
        made = [name for name in imported.models if str(_model_file(rig, name)) == problem.file]
        if not made:
            return problem
        node, where = ledger.origin(f"robots.{made[0]}.model"), f"as {problem.key} of the model made for it"
    place, key = (node.place, node.key) if node is not None else (str(imported.source), "")
    return Problem(place, key, f"{problem.message} ({where})", problem.code)
