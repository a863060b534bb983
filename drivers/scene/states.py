"""What a saved state of a simulated world needs to fit another one, and the words for one that does not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from hal.errors import CommandError

from .engine import SimulatedBody

_PARTS = frozenset({"engine", "bodies", "drivers", "forces", "state"})


def structure_of(bodies: Iterable[SimulatedBody]) -> list[list[Any]]:
    """Return the name of each body with how many joints it has, whether it is free, and the base of an arm."""
    return [
        [body.name, len(body.movable), body.floating, *((*body.base[0], *body.base[1]) if body.is_robot else ())]
        for body in bodies
    ]


def check_state(state: Any, engine: str, ours: list[list[Any]]) -> None:
    """Raise CommandError unless a state is one of this engine, and of bodies as ours (:func:`structure_of`)."""
    if not set(state if isinstance(state, Mapping) else ()) >= _PARTS:
        raise CommandError("not a state of a world; rig.world.save() returns one", code="wrong_state")
    if state["engine"] != engine:
        raise CommandError(f"the state is one of {state['engine']}, not of {engine}", code="wrong_state")
    theirs = state["bodies"]
    if not isinstance(theirs, list) or not all(isinstance(body, list) and body for body in theirs):
        raise CommandError("not a state of a world: it has no list of bodies", code="wrong_state")
    if theirs != ours:
        raise CommandError(f"the state is one of other bodies: {_difference(theirs, ours)}", code="wrong_state")


def _difference(theirs: list[list[Any]], ours: list[list[Any]]) -> str:
    there, here = ([body[0] for body in bodies] for bodies in (theirs, ours))
    lacking = [str(name) for name in there if name not in here]
    further = [str(name) for name in here if name not in there]
    found = []
    if lacking:
        found.append(f"this world has no {', '.join(lacking)}")
    if further:
        found.append(f"the state has no {', '.join(further)}")
    if not found and there != here:
        found.append(f"they were added in another order: {', '.join(map(str, there))}")
    changed = [str(body[0]) for body in ours if body[0] in there and body not in theirs]
    if changed:
        found.append(f"{', '.join(changed)} has other joints or another base")
    return "; ".join(found)
