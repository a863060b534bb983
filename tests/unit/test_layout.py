"""The rules for the layout of the code: who may import whom, no circles, small functions, unique names."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST_BRANCHES, MOST_LINES = 15, 60
"""Of one function."""
TANGLED = {
    "packages/import-ark/src/hal_import_ark/arm_model.py:_joints",
    "packages/import-ark/src/hal_import_ark/importing.py:import_ark",
    "packages/import-ark/src/hal_import_ark/robots.py:place",
    "packages/import-ark/src/hal_import_ark/scene.py:attached",
    "hal/kinematics/collision_model.py:_scene",
    "hal/recording/exporters/__init__.py:export",
    "hal/recording/merging.py:merge",
    "hal/recording/recorder.py:__init__",
}
"""Functions that are still above these limits. None is added; one that is divided is removed here."""
CIRCLES = 3
"""At most so many import circles, TYPE_CHECKING included, and none of more modules than this."""
SHARED_CLASS_NAMES = 3
SHARED = "scene"
"""The folder in ``drivers/`` that is no driver: simulated scenes without a physics engine. Drivers may import it."""
DRIVERS = tuple(sorted({path.parent.name for path in (ROOT / "drivers").glob("*/__init__.py")} - {SHARED}))


@cache
def sources() -> dict[str, Path]:
    """Return every module of the package, by its dotted name."""
    found = {}
    for folder in ("hal", "drivers", "apps"):
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if path.is_relative_to(ROOT / "hal" / "data") or parts[:2] in (("hal", "drivers"), ("hal", "apps")):
                continue  # links to the folders beside hal/
            parts = parts if folder == "hal" else ("hal", *parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def tree(path: Path) -> ast.Module:
    """Return a module's syntax tree."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(module: str) -> tuple[str, ...]:
    """Return the dotted names that a module imports, see :func:`_imports`; several tests need those of every module."""
    return tuple(_imports(module))


def _imports(module: str) -> Iterator[str]:
    """Yield the dotted names that a module imports, ``module.name`` for each name, TYPE_CHECKING included."""
    path = sources()[module]
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    nodes: list[ast.AST] = [tree(path)]
    for node in nodes:
        inside = ast.iter_child_nodes(node)
        nodes += [child for child in inside if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case))]
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            yield name
            yield from (f"{name}.{alias.name}" for alias in node.names)


def circles() -> list[list[str]]:
    """Return the strongly connected components of the imports that have more than one module."""
    modules = {name for name, path in sources().items() if path.name != "__init__.py"}
    edges = {module: sorted({name for name in imports(module) if name in modules} - {module}) for module in modules}
    order: list[str] = []
    seen: set[str] = set()

    def visit(start: str, graph: dict[str, list[str]], out: list[str]) -> None:
        stack = [(start, iter(graph[start]))]
        seen.add(start)
        while stack:
            rest = stack[-1][1]
            follower = next((name for name in rest if name not in seen), None)
            if follower is None:
                out.append(stack.pop()[0])
            else:
                seen.add(follower)
                stack.append((follower, iter(graph[follower])))

    for module in sorted(modules):
        if module not in seen:
            visit(module, edges, order)
    backwards: dict[str, list[str]] = {module: [] for module in modules}
    for module, followers in edges.items():
        for follower in followers:
            backwards[follower].append(module)
    seen.clear()
    found = []
    for module in reversed(order):
        if module not in seen:
            part: list[str] = []
            visit(module, backwards, part)
            found.append(sorted(part))
    return [part for part in found if len(part) > 1]


def test_modules_run_from_the_files_that_a_user_opens() -> None:
    """Not through the links of a checkout: debuggers compare paths, and would stop at no breakpoint."""
    for name in ("hal.rig", "hal.drivers.mock.robot", "hal.apps.main"):
        assert import_module(name).__file__ == str(sources()[name].resolve())


def test_import_circles_are_few_and_small() -> None:
    found = circles()
    assert len(found) <= CIRCLES, found
    assert all(len(part) <= CIRCLES for part in found), found


def test_hal_names_no_driver() -> None:
    """Only the registry does, and what ships for tests."""
    quoted = re.compile(rf"""["']({"|".join(DRIVERS)})["']""")
    texts = re.compile(r'"""(?:.|\n)*?"""')  # docstrings show how a driver is chosen
    libraries = {"hal.recording.metadata"}  # names the Python packages whose versions an episode keeps
    wrong = {
        f"{module}: {found[0]}"
        for module, path in sources().items()
        if not module.startswith(("hal.drivers", "hal.apps", "hal.testing"))
        and module not in {"hal.registry", "hal.pytest_plugin", *libraries}
        for found in quoted.finditer(texts.sub("", path.read_text(encoding="utf-8")))
    }
    assert not wrong


def test_hal_imports_no_driver_and_no_app() -> None:
    wrong = {
        f"{module} imports {name}"
        for module in sources()
        if not module.startswith(("hal.drivers", "hal.apps"))
        for name in imports(module)
        if name.startswith(("hal.drivers.", "hal.apps."))
    }
    assert not wrong


def test_a_driver_imports_no_other_driver_and_no_app() -> None:
    """All but the shared folder, which itself imports no driver."""
    wrong = {
        f"{module} imports {name}"
        for module in sources()
        if module.startswith("hal.drivers.")
        for name in imports(module)
        if name.startswith("hal.apps.")
        or (name.startswith("hal.drivers.") and name.split(".")[2] not in (module.split(".")[2], SHARED))
    }
    assert not wrong


def test_hal_imports_no_package_beside_it_and_these_use_its_public_names() -> None:
    """Packages in ``packages/`` are found by their entry points, and their imports of ``hal`` have no underscore."""
    beside = {path.parent.name: path.parent for path in (ROOT / "packages").glob("*/src/*/__init__.py")}
    assert beside
    assert not [f"{module} imports {name}" for module in sources() for name in imports(module) if name in beside]
    wrong = []
    for folder in beside.values():
        for path in folder.rglob("*.py"):
            for node in ast.walk(tree(path)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "hal":
                    names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                    wrong += [f"{path}: {name}" for name in names if name.startswith("_")]
    assert not wrong


def test_nothing_outside_hal_uses_a_private_attribute_of_a_rig() -> None:
    private = re.compile(r"\brig\._[a-z]")
    wrong = [
        module
        for module, path in sources().items()
        if module.startswith(("hal.drivers.", "hal.apps.")) and private.search(path.read_text(encoding="utf-8"))
    ]
    assert not wrong


def test_class_names_are_unique() -> None:
    names = Counter(
        node.name
        for path in sources().values()
        for node in tree(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    shared = [name for name, count in names.items() if count > 1]
    assert len(shared) <= SHARED_CLASS_NAMES, shared


def test_no_docstring_is_a_question() -> None:
    wrong = [
        f"{module}:{node.lineno}"
        for module, path in sources().items()
        for node in ast.walk(tree(path))
        if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        and (ast.get_docstring(node) or "").split("\n")[0].rstrip().endswith("?")
    ]
    assert not wrong


def branches(function: ast.AST) -> int:
    """Return the number of decisions in a function, functions in it included.

    They are: if, for, while, except, case, a ternary, each ``and`` and ``or``, each condition of a comprehension.
    """
    decisions = (ast.If, ast.For, ast.While, ast.ExceptHandler, ast.IfExp, ast.match_case)
    count = 0
    for node in ast.walk(function):
        if isinstance(node, ast.BoolOp):
            count += len(node.values) - 1
        elif isinstance(node, ast.comprehension):
            count += len(node.ifs)
        else:
            count += isinstance(node, decisions)
    return count


def function_sizes() -> Iterator[tuple[str, int, int]]:
    """Yield name, branches and lines of every function outside tests and benchmarks."""
    beside = (path for folder in ("docs", "examples", "packages") for path in (ROOT / folder).rglob("*.py"))
    for path in (*sources().values(), *(path for path in beside if "tests" not in path.parts)):
        for node in ast.walk(tree(path)):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                yield f"{path.relative_to(ROOT)}:{node.name}", branches(node), lines


def test_no_function_is_long_or_tangled() -> None:
    found = {size for size in function_sizes() if size[1] > MOST_BRANCHES or size[2] > MOST_LINES}
    assert {name for name, _, _ in found} <= TANGLED, found


def import_table() -> dict[str, tuple[list[str], set[str]]]:
    """Return the table of docs/architecture.md: package -> its modules and packages, and the packages it imports."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\w+) \| (`[^|]*) \| [^|]* \| ([^|]*) \|$", text, re.MULTILINE)
    table = {}
    for package, files, imported in rows:
        names = [file.rstrip("/").removeprefix("hal/") for file in re.findall(r"`(.*?)`", files)]
        table[package] = ([f"hal.{name}" for name in names], set(re.findall(r"\w+", imported)) - {"nothing"})
    return table


def test_the_import_table_of_the_architecture_is_true() -> None:
    table = import_table()
    homes = {name: package for package, (names, _) in table.items() for name in names}

    def home(module: str) -> str | None:
        """Return the package of a module, or of a name in one."""
        return homes.get(".".join(module.split(".")[:2]))

    lacking = [module for module in sources() if module not in ("hal", "hal._moved") and home(module) is None]
    assert not lacking, "these modules are in no row of the table"
    found: dict[str, set[str]] = {package: set() for package in table}
    for module in sources():
        own = home(module)
        if own is not None:
            found[own] |= {other for name in imports(module) if (other := home(name)) not in (None, own)}
    wrong = {package: found[package] for package in table if found[package] != table[package][1]}
    assert not wrong, "docs/architecture.md: these packages really import"
