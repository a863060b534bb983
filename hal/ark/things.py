"""Ark's objects: primitives and URDFs."""

from __future__ import annotations

from typing import Any

from ..config.schema import describe
from .items import Item, Work
from .posing import position_of, rotation_of, tidy
from .reading import Node
from .text import Commented

__all__ = ["import_object"]

_LONG = {"radius": "radius", "height": "length", "length": "length"}
"""PyBullet says height to what is touched and length to what is drawn."""
_SHAPES: dict[str, tuple[str, dict[str, str]]] = {
    "GEOM_BOX": ("box", {"halfExtents": "half_extents"}),
    "GEOM_SPHERE": ("sphere", {"radius": "radius"}),
    "GEOM_CYLINDER": ("cylinder", _LONG),
    "GEOM_CAPSULE": ("capsule", _LONG),
    "GEOM_PLANE": ("plane", {}),
}
"""PyBullet's name -> the rig's, and the sizes' names there and here."""
_DYNAMICS = {
    "lateralFriction": "lateral_friction",
    "rollingFriction": "rolling_friction",
    "spinningFriction": "spinning_friction",
    "restitution": "restitution",
    "mass": "mass",
    "contactStiffness": "contact_stiffness",
    "contactDamping": "contact_damping",
    "linearDamping": "linear_damping",
    "angularDamping": "angular_damping",
}
"""PyBullet's names -> those of ``rig.world.set_dynamics``."""


class Thing:
    """One object on its way into ``objects``."""

    def __init__(self, item: Item, work: Work) -> None:
        self.item = item
        self.node = item.config
        self.key = item.key
        self.work = work
        self.reading = work.reading
        self.ledger = work.ledger
        self.entry: dict[str, Any] = {"name": item.name}

    def from_urdf(self) -> None:
        places, given_name = self.work.places, self.item.given
        path = self.reading.need(self.node, "urdf_path")
        given = self.reading.text(path)
        said = self.work.options.urdfs.get(given_name)
        found = said.resolve() if said is not None else places.find(given, self.node.file.parent)
        if said is not None and (found is None or not found.is_file()):
            raise self.reading.wrong(path, f"there is no file {found}, which --urdf names")
        if found is None and (inside := places.in_package(given)) is not None:
            self.entry["urdf"] = inside
            self.ledger.changed(path, f"{self.key}.urdf", "PyBullet's own data")
        elif found is None or not found.is_file():
            raise self.reading.wrong(
                path,
                f"there is no file {given!r} in {places.told()}; Ark looks where it is started. Name that "
                f"folder with --start or the file with --urdf {given_name}=FILE, or say --without {given_name}",
            )
        else:
            self.entry["urdf"] = found
            self.ledger.changed(path, f"{self.key}.urdf", "relative to the rig's file, not to where a program starts")
        scale = self.node.get("global_scaling")
        if scale is not None:
            value = self.reading.number(scale, positive=True)
            if value != 1:
                self.entry["scale"] = value
            self.ledger.kept(scale, f"{self.key}.scale")
        for part in ("visual", "collision"):
            self.ledger.nothing(self.node.children.get(part), "a URDF brings its own shapes and colours")

    def from_primitive(self) -> None:
        touched, drawn = self._shape("collision"), self._shape("visual")
        size = self.node.get("size")
        if touched is None and drawn is None and size is not None:
            self._plain_box(size)
            return
        if touched is None and drawn is None:
            raise self.reading.wrong(self.node, "has neither a collision nor a visual shape")
        entry = {key: value for key, value in (touched or drawn or {}).items() if key != "rgba"}
        self.entry.update(entry)
        if touched is None:
            self.entry["collision"] = Commented(False, "Ark's file has no collision shape")
        if drawn is None:
            self.entry["visible"] = Commented(False, "Ark's file has no visual shape")
        elif "rgba" in drawn:
            self.entry["rgba"] = drawn["rgba"]
        differs = touched is not None and drawn is not None and not _same(touched, drawn)
        self._account("collision", "")
        self._account("visual", "what is drawn here is the collision shape" if differs else "")
        body = self.node.get("multi_body")
        self._mass(self.reading.keys(body).get("baseMass") if body is not None else None)

    def _plain_box(self, size: Node) -> None:
        """As the files for Ark's newer simulators have it: whole sides and a mass."""
        self.entry |= {"shape": "box", "half_extents": tidy([side / 2 for side in self.reading.numbers(size, (3,))])}
        self.ledger.changed(size, f"{self.key}.half_extents", "half of it")
        self._mass(self.node.get("mass"))

    def _mass(self, mass: Node | None) -> None:
        if mass is not None:
            value = self.reading.number(mass)
            self.entry["mass"] = Commented(0, "stands still") if value == 0 else value
            self.ledger.kept(mass, f"{self.key}.mass", "0 stands still, as in PyBullet" if value == 0 else "")

    def _shape(self, part: str) -> dict[str, Any] | None:
        """Shape, sizes and colour of ``visual`` or ``collision``, as the rig's keys; None without such a part."""
        node = self.node.get(part)
        if node is None:
            return None
        reading = self.reading
        kind = reading.need(reading.keys(node), "shape_type")
        word = reading.text(kind).upper()
        if word not in _SHAPES:
            text = f"{word} has no counterpart; there are {', '.join(_SHAPES)}. Make a URDF of it"
            raise reading.wrong(kind, f"{text}, or say --without {self.item.given}")
        shape, names = _SHAPES[word]
        found: dict[str, Any] = {"shape": shape}
        sizes = reading.keys(reading.need(node, f"{part}_shape"))
        for name, key in names.items():
            size = sizes.get(name)
            if size is not None:
                many = key == "half_extents"
                found[key] = reading.numbers(size, (3,)) if many else reading.number(size, positive=True)
        missing = [name for name, key in names.items() if key not in found]
        if missing:
            raise reading.wrong(sizes, f"{' or '.join(missing)} is missing: PyBullet would take its own default")
        colour = sizes.get("rgbaColor")
        if colour is not None:
            found["rgba"] = reading.numbers(colour, (4,))
        return found

    def _account(self, part: str, changed: str) -> None:
        """What became of the keys of ``visual`` and ``collision``."""
        node = self.node.get(part)
        if node is None:
            return
        sizes = node.get(f"{part}_shape")
        self.ledger.kept(node.get("shape_type"), f"{self.key}.shape", changed)
        names = {theirs: ours for _, sizes_of in _SHAPES.values() for theirs, ours in sizes_of.items()}
        for name, leaf in (sizes.children if sizes is not None else {}).items():
            if name == "rgbaColor" and part == "visual":
                self.ledger.kept(leaf, f"{self.key}.rgba")
            elif name in names:
                add = self.ledger.changed if changed else self.ledger.kept
                add(leaf, f"{self.key}.{names[name]}", changed)
            else:
                self.ledger.nothing(leaf, f"a {self.entry['shape']} has no such key here")

    def place(self) -> None:
        position = position_of(self.node, "base_position", f"{self.key}.position", self.reading, self.ledger)
        rotation = rotation_of(self.node, "base_orientation", f"{self.key}.orientation", self.reading, self.ledger)
        if position is not None:
            self.entry["position"] = position
        if rotation is not None and rotation.turns:
            self.entry["orientation"] = rotation.value

    def rest(self) -> None:
        """Keys that say nothing about what stands in the world."""
        self.ledger.nothing(
            self.node.children.get("publish_ground_truth"),
            f"rig.world.pose({self.item.name!r}) tells it, of every object, when it is asked for",
        )
        self.ledger.nothing(self.node.children.get("class_dir"), "objects have no classes here")
        dynamics = self.node.get("dynamics")
        for name, leaf in (dynamics.children if dynamics is not None else {}).items():
            ours = _DYNAMICS.get(name)
            call = f"rig.world.set_dynamics({self.item.name!r}, {ours}={leaf.data})"
            self.ledger.nothing(leaf, f"not in a rig's file: {call}" if ours else "rig.world.set_dynamics has no such")


def import_object(item: Item, work: Work) -> dict[str, Any]:
    """An entry of ``objects``. Raises Wrong; the problem is noted."""
    thing = Thing(item, work)
    source = work.reading.need(work.reading.keys(item.config), "source")
    if source.data == "urdf":
        thing.from_urdf()
    elif source.data == "primitive":
        thing.from_primitive()
    else:
        raise work.reading.wrong(
            source, f"must be urdf or primitive, not {describe(source.data)}; --without {item.given} leaves it out"
        )
    work.ledger.kept(source, f"{item.key}.shape")
    thing.place()
    thing.rest()
    return thing.entry


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Alike, but for colour?"""
    return {**one, "rgba": None} == {**other, "rgba": None}
