"""The base of every simulated world: the requests of ``rig.world``, their checks, errors, edits and resets.

An engine subclasses :class:`SimulatedWorld` and fills in what :mod:`.engine` lists; it only gets bodies and numbers
that exist and make sense.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from operator import gt
from typing import Any

from hal.errors import CommandError, ConfigError, DeviceNotFound, Fault, NotSupported, Problem, suggest
from hal.geometry import Transform, compose, inverse
from hal.specs import BodySpec, RobotSpec, WorldSpec, to_json

from .disturbances import UNCHANGED, Randomized
from .engine import AppliedForce, B, SceneEngine
from .joints import joints_to_place, movable_joints, reset_positions
from .states import check_state, structure_of
from .values import (
    body_spec,
    check_body,
    completed_dynamics,
    dynamics_values,
    like,
    numbers,
    pose_json,
    same_value,
    transform,
)

OVERLAP = 0.005
"""Depth, m, from which on two arms that overlap at the start are refused, and objects that do are reported."""


class SimulatedWorld(SceneEngine[B]):
    """A world of a physics engine, without the engine.

    An engine's ``__init__`` prepares it and calls :meth:`load_bodies` with all bodies and robots of its record, and
    :meth:`check_overlaps`.
    """

    def __init__(self, spec: WorldSpec) -> None:
        super().__init__(spec)
        self.bodies: dict[str, B] = {}
        self.fault: Fault | None = None
        """Why the simulation stands still, which its arms report; None while it runs."""
        self._changes = 0
        """Changes of poses other than by steps, and of looks."""
        self._edited_at = 0
        """The step after which the world was edited last."""
        self.began_at = 0
        """The step of the newest reset or edit of bodies: what was before is another scene."""
        self.randomized = UNCHANGED
        """What ``rig.world.randomize`` applied last."""
        self.forces: list[AppliedForce[B]] = []
        """Forces on links that act in the coming step."""
        self._gravity = list(spec.gravity)
        self._on_reset: dict[str, list[Callable[[], None]]] = {}
        self._on_edit: list[Callable[[str, dict[str, Any], int], None]] = []
        self.preparations: dict[str, Callable[[], None]] = {}
        self._kept: dict[str, tuple[Callable[[], Any], Callable[[Any], None]]] = {}
        """How the states of drivers are saved and restored."""

    # --- loading -----------------------------------------------------------------------------------------------------

    def load_bodies(self, specs: Sequence[BodySpec | RobotSpec]) -> None:
        """Load bodies and put them home; raises ConfigError with the problems of all of them."""
        problems: list[Problem] = []
        added: list[B] = []
        for spec in specs:
            if spec.name in self.bodies:
                message = "names two bodies; names must be unique in the world"
                problems.append(Problem("world", spec.name, message, "duplicate_name"))
                continue
            try:
                added.append(self.load_body(spec))
                self.bodies[spec.name] = added[-1]
            except ConfigError as error:
                problems.extend(error.problems)
        problems = problems or self._attachment_problems(specs)
        if problems:
            raise ConfigError(problems)
        self._renumber()
        self.arrange_bodies(added)
        for body in added:
            self._put_home(body)
        self.start_bodies(added)
        self.place_attached()

    def is_mirrored(self, body: B) -> bool:
        """Return whether another driver moves this arm, so that it mirrors a real one."""
        return isinstance(body.spec, RobotSpec) and body.spec.driver != self.spec.driver

    def _renumber(self) -> None:
        for index, body in enumerate(self.bodies.values()):
            body.index = index

    def _attachment_problems(self, specs: Iterable[BodySpec | RobotSpec]) -> list[Problem]:
        """Return what is wrong with objects that are attached: a missing arm or link, or something else than an arm."""
        arms = [name for name, body in self.bodies.items() if body.is_robot]
        problems = []
        for spec in specs:
            if not isinstance(spec, BodySpec) or spec.robot is None:
                continue
            key = f"objects.{spec.name}.attached"
            if spec.robot not in arms:
                text = f"no arm {spec.robot!r}{suggest(spec.robot, arms)}"
                problems.append(Problem("objects", f"{key}.robot", text, "unknown_device"))
            elif spec.link is not None and spec.link not in (links := self.bodies[spec.robot].links):
                text = f"robot {spec.robot!r} has no link {spec.link!r}{suggest(spec.link, links)}"
                problems.append(Problem("objects", f"{key}.link", text, "unknown_link"))
        return problems

    def list_attachments(self) -> list[tuple[B, B, int]]:
        """Return each attached object, its arm, and the number of the arm's link."""
        found = []
        for body in self.bodies.values():
            spec = body.spec
            if isinstance(spec, BodySpec) and spec.robot is not None:
                arm = self.bodies[spec.robot]
                found.append((body, arm, self.link(arm, spec.link)))
        return found

    def list_parts(self, added: Sequence[B]) -> Iterator[tuple[B, B, frozenset[int]]]:
        """Yield each new arm of the same robot as another one, that one, and the links of it that it never touches."""
        for part in added:
            whole = self.bodies.get(getattr(part.spec, "same", None) or "")
            if whole is not None:
                yield part, whole, whole.ignored_by(part)

    def check_overlaps(self) -> None:
        """Refuse arms that overlap at the start: the solver would throw them apart."""
        robots = [body for body in self.bodies.values() if body.is_robot and not self.is_mirrored(body)]
        problems = []
        for a, b in combinations(robots, 2):
            depth, link_a, link_b = self.find_overlap(a, b)
            if depth > OVERLAP:
                message = f"starts {depth:.3f} m inside robot {a.name!r} (its {link_b} in {link_a})"
                remedy = f"change its base or initial, or add same: {a.name} if both are arms of one robot"
                problems.append(Problem("simulation", f"robots.{b.name}", f"{message}; {remedy}", "robots_overlap"))
        if problems:
            raise ConfigError(problems)
        self._report_overlaps(self.bodies.values())

    def _report_overlaps(self, added: Iterable[B]) -> None:
        """Warn of free objects among ``added`` that are inside of something: the solver pushes them out anywhere."""
        loose = {body.name for body in added if body.floating and not body.carried}
        boxes = {name: self.measure_box(body) for name, body in self.bodies.items() if loose and not body.carried}
        for one, other in combinations(boxes, 2):
            if one not in loose:
                one, other = other, one
            (lower, upper), (least, most) = boxes[one], boxes[other]
            if one not in loose or any(map(gt, lower, most)) or any(map(gt, least, upper)):
                continue
            depth = self.find_overlap(self.bodies[one], self.bodies[other])[0]
            if depth > OVERLAP:
                text = f"{one} starts {depth:.3f} m inside {other}, which may push it out to any side"
                self.warnings.append(f"{text}: change its position")

    # --- requests of rig.world: their parameters and results are in hal.world.WorldDriver ----------------------------

    def request(self, method: str, params: Mapping[str, Any]) -> Any:
        if method not in self.REQUESTS:
            raise CommandError(f"the world has no request {method!r}; requests: {', '.join(sorted(self.REQUESTS))}")
        function = getattr(self, method)
        try:
            return function(**params)
        except TypeError:
            try:
                inspect.signature(function).bind(**params)
            except TypeError as error:
                raise CommandError(f"world.{method}: {error}") from None
            raise

    def names(self) -> list[str]:
        return list(self.bodies)

    def describe(self, name: str) -> dict[str, Any]:
        body = self.body(name)
        links, joints = list(body.links), list(body.joints)
        movable = {joint: facts._asdict() for joint, facts in movable_joints(body).items()}
        spec = None if body.is_robot else to_json(body.spec)
        return {
            "index": body.index,
            "robot": body.is_robot,
            "spec": spec,
            "links": links,
            "joints": joints,
            "movable": movable,
        }

    def pose(self, name: str, link: str | None = None) -> dict[str, list[float]]:
        body = self.body(name)
        return pose_json(self.read_pose(body, self.link(body, link)))

    def poses(self, names: Sequence[str] | None = None) -> dict[str, Any]:
        found = self.bodies.values() if names is None else [self.body(name) for name in names]
        poses = {body.name: pose_json(self.read_pose(body, self.link(body, None))) for body in found}
        return {"t": self.t, "poses": poses}

    def set_pose(self, name: str, pose: Mapping[str, Sequence[float]]) -> None:
        """Place an object's base link there, at rest, without a check for overlaps; its joints keep their positions."""
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: its servo moves it, and reset() puts it back", code="is_robot")
        self._expect_free(body)
        there = transform(pose)
        self._note_edit()
        self.move_base(body, there)

    def joint_positions(self, name: str) -> dict[str, float]:
        body = self.body(name)
        return dict(zip(movable_joints(body), self.read_joints(body), strict=True))

    def set_joint_positions(self, name: str, positions: Mapping[str, float]) -> None:
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: its servo moves it; reset(q=...) places it", code="is_robot")
        wanted = joints_to_place(body, positions)
        self._note_edit()
        self.move_joints(body, wanted)

    def velocity(self, name: str) -> list[list[float]]:
        return [list(part) for part in self.read_velocity(self.body(name))]

    def set_velocity(
        self, name: str, linear: Sequence[float] = (0.0, 0.0, 0.0), angular: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        body = self.body(name)
        if not body.floating:
            raise CommandError(f"the base of {name!r} is fixed: it has no velocity to set", code="base_fixed")
        self.write_velocity(body, numbers("linear", linear, 3), numbers("angular", angular, 3))

    def apply_force(
        self,
        name: str,
        force: Sequence[float],
        point: Sequence[float] | None = None,
        link: str | None = None,
        duration: float | None = None,
    ) -> None:
        body = self.body(name)
        number = self.link(body, link)
        self._expect_free(body)
        if self.is_mirrored(body):
            raise CommandError(f"{name!r} mirrors a real arm: nothing in the simulation moves it", code="is_mirrored")
        if not (body.floating or (number != self.link(body, None) and body.movable)):
            raise CommandError(f"the base of {name!r} is fixed: a force does not move it", code="base_fixed")
        pushed, at = numbers("force", force, 3), None
        if point is not None:
            there = numbers("point", point, 3)
            at = compose(inverse(self.read_pose(body, number)), (tuple(there), (0.0, 0.0, 0.0, 1.0)))[0]
        steps = 1
        if duration is not None:
            (seconds,) = numbers("duration", [duration])
            if seconds <= 0.0:
                raise CommandError(f"duration must be more than 0 s, not {duration}")
            steps = max(1, round(seconds / self.dt))
        self.forces.append(AppliedForce(body, number, pushed, at, steps))

    def spend_forces(self) -> None:
        """Note that a step was made with the present forces."""
        for force in self.forces:
            force.steps -= 1
        self.forces = [force for force in self.forces if force.steps > 0]

    def set_gravity(self, gravity: Sequence[float]) -> list[float]:
        before, self._gravity = self._gravity, numbers("gravity", gravity, 3)
        self.write_gravity(self._gravity)
        return before

    def ray(self, start: Sequence[float], end: Sequence[float]) -> dict[str, Any] | None:
        here, there = numbers("start", start, 3), numbers("end", end, 3)
        if math.dist(here, there) < 1e-9:
            raise CommandError("a ray needs two different points, start and end")
        found = self.cast_ray(here, there)
        if found is None:
            return None
        body, link, position, normal = found
        return {
            "name": body.name,
            "link": body.link_name(link),
            "position": list(position),
            "normal": list(normal),
            "distance": math.dist(here, position),
        }

    def distance(self, a: str, b: str, link_a: str | None = None, link_b: str | None = None) -> float:
        first, second = self.body(a), self.body(b)
        if first is second:
            raise CommandError(f"the distance needs two bodies, not {a!r} twice")
        links_a, links_b = (
            [self.link(body, link)] if link is not None else [*{*body.links.values()} - body.ignored_by(other)]
            for body, other, link in ((first, second, link_a), (second, first, link_b))
        )
        found = self.measure_distance(first, links_a, second, links_b)
        if found is None:
            raise CommandError(f"{a!r} or {b!r} has no collision shape there", code="no_shape")
        return found

    def dynamics(self, name: str, link: str | None = None) -> dict[str, Any]:
        body = self.body(name)
        return self.read_dynamics(body, self.link(body, link))

    def set_dynamics(self, name: str, link: str | None = None, **values: Any) -> dict[str, Any]:
        body = self.body(name)
        number = self.link(body, link)
        wanted = dynamics_values(name, values)
        for key in wanted:
            if key in self.UNSUPPORTED:
                raise NotSupported(f"{self.ENGINE} has no {key}: {self.UNSUPPORTED[key]}", code="no_such_quantity")
        before = self.read_dynamics(body, number)
        wanted = completed_dynamics(name, wanted, before)
        self.write_dynamics(body, number, wanted, before)
        after = self.read_dynamics(body, number)
        for key, value in wanted.items():
            if not same_value(after[key], value):
                raise NotSupported(f"{self.ENGINE} did not take {key} = {value} for {name!r}: it holds {after[key]}")
        self.forget_contacts([body])
        self._edited_at = self.steps
        return {key: before[key] for key in wanted}

    def contacts(self, a: str | None = None, b: str | None = None, stamped: bool = False) -> Any:
        if a is None:
            a, b = b, None
        first, second = (None if name is None else self.body(name) for name in (a, b))
        stale = self._edited_at == self.steps
        found = [] if stale else self.find_contacts(first, second)
        return {"t": None if stale else self.t, "contacts": found} if stamped else found

    def _note_edit(self) -> None:
        """Note that poses are others than those of the last step."""
        self._changes += 1
        self._edited_at = self.steps

    def aabb(self, name: str) -> dict[str, list[float]]:
        lower, upper = self.measure_box(self.body(name))
        return {"lower": lower, "upper": upper}

    def add(self, spec: Mapping[str, Any] | BodySpec) -> int:
        record = spec if isinstance(spec, BodySpec) else body_spec(spec)
        check_body(record)
        problems = self._attachment_problems([record])
        if problems:
            raise ConfigError(problems)
        self.load_bodies([record])
        self._report_overlaps([self.bodies[record.name]])
        return self._publish_edit("add", spec=to_json(record))

    def remove(self, name: str) -> int:
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: robots stay in the world", code="is_robot")
        self.unload_body(body)
        del self.bodies[name]
        self.forces = [force for force in self.forces if force.body is not body]
        self._renumber()
        self.arrange_bodies(())
        return self._publish_edit("remove", name=name)

    def set_color(self, name: str, rgba: Sequence[float]) -> int:
        self.body(name)
        color = numbers("rgba", rgba, 4)
        if not all(0.0 <= value <= 1.0 for value in color):
            raise CommandError(f"rgba of {name!r} must be numbers in 0..1, not {color}")
        return self._publish_edit("set_color", name=name, rgba=color)

    def randomize(self, values: Mapping[str, Any], seed: int) -> int:
        self.randomized = Randomized.take(values, seed)
        return self._publish_edit("randomize", values=dict(values), seed=seed)

    def _publish_edit(self, method: str, **params: Any) -> int:
        self._changes += 1
        if method in ("add", "remove"):
            self._edited_at = self.steps
        if method != "set_color":
            self.began_at = self.steps
        self.revision += 1
        for callback in self._on_edit:
            callback(method, params, self.revision)
        return self.revision

    def reset(
        self,
        name: str | None = None,
        pose: Mapping[str, Sequence[float]] | None = None,
        q: Sequence[float] | None = None,
    ) -> None:
        """Reset one body, or all, at rest, to their initial state in the rig or to these arguments.

        An arm holds its position and its gripper is open. The mirror of a real arm stays where that arm is. Added and
        removed bodies, colours and dynamics are kept, and simulated time continues. ``pose`` is that of an object's
        base link in the world; ``q`` are positions, rad or m, of an arm's joints, or of its joints and fingers, or of
        all movable joints of an object.
        """
        self.began_at = self.steps
        if name is None:
            if pose is not None or q is not None:
                raise CommandError("reset with a pose or with q needs the name of a body", code="name_missing")
            everything = list(self.bodies.values())
            self.forget_contacts(everything)
            for body in everything:
                if not self.is_mirrored(body):
                    self._put_home(body)
            self.place_attached()
            return
        body = self.body(name)
        if self.is_mirrored(body):
            raise CommandError(f"{name!r} mirrors a real arm; move that", code="is_mirrored")
        base = body.base
        if pose is not None:
            if body.is_robot:
                raise CommandError(f"{name!r} is a robot: its base is fixed by the rig", code="is_robot")
            self._expect_free(body)
            base = transform(pose)
        joints = body.home if q is None else {**body.home, **reset_positions(body, q)}
        self.forget_contacts([body])
        self._put(body, base, joints)
        self.place_attached()

    def save(self) -> dict[str, Any]:
        return {
            "engine": self.ENGINE,
            "bodies": structure_of(self.bodies.values()),
            "drivers": {name: save() for name, (save, _) in self._kept.items()},
            "forces": [
                [one.body.name, one.body.link_name(one.link), list(one.force), one.point and list(one.point), one.steps]
                for one in self.forces
            ],
            "state": self.save_engine(),
        }

    def restore(self, state: Any) -> None:
        check_state(state, self.ENGINE, structure_of(self.bodies.values()))
        drivers = state["drivers"]
        own = {name: save() for name, (save, _) in self._kept.items() if name in (drivers or ())}
        if not isinstance(drivers, Mapping) or not all(like(drivers[name], part) for name, part in own.items()):
            raise CommandError("the state of an arm or a gripper in it is none of this world's", code="wrong_state")
        try:
            forces = [self._saved_force(*force) for force in state["forces"]]
            self.restore_engine(state["state"])
        except (AttributeError, DeviceNotFound, CommandError, KeyError, ValueError, TypeError) as error:
            raise CommandError(f"the state cannot be restored: {error}", code="wrong_state") from error
        self.forces = forces
        self.began_at = self.steps
        self._note_edit()
        self.place_attached()
        for name, (_, restore) in self._kept.items():
            if name in drivers:
                restore(drivers[name])

    def _saved_force(self, name: str, link: str, force: Any, point: Any, steps: Any) -> AppliedForce[B]:
        body = self.body(name)
        at = None if point is None else numbers("point", point, 3)
        return AppliedForce(body, self.link(body, link), numbers("force", force, 3), at, max(1, int(steps)))

    def _expect_free(self, body: B) -> None:
        if body.carried:
            raise CommandError(f"{body.name!r} is attached to an arm: it follows that arm", code="is_attached")

    def _put_home(self, body: B) -> None:
        self._put(body, body.base, body.home)

    def _put(self, body: B, base: Transform, joints: Mapping[int, float]) -> None:
        self._note_edit()
        self.forces = [force for force in self.forces if force.body is not body]
        if not body.carried:
            self.move_base(body, base)
        self.move_joints(body, joints)
        for callback in self._on_reset.get(body.name, ()):
            callback()

    # --- for drivers and views ---------------------------------------------------------------------------------------

    @property
    def version(self) -> tuple[int, int]:
        return self.steps, self._changes

    def follow(self, name: str, q: Sequence[float], dq: Sequence[float], width: float | None = None) -> None:
        body = self.body(name)
        if not self.is_mirrored(body):
            raise CommandError(f"{name!r} is not the mirror of a real arm", code="not_mirrored")
        assert isinstance(body.spec, RobotSpec)
        count = len(body.spec.joints)
        positions, speeds = numbers(f"q of {name!r}", q, count), numbers(f"dq of {name!r}", dq, count)
        if width is not None:
            (width,) = numbers(f"the width of {name!r}", [width])
        self.place_mirror(body, positions, speeds, width)
        self._changes += 1

    def body(self, name: str) -> B:
        """Return the body of that name; raises DeviceNotFound, which lists all."""
        body = self.bodies.get(name)
        if body is None:
            raise DeviceNotFound(f"the world has no body {name!r}{suggest(name, self.bodies)}", code="unknown_body")
        return body

    def link(self, body: B, name: str | None) -> int:
        """Return the number of a link by name, that of the base link for None; raises DeviceNotFound."""
        if name is None:
            return next(iter(body.links.values()))
        if name not in body.links:
            raise DeviceNotFound(f"{body.name!r} has no link {name!r}{suggest(name, body.links)}", code="unknown_link")
        return body.links[name]

    def on_reset(self, name: str, callback: Callable[[], None]) -> None:
        self._on_reset.setdefault(name, []).append(callback)

    def off_reset(self, name: str, callback: Callable[[], None]) -> None:
        self._on_reset[name].remove(callback)

    def keep(self, name: str, save: Callable[[], Any], restore: Callable[[Any], None]) -> None:
        self._kept[name] = save, restore

    def before_steps(self, name: str, callback: Callable[[], None] | None) -> None:
        """Call ``callback`` before each step, in place of that of the same name; None ends it."""
        if callback is not None:
            self.preparations[name] = callback
        else:
            self.preparations.pop(name, None)

    def on_edit(self, callback: Callable[[str, dict[str, Any], int], None]) -> None:
        self._on_edit.append(callback)
