"""Conversion of Ark's cameras, objects and ``simulator`` section."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from hal.config.schema import describe
from hal.geometry import Pose, matrix_to_quaternion, quaternion_to_matrix, rpy_to_matrix
from hal.registry import ENGINES

from .entries import ArkItem, ImportState, position_of, rotation_of, tidy
from .output import Commented, Inline, KeyReport, Remark
from .reading import ArkNode, ArkReader, InvalidValue
from .robots import ArkArm

__all__ = [
    "import_camera",
    "import_object",
    "import_simulator",
]

_LONG = {"radius": "radius", "height": "length", "length": "length"}
"""PyBullet calls it height in collision shapes and length in visual shapes."""
_SHAPES: dict[str, tuple[str, dict[str, str]]] = {
    "GEOM_BOX": ("box", {"halfExtents": "half_extents"}),
    "GEOM_SPHERE": ("sphere", {"radius": "radius"}),
    "GEOM_CYLINDER": ("cylinder", _LONG),
    "GEOM_CAPSULE": ("capsule", _LONG),
    "GEOM_PLANE": ("plane", {}),
}
"""PyBullet's name of a shape: the rig's, and the names of its sizes in both."""
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
"""PyBullet's names and those of ``rig.world.set_dynamics``."""


class ObjectImport:
    """Converts one object."""

    def __init__(self, item: ArkItem, work: ImportState) -> None:
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
            raise self.reading.wrong(path, f"there is no file {found}, which --urdf names", "missing_file")
        if found is None and (inside := places.in_package(given)) is not None:
            self.entry["urdf"] = inside
            self.ledger.changed(path, f"{self.key}.urdf", "PyBullet's own data")
        elif found is None or not found.is_file():
            raise self.reading.wrong(
                path,
                f"there is no file {given!r} in {places.searched()}; Ark looks where it is started. Name that "
                f"folder with --start or the file with --urdf {given_name}=FILE, or add --without {given_name}",
                "missing_file",
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
            self.ledger.ignored(self.node.children.get(part), "a URDF brings its own shapes and colours")

    def from_primitive(self) -> None:
        touched, drawn = self._shape("collision"), self._shape("visual")
        size = self.node.get("size")
        if touched is None and drawn is None and size is not None:
            self._plain_box(size)
            return
        if touched is None and drawn is None:
            raise self.reading.wrong(self.node, "has neither a collision nor a visual shape", "missing_key")
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

    def _plain_box(self, size: ArkNode) -> None:
        """Convert a box of the files for Ark's newer simulators: whole sides and a mass."""
        self.entry |= {"shape": "box", "half_extents": tidy([side / 2 for side in self.reading.numbers(size, (3,))])}
        self.ledger.changed(size, f"{self.key}.half_extents", "half of it")
        self._mass(self.node.get("mass"))

    def _mass(self, mass: ArkNode | None) -> None:
        if mass is not None:
            value = self.reading.number(mass)
            self.entry["mass"] = Commented(0, "stands still") if value == 0 else value
            self.ledger.kept(mass, f"{self.key}.mass", "0: fixed, as in PyBullet" if value == 0 else "")

    def _shape(self, part: str) -> dict[str, Any] | None:
        """Shape, sizes and colour of ``visual`` or ``collision`` as the rig's keys; None if it is missing."""
        node = self.node.get(part)
        if node is None:
            return None
        reading = self.reading
        kind = reading.need(reading.keys(node), "shape_type")
        word = reading.text(kind).upper()
        if word not in _SHAPES:
            text = f"{word} has no counterpart; shapes: {', '.join(_SHAPES)}. Make a URDF of it"
            raise reading.wrong(kind, f"{text}, or add --without {self.item.given}", "no_counterpart")
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
            message = f"{' or '.join(missing)} is missing: PyBullet would take its own default"
            raise reading.wrong(sizes, message, "missing_key")
        colour = sizes.get("rgbaColor")
        if colour is not None:
            found["rgba"] = reading.numbers(colour, (4,))
        return found

    def _account(self, part: str, changed: str) -> None:
        """Report the keys of ``visual`` or ``collision``."""
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
                self.ledger.ignored(leaf, f"a {self.entry['shape']} has no such key here")

    def place(self) -> None:
        position = position_of(self.node, "base_position", f"{self.key}.position", self.reading, self.ledger)
        rotation = rotation_of(self.node, "base_orientation", f"{self.key}.orientation", self.reading, self.ledger)
        if position is not None:
            self.entry["position"] = position
        if rotation is not None and rotation.turns:
            self.entry["orientation"] = rotation.value

    def rest(self) -> None:
        """Report the keys that do not affect the world."""
        self.ledger.ignored(
            self.node.children.get("publish_ground_truth"),
            f"rig.world.pose({self.item.name!r}) returns it for every object",
        )
        self.ledger.ignored(self.node.children.get("class_dir"), "objects have no classes here")
        dynamics = self.node.get("dynamics")
        for name, leaf in (dynamics.children if dynamics is not None else {}).items():
            ours = _DYNAMICS.get(name)
            call = f"rig.world.set_dynamics({self.item.name!r}, {ours}={leaf.data})"
            self.ledger.ignored(leaf, f"not in a rig's file: {call}" if ours else "rig.world.set_dynamics has no such")


def import_object(item: ArkItem, work: ImportState) -> dict[str, Any]:
    """Convert an entry of ``objects``. Raises InvalidValue; the problem is noted."""
    thing = ObjectImport(item, work)
    source = work.reading.need(work.reading.keys(item.config), "source")
    if source.data == "urdf":
        thing.from_urdf()
    elif source.data == "primitive":
        thing.from_primitive()
    else:
        raise work.reading.wrong(
            source,
            f"must be urdf or primitive, not {describe(source.data)}; --without {item.given} leaves it out",
            "no_counterpart",
        )
    work.ledger.kept(source, f"{item.key}.shape")
    thing.place()
    thing.rest()
    return thing.entry


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two shapes are equal apart from their colour."""
    return {**one, "rgba": None} == {**other, "rgba": None}


_NOTHING = {
    "network": "there is no network: devices are used in the program that opens the rig",
    "other": "programs of one's own are ordinary programs here",
}
"""Ignored keys of the global file, with the reason."""


def import_simulator(root: ArkNode, reading: ArkReader, ledger: KeyReport) -> dict[str, Any]:
    """Return the rig's ``description`` and ``simulation``."""
    for key, why in _NOTHING.items():
        ledger.ignored(root.children.get(key), why)
    ledger.ignored(root.children.get("ground_plane"), "a floor is an object here: objects: [floor]")
    entries: dict[str, Any] = {"description": f"from Ark, {root.file.name}"}
    simulation: dict[str, Any] = {}
    node = root.get("simulator")
    if node is not None:
        reading.keys(node)
        name = node.get("name")
        if name is not None:
            entries["description"] = f"{reading.text(name)} (from Ark, {root.file.name})"
            ledger.changed(name, "description", "for readers only")
        engine = _engine(node, ledger)
        ledger.ignored(node.children.get("node_frequency"), "one clock drives everything; see simulation.physics_hz")
        ledger.ignored(
            node.children.get("save_render"),
            "no pictures are written beside the simulation; a camera of the rig has this view if you add one",
        )
        config = node.get("config")
        if config is not None:
            simulation = _config(reading.keys(config), reading, ledger)
        if engine is not None:
            simulation = {"engine": engine, **simulation}
    if simulation:
        entries["simulation"] = simulation
    return entries


def _engine(node: ArkNode, ledger: KeyReport) -> str | None:
    """Return the engine of the simulation; None where the rig need not name one."""
    backend = node.get("backend_type")
    if backend is not None and backend.data == ENGINES[0]:
        ledger.kept(backend, "", "simulation.engine: auto, which is PyBullet where it is installed, else MuJoCo")
    elif backend is not None and backend.data in ENGINES:
        ledger.kept(backend, "simulation.engine")
        return str(backend.data)
    else:
        ledger.changed(backend, "", f"the engines are {' and '.join(ENGINES)}; see simulation.engine")
    return None


def _config(node: ArkNode, reading: ArkReader, ledger: KeyReport) -> dict[str, Any]:
    simulation: dict[str, Any] = {}
    mode = node.get("connection_mode")
    if mode is not None and str(mode.data).upper() == "DIRECT":
        ledger.kept(mode, "", "no window opens")
    else:
        ledger.changed(mode, "", "there is no window: --viewer 3d shows the world in a browser")
    frequency = node.get("sim_frequency")
    if frequency is not None:
        simulation["physics_hz"] = reading.number(frequency, positive=True)
        ledger.kept(frequency, "simulation.physics_hz")
    gravity = node.get("gravity")
    if gravity is not None:
        simulation["gravity"] = reading.numbers(gravity, (3,))
        ledger.kept(gravity, "simulation.gravity")
    ledger.ignored(node.children.get("node_frequency"), "one clock drives everything; see simulation.physics_hz")
    ledger.ignored(node.children.get("urdf_dirs"), "was used to find URDFs; their paths are in the rig now")
    return simulation


ADJUSTABLE = "pinhole"
"""Camera model whose field of view the rig sets."""
CAPTURED = (640, 480)
"""An image size that every real camera with a model here has."""
DEFAULTS = {"width": 640, "height": 480, "frequency": 30, "fov": 60, "near_val": 0.1, "far_val": 100.0}
"""Ark's defaults. (For a real camera its frequency is 60.)"""
STREAMS = ("color", "depth", "infrared", "segmentation")
UP = {2: "z", 1: "y"}
OVER_THE_TOP = "over the top: the picture is upside down, as in Ark"


class CameraImport:
    """Converts one camera."""

    def __init__(self, item: ArkItem, work: ImportState) -> None:
        self.given = item.given
        self.node = item.config
        self.key = item.key
        self.reading = work.reading
        self.ledger = work.ledger
        options, node = work.options, item.config
        self.adjustable = options.camera_model == ADJUSTABLE
        self.entry: dict[str, Any] = {"model": options.camera_model}
        if self.adjustable:
            hint = "--camera-model realsense_d435 makes it a real one's" if "realsense" in _class(node) else ""
            self.entry["model"] = Commented(options.camera_model, f"Ark's angles, simulated only; {hint}".rstrip("; "))

    def kind(self) -> None:
        kind = self.reading.need(self.node, "type")
        if str(kind.data).lower() != "camera":
            raise self.reading.wrong(
                kind,
                f"a sensor of type {kind.data!r} has no counterpart; --without {self.given} leaves it out",
                "no_counterpart",
            )
        self.ledger.kept(kind, self.key)
        self.ledger.changed(self.node.get("class_dir"), f"{self.key}.model", "models and drivers are found by name")
        self.ledger.ignored(self.node.children.get("wait_time"), "a real camera is ready when its first frame has come")

    def size(self) -> None:
        width, height = (self._pixels(key) for key in ("width", "height"))
        rate = self._value(self.node, "frequency")
        if self.adjustable or width > CAPTURED[0] or height > CAPTURED[1]:
            self.entry["capture"] = Inline(width=width, height=height, rate_hz=rate)
            target, note = "capture", ""
        else:
            self.entry["capture"] = Inline(width=CAPTURED[0], height=CAPTURED[1], rate_hz=rate)
            self.entry["output"] = Commented(Inline(width=width, height=height), "centre crop and scaling")
            target, note = "output", "cut and scaled from a size that the camera has"
        for key in ("width", "height"):
            self.ledger.kept(self.node.get(key), f"{self.key}.{target}.{key}", note)
        self.ledger.kept(self.node.get("frequency"), f"{self.key}.capture.rate_hz", "in simulation, too")

    def _pixels(self, key: str) -> int:
        child = self.node.get(key)
        return self.reading.whole(child) if child is not None else int(DEFAULTS[key])

    def streams(self) -> None:
        node = self.reading.need(self.node, "streams")
        chosen: dict[str, Any] = {}
        for name, stream in self.reading.keys(node).children.items():
            if name not in STREAMS:
                raise self.reading.wrong(
                    stream, f"there is no such stream; streams: {', '.join(STREAMS)}", "unknown_stream"
                )
            enabled = self.reading.keys(stream).get("enable")
            form = stream.get("format")
            on = enabled is not None and self.reading.flag(enabled)
            target = f"{self.key}.streams"
            if not on:
                self.ledger.kept(enabled, target, "left out")
                self.ledger.ignored(form, "the stream is off")
                continue
            note = "rendered here; Ark renders none" if name == "infrared" else ""
            self.ledger.kept(enabled, target, note)
            chosen[name] = Inline(format=self.reading.text(form)) if form is not None else Inline()
            frames = {"color": "frames are RGB", "depth": "frames are in metres"}.get(name, "frames have 8 bits")
            where = "depends on the model" if self.adjustable else "what the real camera sends"
            self.ledger.changed(form, "" if self.adjustable else f"{target}.{name}", f"{where}; {frames} in any case")
        if not chosen:
            message = f"every stream is off; --without {self.given} leaves the camera out"
            raise self.reading.wrong(node, message, "missing_key")
        chosen = {name: chosen[name] for name in STREAMS if name in chosen}
        self.entry["streams"] = list(chosen) if self.adjustable else Inline(chosen)

    def optics(self, sim: ArkNode) -> None:
        fov, near, far = (self._value(sim, key) for key in ("fov", "near_val", "far_val"))
        if self.adjustable:
            self.entry["field_of_view"] = Inline(vertical_deg=fov)
            self.entry["depth"] = Commented(Inline(min=near, max=far), "m; 0 in a frame where it is nearer or farther")
            self.ledger.kept(sim.get("fov"), f"{self.key}.field_of_view.vertical_deg")
            self.ledger.changed(sim.get("near_val"), f"{self.key}.depth.min", "nearer depth is 0")
            self.ledger.changed(sim.get("far_val"), f"{self.key}.depth.max", "farther depth is 0")
        else:
            for key in ("fov", "near_val", "far_val"):
                self.ledger.ignored(sim.children.get(key), "from the camera's model")
        self.ledger.ignored(sim.children.get("visualize"), "cameras are not drawn")
        self.ledger.ignored(sim.children.get("urdf_path"), "cameras are not drawn")

    def fixed(self, fix: ArkNode) -> None:
        look = f"{self.key}.look_at"
        reading = self.reading
        target = reading.need(fix, "camera_target_position")
        place: dict[str, Any] = {"target": reading.numbers(target, (3,))}
        self.ledger.kept(target, f"{look}.target")
        distance = reading.need(fix, "distance")
        place["distance"] = reading.number(distance, positive=True)
        self.ledger.kept(distance, f"{look}.distance")
        comment = ""
        for key in ("yaw", "pitch", "roll"):
            angle = fix.get(key)
            place[f"{key}_deg"] = reading.number(angle) if angle is not None else 0
            over = key == "pitch" and 90.0 < abs(place["pitch_deg"]) % 360.0 < 270.0
            note = OVER_THE_TOP if over else ""
            comment = comment or note
            self.ledger.kept(angle, f"{look}.{key}_deg", note)
        up = fix.get("up_axis_index")
        axis = UP.get(reading.whole(up)) if up is not None else "z"
        if up is not None and axis is None:
            raise reading.wrong(up, "must be 2 (z) or 1 (y)", "invalid_choice")
        if axis != "z":
            place["up_axis"] = axis
        self.ledger.kept(up, f"{look}.up_axis")
        self.entry["look_at"] = Commented(Inline(place), comment) if comment else Inline(place)

    def attached(self, attach: ArkNode, arms: Mapping[str, ArkArm], all_arms: bool, objects: Collection[str]) -> None:
        reading, ledger, key = self.reading, self.ledger, f"{self.key}.attached"
        parent = reading.need(attach, "parent_name")
        name = reading.text(parent)
        if name not in arms and not all_arms:
            raise InvalidValue
        if name not in arms:
            what = "an object" if name in objects else "nothing that is imported"
            message = f"{name!r} is {what}; cameras are attached to robots only. --without {self.given}"
            raise reading.wrong(parent, message, "unknown_device")
        arm = arms[name]
        link = attach.get("parent_link")
        found = arm.place(reading.text(link) if link is not None else None)
        if found is None:
            message = f"robot {arm.given!r} has no link {link.data if link else None!r}"
            raise reading.wrong(link or attach, message, "unknown_link")
        at, pose, note = found
        if arm.name == arm.given:
            ledger.kept(parent, f"{key}.robot")
        else:
            ledger.changed(parent, f"{key}.robot", f"its name here is {arm.name}")
        moved = note or pose != Pose()
        (ledger.changed if moved else ledger.kept)(link, f"{key}.link", f"{at}; {note}".rstrip("; ") if moved else "")
        place: dict[str, Any] = {}
        if note:
            place["#note"] = Remark(note)
        place |= {"robot": arm.name, "link": at}
        place |= self._bracket(attach, pose, key)
        target = attach.get("rel_camera_target")
        direction = reading.numbers(target, (3,)) if target is not None else [1, 0, 0]
        if not any(direction):
            raise reading.wrong(target or attach, "is no direction", "out_of_range")
        place["target"] = direction
        along_up = not any(direction[:2])
        if not along_up:
            place["up"] = [0, 0, 1]
        ledger.kept(target, f"{key}.target", f"up is {'x: z is along it' if along_up else 'z, as in Ark'}")
        self.entry["attached"] = place

    def _bracket(self, attach: ArkNode, pose: Pose, key: str) -> dict[str, Any]:
        """``translation`` and ``rotation`` of the bracket; ``pose`` is the frame that Ark measures from."""
        reading, ledger = self.reading, self.ledger
        offset, turn = attach.get("offset_translation"), attach.get("offset_rotation")
        translation = reading.numbers(offset, (3,)) if offset is not None else [0, 0, 0]
        rotation = reading.rotation(turn) if turn is not None else [0, 0, 0]
        euler = len(rotation) == 3
        degrees = euler and max(map(abs, rotation)) > 6.3
        note = "beyond a full turn: check that these are not degrees; Ark reads them as rad" if degrees else ""
        if pose == Pose():
            ledger.kept(offset, f"{key}.translation")
            (ledger.changed if note else ledger.kept)(
                turn, f"{key}.rotation", note or ("Euler angles, rad" if euler else "a quaternion x, y, z, w")
            )
            found: dict[str, Any] = {"translation": translation}
            if degrees:  # a rig takes no more than a full turn
                rotation = tidy([math.remainder(angle, 2.0 * math.pi) for angle in rotation])
            return found | ({"rotation": rotation} if any(rotation[:3]) else {})
        matrix = rpy_to_matrix(*rotation) if euler else quaternion_to_matrix(rotation)
        bracket = pose @ Pose(translation, matrix_to_quaternion(matrix))
        ledger.changed(offset, f"{key}.translation", "added to the position of Ark's link in that frame")
        ledger.changed(turn, f"{key}.rotation", "; ".join(filter(None, ["added to the rotation of Ark's link", note])))
        return {
            "translation": Commented(tidy(bracket.position.tolist()), f"Ark: {translation} from its link"),
            "rotation": Commented(tidy(bracket.orientation.tolist()), f"x, y, z, w; Ark: {rotation}"),
        }

    def _value(self, node: ArkNode, key: str) -> float | int:
        """A number of Ark's file, or Ark's default."""
        child = node.get(key)
        return self.reading.number(child, positive=True) if child is not None else DEFAULTS[key]


def import_camera(item: ArkItem, work: ImportState, arms: Mapping[str, ArkArm], all_arms: bool) -> dict[str, Any]:
    """Convert an entry of ``sensors``. Raises InvalidValue; the problem is noted.

    Args:
        item: The entry.
        work: State of the import.
        arms: Converted robots by their names in Ark's files.
        all_arms: Whether all robots could be converted.
    """
    reading, ledger, node = work.reading, work.ledger, work.reading.keys(item.config)
    camera = CameraImport(item, work)
    camera.kind()
    camera.size()
    camera.streams()
    sim = reading.keys(reading.need(node, "sim_config"))
    camera.optics(sim)
    kind = node.get("camera_type")
    fix, attach = sim.get("fix"), sim.get("attach")
    word = kind.data if kind is not None else "attached" if attach is not None else "fixed"
    if word == "fixed":
        ledger.kept(kind, f"{camera.key}.look_at")
        camera.fixed(reading.keys(reading.need(sim, "fix")))
        ledger.ignored(attach, "camera_type is fixed")
    elif word == "attached":
        ledger.kept(kind, f"{camera.key}.attached")
        camera.attached(reading.keys(reading.need(sim, "attach")), arms, all_arms, work.given["objects"])
        ledger.ignored(fix, "camera_type is attached")
    else:
        raise reading.wrong(kind or node, f"must be fixed or attached, not {word!r}", "invalid_choice")
    return camera.entry


def _class(node: ArkNode) -> str:
    folder = node.get("class_dir")
    return str(folder.data).lower() if folder is not None else ""
