"""Things that a link of an arm carries: a board in a hand. They go where the link goes, and touch nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hal.errors import ConfigError, Problem
from hal.specs import BodySpec

from .body import Body
from .library import Client
from .transforms import compose
from .values import nearest

__all__ = ["Carried"]


class Carried:
    """Puts the carried bodies of a world where their links are.

    They are no part of the physics: no weight in the hand, and nothing that they could push or be held back by.

    Raises:
        ConfigError: one is on an arm or a link that is not there, or on something that is no arm; lists all.
    """

    def __init__(self, client: Client, bodies: Mapping[str, Body]) -> None:
        self._client = client
        self._places: list[tuple[Body, Body, int]] = []
        problems: list[Problem] = []
        for body in bodies.values():
            spec = body.spec
            if not isinstance(spec, BodySpec) or spec.robot is None:
                continue
            arms = [name for name, other in bodies.items() if other.is_robot]
            key = f"objects.{body.name}.attached"
            if spec.robot not in arms:
                problems.append(Problem("objects", f"{key}.robot", f"no arm {spec.robot!r}{nearest(spec.robot, arms)}"))
                continue
            arm = bodies[spec.robot]
            if spec.link is not None and spec.link not in arm.links:
                text = f"robot {spec.robot!r} has no link {spec.link!r}{nearest(spec.link, arm.links)}"
                problems.append(Problem("objects", f"{key}.link", text))
                continue
            self._places.append((body, arm, -1 if spec.link is None else arm.links[spec.link]))
        if problems:
            raise ConfigError(problems)

    def leave_physics(self, bodies: Iterable[Body]) -> None:
        """Let the carried ones of these touch nothing."""
        for body in bodies:
            if body.carried:
                for link in body.links.values():
                    self._client.setCollisionFilterGroupMask(body.id, link, 0, 0)

    def follow(self) -> None:
        """Go where the links are now."""
        client = self._client
        for body, arm, link in self._places:
            if link == -1:
                here = arm.base_pose(client)
            else:
                state = client.getLinkState(arm.id, link, computeForwardKinematics=True)
                here = (state[4], state[5])
            body.set_base_pose(client, compose(here, body.base))
