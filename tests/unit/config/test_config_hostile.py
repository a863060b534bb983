"""Files that are no rigs: each is one ConfigError that names the place, in bounded time."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hal.config import load
from hal.config.data_files import find_data
from hal.config.mapping import load_mapping
from hal.errors import ConfigError, Problem

MUTATIONS = int(os.environ.get("HAL_FUZZ_COUNT", "120"))
"""Number of mutated rigs; a longer run is asked for by the environment."""
NINE = "[" + ", ".join(["*a"] * 9) + "]"
BOMB = "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + "".join(
    f"{name}: &{name} {NINE.replace('*a', f'*{before}')}\n"
    for before, name in zip("abcdefghijk", "bcdefghijkl", strict=True)
)
CHAIN = "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}]\n" for k in range(1, 2000))


def problems(text: str | bytes, folder: Path) -> list[Problem]:
    (folder / "rig.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as caught:
        load(folder / "rig.yaml")
    return list(caught.value.problems)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("robots: " + "[" * 100_000, "too_large"),
        ("robots: " + "{a: " * 100_000, "too_large"),
        ("\n".join(" " * k + "a:" for k in range(200)), "too_large"),
        (BOMB, "too_large"),
        (CHAIN, "too_large"),
        ("robots: &a\n  arm: *a\n", "too_large"),
        ("a: *nowhere", "bad_yaml"),
        ("description: " + "x" * 2_000_000, "too_large"),
        ("a: [" + "1," * 60_000 + "1]", "too_large"),
    ],
    ids=["brackets", "braces", "indents", "aliases", "chain", "itself", "undefined", "large", "many"],
)
def test_a_file_that_grows_without_end_is_refused(text: str, code: str, tmp_path: Path) -> None:
    (problem,) = problems(text, tmp_path)
    assert problem.code == code


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


PIECES = ["[", "]", "{", "}", "&a ", "*a", "!!int ", "<<: ", "? ", "- ", ": ", "\n", "\t", '"', "'", "|\n", "%", "\0"]
PIECES += ["~", "1e999", ".nan", "-.inf", "0b_", "2001-99-99", "null", "\ufeff", "\x85", "é", "9" * 400, "../", "#"]


def mutated(text: str, source: random.Random) -> bytes:
    """Return a rig's text with some random changes: bytes, tokens, lines doubled, moved, indented or cut."""
    for _ in range(source.randint(1, 6)):
        lines = text.split("\n")
        a, b = source.randrange(len(lines)), source.randrange(len(lines))
        k = source.randrange(len(text) + 1)
        kind = source.randrange(7)
        if kind == 0:
            text = text[:k] + source.choice(PIECES) + text[k:]
        elif kind == 1:
            text = text[:k] + text[k + source.randint(1, 20) :]
        elif kind == 2:
            text = text[:k] + chr(source.choice([source.randrange(128), source.randrange(0x3000)])) + text[k + 1 :]
        elif kind == 3:
            lines[a] = lines[b]
            text = "\n".join(lines)
        elif kind == 4:
            lines[a] = " " * source.randrange(6) + lines[a].lstrip()
            text = "\n".join(lines)
        elif kind == 5:
            text = "\n".join(lines[:a] + lines[b:])
        else:
            words = text.split()
            if words:
                text = text.replace(source.choice(words), source.choice([source.choice(words), *PIECES]), 1)
    data = text.encode("utf-8", "surrogatepass")
    if source.random() < 0.1:
        k = source.randrange(len(data) + 1)
        data = data[:k] + bytes([source.randrange(256)]) + data[k:]
    return data


def test_mutated_rigs_are_in_order_or_a_config_error(tmp_path: Path) -> None:
    """Runs in a process of its own: what would end it or let it hang is a failure of this test alone."""
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path), str(MUTATIONS)],
        capture_output=True,
        text=True,
        timeout=60 + 0.5 * MUTATIONS,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    loaded, refused = map(int, done.stdout.split())
    assert loaded + refused == MUTATIONS
    assert loaded > 0.02 * MUTATIONS
    assert refused > 0.5 * MUTATIONS


def fuzz(folder: Path, count: int) -> None:
    """Load ``count`` mutated rigs, and print how many were in order and how many were refused."""
    names = ["panda_table", "yam", "franka_emulator", "panda_calibration", "openarm"]
    texts = [find_data("config", f"{name}.yaml").read_text() for name in names]
    loaded = refused = 0
    for seed in range(count):
        source = random.Random(seed)
        text = mutated(source.choice(texts), source)
        (folder / "rig.yaml").write_bytes(text)
        started = time.monotonic()
        try:
            load(folder / "rig.yaml")
            loaded += 1
        except ConfigError as error:
            refused += 1
            if not error.problems or len(str(error)) > 100_000:
                raise
        except BaseException:
            print(f"seed {seed}:\n{text!r}", file=sys.stderr)
            raise
        assert time.monotonic() - started < 20.0, seed
    print(loaded, refused)


if __name__ == "__main__":
    fuzz(Path(sys.argv[1]), int(sys.argv[2]))
