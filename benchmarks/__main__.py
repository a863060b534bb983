"""Run benchmarks: ``python -m benchmarks [NAME ...] [--json FILE] [--quick]``. Without a name, list them.

A benchmark is a module of this folder: ``run(quick)`` yields its tables, and ``PATHS`` names the code that it measures.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import platform
import re
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict
from difflib import get_close_matches
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("[a-z]*.py") if path.stem != "kit"))
PAGE = FOLDER.parent / "docs" / "measured.md"


def main(argv: list[str] | None = None) -> int:
    """Run the program; return 1 if a benchmark failed."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Run benchmarks; without a name, list them."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run, or all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the tables to a JSON file")
    parser.add_argument("--quick", action="store_true", help="small counts: whether it runs, not how fast it is")
    args = parser.parse_args(argv)
    names = NAMES if args.names == ["all"] else args.names
    for name in names:
        if name not in NAMES:
            near = get_close_matches(name, NAMES, 1)
            parser.error(f"there is no benchmark {name!r}{f', did you mean {near[0]!r}?' if near else ''}")
    if not names:
        print("\n".join(describe()))
    results, failed = [], False
    for name in names:
        found = measure(name, args.quick)
        failed |= "error" in found
        results.append(found)
        if args.json:
            args.json.write_text(json.dumps(results, indent=1, default=float) + "\n", encoding="utf-8")
    return int(failed)


def measure(name: str, quick: bool) -> dict[str, Any]:
    """Run one benchmark, print its tables, and return them with the commit and the computer."""
    found: dict[str, Any] = {"name": name, "quick": quick, "commit": current_commit(), **describe_computer()}
    print(f"## {name}{' --quick' if quick else ''}, commit {found['commit']}: {found['computer']}\n", flush=True)
    begun, tables = time.monotonic(), found.setdefault("tables", [])
    try:
        shown = sys.stdout
        with contextlib.redirect_stdout(sys.stderr):  # what the measured programs print
            for table in import_module(f"benchmarks.{name}").run(quick):
                tables.append(asdict(table))
                print(f"{table}\n", file=shown, flush=True)
    except Exception as error:
        found["error"] = f"{type(error).__name__}: {error}"
        traceback.print_exc()
    found["seconds"] = round(time.monotonic() - begun, 1)
    print(f"{name} took {found['seconds']} s\n", flush=True)
    return found


def describe_computer() -> dict[str, str]:
    """Return the computer, how busy it is, and the versions of what matters for times."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    processor = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    versions = []
    for library in ("pybullet", "mujoco", "ruckig", "pin", "numpy"):
        try:
            versions.append(f"{library} {metadata.version(library)}")
        except metadata.PackageNotFoundError:
            continue
    where = f"{os.cpu_count()} cores ({processor or platform.machine()}), load {os.getloadavg()[0]:.1f}"
    return {"computer": f"{where}, Python {platform.python_version()}, {', '.join(versions)}"}


# Commits.


def git(*words: str) -> str:
    """Return the output of git in the repository; empty if it fails, as in a copy without history."""
    try:
        done = subprocess.run(["git", *words], cwd=FOLDER.parent, capture_output=True, text=True, timeout=20.0)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def current_commit() -> str:
    """Return the short name of the commit that runs, with a + if files were changed since."""
    name = git("rev-parse", "--short=7", "HEAD") or "unknown"
    return name + "+" * bool(git("status", "--porcelain", "--untracked-files=no"))


def measured_commits() -> Iterator[tuple[str, str]]:
    """Yield the benchmark and the commit that docs/measured.md names beside each of its commands."""
    command = r"`python -m benchmarks (\w+)[^`\n]*`[^`\n]*?commit ([0-9a-f]{7})"
    yield from re.findall(command, PAGE.read_text(encoding="utf-8"))


def module_constant(name: str, constant: str) -> Any:
    """Return a constant of a benchmark, or its docstring, without importing it."""
    tree = ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8"))
    if constant == "__doc__":
        return ast.get_docstring(tree)
    found = (
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == constant
    )
    return ast.literal_eval(next(found))


def commits_since(name: str, commit: str) -> int:
    """Return how many commits changed the code that a benchmark measures since it was measured; 0 if unknown."""
    return len(git("rev-list", f"{commit}..HEAD", "--", *module_constant(name, "PATHS")).splitlines())


def describe() -> Iterator[str]:
    """Yield a line for each benchmark: what it measures, and how old its figures in docs/measured.md are."""
    commits: dict[str, str] = dict(measured_commits())
    for name in NAMES:
        what = module_constant(name, "__doc__").partition("\n")[0].rstrip(".")
        commit = commits.get(name)
        age = commit and commits_since(name, commit)
        state = f"; measured at {commit}, {age} commits ago" if age else f"; measured at {commit}" if commit else ""
        yield f"{name:14s} {what}{state}"


if __name__ == "__main__":
    sys.exit(main())
