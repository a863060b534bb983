"""Runs the blocks of one document, in order, in a folder of its own, as a reader would."""

from __future__ import annotations

import fnmatch
import inspect
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from app_kit import Done, run_here
from recording_kit import small

import hal
from hal.apps.main import main
from hal.config.data_files import find_data
from hal.config.mapping import load_mapping
from hal.errors import ConfigError
from hal.pads.choice import TOUR

from .blocks import Block

ROOT = Path(__file__).resolve().parents[2]
TURNS = 100
"""A loop over ``rig.clock.rate`` in a document ends after so many turns, unless it ends by itself."""
SECONDS = "1.5"
"""A program that a document starts ends after so many, unless it ends by itself."""
EPISODES = 5
"""A page that generates more gets so many."""

HANG = 600
"""s after which a program counts as hanging. It ends by itself: a busy computer only makes it slower."""

PROGRAM = ["-m", "hal.apps.main"]
NOT_RUN = {
    "pip": "would change the environment; tests/packaging installs the wheel",
    "pytest": "this is it",
    "ruff": "CI runs it",
    ".ci/run": "CI runs it",
}
"""Commands of documents that are not run here, with the reason. ``pytest FILE`` is."""


class Reader:
    """A person who copies the blocks of one document, one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: dict[str, Any] = {"__name__": "__document__"}
        self.rigs: list[Any] = []
        self.ran = 0
        self._open = hal.open

    def do(self, block: Block) -> None:
        """Run one block as its language and its mark say. Any failure is an exception that names its line."""
        if block.mark == "not run":
            return
        if block.mark == "file":
            name, _, broken = block.value.partition(",")
            (self.folder / name).write_text(block.text, encoding="utf-8")
            if block.language == "python":
                compile(block.text, str(block), "exec")
            elif block.language == "jsonl":
                check_json(block)
            elif broken.strip() != "broken":
                check_yaml(block.text, self.folder, name)
            else:
                with pytest.raises(ConfigError):
                    check_yaml(block.text, self.folder, name)
        elif block.mark == "copy":
            copied = ROOT / block.value
            assert block.text == copied.read_text(encoding="utf-8"), f"{block} is not {block.value}"
            for file in copied.parent.iterdir():
                if file.is_file():
                    shutil.copy(file, self.folder)
        elif block.language == "python":
            self._python(block)
        elif block.language == "yaml":
            check_yaml(block.text, self.folder, "block.yaml")
        elif block.language == "jsonl":
            check_json(block)
        else:
            self._commands(block)
        self.ran += 1

    # Python.

    def _python(self, block: Block) -> None:
        before = dict(self.names)
        exec(self._compiled(block), self.names)
        for name, value in list(self.names.items()):
            if name.startswith("test_") and before.get(name) is not value and not inspect.signature(value).parameters:
                value()

    def _compiled(self, block: Block) -> Any:
        return compile("\n" * (block.line - 1) + block.text, str(block.document), "exec")

    def open(self, *arguments: Any, **options: Any) -> Any:
        """``hal.open`` without waiting: lock-step and the recorded tour, unless the document says otherwise."""
        if options.get("driver") is None and options.get("pad") != "web":
            options.setdefault("clock", "lock_step")
            options.setdefault("pad", str(find_data(*TOUR)))
        rig = self._open(*arguments, **options)
        self.rigs.append(rig)
        whole: Callable[..., Iterator[Any]] = rig.clock.rate

        def rate(*arguments: Any, **options: Any) -> Iterator[Any]:
            ours = sys._getframe(1).f_code.co_filename.endswith(".md")
            return itertools.islice(whole(*arguments, **options), None if not ours else TURNS)

        rig.clock.rate = rate  # of this rig only
        return rig

    def _commands(self, block: Block) -> None:
        lines = block.text.splitlines()
        prompt = any(line.startswith("$ ") for line in lines)
        command, shown = "", []
        for line in [*lines, "$ " if prompt else ""]:
            text = line.removeprefix("$ ") if prompt else line
            if prompt and not line.startswith("$ "):
                shown.append(line)
                continue
            if command:
                self._command(block, command, shown)
            command, shown = text.partition(" #")[0].strip(), []
        if command:
            self._command(block, command, [])

    def _command(self, block: Block, command: str, shown: list[str]) -> None:
        for part in command.split("&&"):
            words = shlex.split(part)
            arguments = self._arguments(words)
            if arguments is None:
                assert words[0] in NOT_RUN or words[0].startswith(".ci/"), f"{block}: no way to run {part!r}"
                continue
            done: Done | subprocess.CompletedProcess[str]
            if arguments[:2] == PROGRAM:  # tests/apps starts each as a program of its own
                with mock.patch.object(hal, "open", self._open):
                    done = run_here(main, *arguments[2:])
            else:
                done = subprocess.run(
                    [sys.executable, *arguments],
                    cwd=self.folder,
                    env={**os.environ, "PYTHONPATH": str(self.folder)},
                    capture_output=True,
                    text=True,
                    timeout=HANG,
                )
            output = (done.stdout + done.stderr).strip()
            wrong = any("Error" in line for line in shown)
            assert (done.returncode != 0) == wrong, f"{block}: {part!r} ended with {done.returncode}:\n{output}"
            check_output(block, shown, output)

    @staticmethod
    def _arguments(words: list[str]) -> list[str] | None:
        """What Python is to be started with; None for a command that is not run here."""
        if words[0] == "pytest" and any(word.endswith(".py") for word in words):
            return ["-m", "pytest", "-p", "no:cacheprovider", *words[1:]]
        start = PROGRAM.copy()
        if words[0] == "hal":
            program, rest = words[1], words[2:]
            start.append(program)
        elif words[0] == "python" and words[1].startswith("apps/"):
            program, rest, start = Path(words[1]).stem, words[2:], [str(ROOT / words[1])]
        else:
            return words[1:] if words[0] == "python" and not words[1].startswith("-") else None
        if program == "teleop" and not {"--dry-run", "--help", "--duration"} & set(rest):
            rest = [*rest, "--duration", SECONDS]
        if program == "generate":  # tests/loops checks what a policy makes of all that a page asks for
            at = rest.index("--episodes") + 1
            rest[at] = str(min(int(rest[at]), EPISODES))
        if program == "collect" and "--pad" in rest:  # a recorded one: nobody need wait for it
            quick = ["simulation.clock=lock_step", *small()]
            rest = [*rest, *(word for one in quick for word in ("--set", one))]
        return [*start, *rest]

    def close(self) -> None:
        """Close what the document left open."""
        for rig in self.rigs:
            rig.close()


def check_output(block: Block, shown: list[str], output: str) -> None:
    """The output that a document shows must be what came; ``...`` stands for anything within a line."""
    lines = [line.rstrip() for line in output.splitlines()]
    for line in shown:
        pattern = re.sub(r"([\[\]*?])", r"[\1]", line.rstrip()).replace("...", "*")
        assert fnmatch.filter(lines, pattern), f"{block}: {line!r} is not in the output:\n{output}"


def check_yaml(text: str, folder: Path, name: str) -> None:
    """Load it as what its keys say that it is: a rig, a model of a robot, a mapping, an object. Raises ConfigError."""
    from hal.config import load
    from hal.config.files import parse_yaml
    from hal.config.mapping import TeleopMapping
    from hal.config.models import RobotModel
    from hal.config.objects import ObjectConfig
    from hal.config.rigfile import RigFile
    from hal.learning.policy_config import PolicyConfig, load_policy_config

    data = parse_yaml(text)
    keys = set(data)
    file = folder / name
    file.write_text(text, encoding="utf-8")
    if keys <= set(RigFile.model_fields):
        rig = {"robots": {"panda": {"model": "panda"}}} if "robots" not in data else {}
        load({**rig, **data} if rig else file)
    elif keys <= set(RobotModel.model_fields):
        if "urdf" not in data:
            import yaml

            panda = find_data("robots", "panda.yaml")
            model = {**parse_yaml(panda.read_text()), "urdf": str(panda.with_suffix(".urdf"))}
            file.write_text(yaml.safe_dump({**model, **data}), encoding="utf-8")
        load({"robots": {"arm": {"model": str(file)}}}, sim=True)
    elif keys <= {*ObjectConfig.model_fields, "pose"}:
        load({"objects": [data]}, sim=True)
    elif keys <= set(TeleopMapping.model_fields):
        load_mapping(file)
    elif keys <= set(PolicyConfig.model_fields):
        load_policy_config(file)
    else:
        raise AssertionError(f"what is a file with the keys {', '.join(sorted(keys))}?")


def check_json(block: Block) -> None:
    """Each line is an object."""
    for line in block.text.splitlines():
        assert isinstance(json.loads(line), dict), f"{block}: {line}"
