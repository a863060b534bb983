"""Ark's sensors: cameras, fixed in the world or attached to a link."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from ..geometry import Pose, matrix_to_quaternion, quaternion_to_matrix, rpy_to_matrix
from .arms import Arm
from .items import Item, Work
from .posing import tidy
from .reading import Node, Wrong
from .text import Commented, Inline, Remark

__all__ = ["import_camera"]

ADJUSTABLE = "pinhole"
"""The model that leaves its angles to the rig."""
CAPTURED = (640, 480)
"""A size that every real camera with a model here has."""
DEFAULTS = {"width": 640, "height": 480, "frequency": 30, "fov": 60, "near_val": 0.1, "far_val": 100.0}
"""Ark's, where its file says nothing. (A real camera's frequency is 60 there.)"""
STREAMS = ("color", "depth", "infrared", "segmentation")
UP = {2: "z", 1: "y"}
OVER_THE_TOP = "over the top: the picture is upside down, as in Ark"


class Camera:
    """One camera on its way into ``cameras``."""

    def __init__(self, item: Item, work: Work) -> None:
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
                kind, f"a sensor of type {kind.data!r} has no counterpart; --without {self.given} leaves it out"
            )
        self.ledger.kept(kind, self.key)
        self.ledger.changed(self.node.get("class_dir"), f"{self.key}.model", "models and drivers are found by name")
        self.ledger.nothing(self.node.children.get("wait_time"), "a real camera is ready when its first frame has come")

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
                raise self.reading.wrong(stream, f"there is no such stream; there are {', '.join(STREAMS)}")
            enabled = self.reading.keys(stream).get("enable")
            form = stream.get("format")
            on = enabled is not None and self.reading.flag(enabled)
            target = f"{self.key}.streams"
            if not on:
                self.ledger.kept(enabled, target, "left out")
                self.ledger.nothing(form, "the stream is off")
                continue
            note = "drawn here; Ark draws none" if name == "infrared" else ""
            self.ledger.kept(enabled, target, note)
            chosen[name] = Inline(format=self.reading.text(form)) if form is not None else Inline()
            frames = {"color": "a frame is RGB", "depth": "a frame has metres"}.get(name, "a frame has 8 bits")
            where = "the model's business" if self.adjustable else "what the real camera sends"
            self.ledger.changed(
                form, "" if self.adjustable else f"{target}.{name}", f"{where}; {frames} whatever it is"
            )
        if not chosen:
            raise self.reading.wrong(node, f"every stream is off; --without {self.given} leaves the camera out")
        chosen = {name: chosen[name] for name in STREAMS if name in chosen}
        self.entry["streams"] = list(chosen) if self.adjustable else Inline(chosen)

    def optics(self, sim: Node) -> None:
        fov, near, far = (self._value(sim, key) for key in ("fov", "near_val", "far_val"))
        if self.adjustable:
            self.entry["field_of_view"] = Inline(vertical_deg=fov)
            self.entry["depth"] = Commented(Inline(min=near, max=far), "m; 0 in a frame where it is nearer or farther")
            self.ledger.kept(sim.get("fov"), f"{self.key}.field_of_view.vertical_deg")
            self.ledger.changed(sim.get("near_val"), f"{self.key}.depth.min", "depth is 0 where it is nearer")
            self.ledger.changed(sim.get("far_val"), f"{self.key}.depth.max", "depth is 0 where it is farther")
        else:
            for key in ("fov", "near_val", "far_val"):
                self.ledger.nothing(sim.children.get(key), "the camera's own, simulated or real: its model has it")
        self.ledger.nothing(sim.children.get("visualize"), "cameras are not drawn")
        self.ledger.nothing(sim.children.get("urdf_path"), "cameras are not drawn")

    def fixed(self, fix: Node) -> None:
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
            raise reading.wrong(up, "must be 2 (z) or 1 (y)")
        if axis != "z":
            place["up_axis"] = axis
        self.ledger.kept(up, f"{look}.up_axis")
        self.entry["look_at"] = Commented(Inline(place), comment) if comment else Inline(place)

    def attached(self, attach: Node, arms: Mapping[str, Arm], all_arms: bool, objects: Collection[str]) -> None:
        reading, ledger, key = self.reading, self.ledger, f"{self.key}.attached"
        parent = reading.need(attach, "parent_name")
        name = reading.text(parent)
        if name not in arms and not all_arms:
            raise Wrong
        if name not in arms:
            what = "an object" if name in objects else "nothing that is imported"
            raise reading.wrong(parent, f"{name!r} is {what}; a camera goes on a robot here. --without {self.given}")
        arm = arms[name]
        link = attach.get("parent_link")
        found = arm.place(reading.text(link) if link is not None else None)
        if found is None:
            raise reading.wrong(link or attach, f"robot {arm.given!r} has no link {link.data if link else None!r}")
        at, pose, note = found
        if arm.name == arm.given:
            ledger.kept(parent, f"{key}.robot")
        else:
            ledger.changed(parent, f"{key}.robot", f"it is called {arm.name} here")
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
            raise reading.wrong(target or attach, "is no direction")
        place["target"] = direction
        along_up = not any(direction[:2])
        if not along_up:
            place["up"] = [0, 0, 1]
        ledger.kept(target, f"{key}.target", f"up is {'x: z lies along it' if along_up else 'z, as in Ark'}")
        self.entry["attached"] = place

    def _bracket(self, attach: Node, pose: Pose, key: str) -> dict[str, Any]:
        """``translation`` and ``rotation`` of the bracket, ``pose`` being where Ark counts from."""
        reading, ledger = self.reading, self.ledger
        offset, turn = attach.get("offset_translation"), attach.get("offset_rotation")
        translation = reading.numbers(offset, (3,)) if offset is not None else [0, 0, 0]
        rotation = reading.rotation(turn) if turn is not None else [0, 0, 0]
        euler = len(rotation) == 3
        degrees = euler and max(map(abs, rotation)) > 6.3
        note = "beyond a full turn: were these degrees? Ark takes them for rad, too" if degrees else ""
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
        ledger.changed(offset, f"{key}.translation", "added to where Ark's link is in that frame")
        ledger.changed(turn, f"{key}.rotation", "; ".join(filter(None, ["added to how Ark's link is turned", note])))
        return {
            "translation": Commented(tidy(bracket.position.tolist()), f"Ark: {translation} from its link"),
            "rotation": Commented(tidy(bracket.orientation.tolist()), f"x, y, z, w; Ark: {rotation}"),
        }

    def _value(self, node: Node, key: str) -> float | int:
        """A number of Ark's file, or what Ark takes where there is none."""
        child = node.get(key)
        return self.reading.number(child, positive=True) if child is not None else DEFAULTS[key]


def import_camera(item: Item, work: Work, arms: Mapping[str, Arm], all_arms: bool) -> dict[str, Any]:
    """An entry of ``cameras``. Raises Wrong; the problem is noted.

    ``arms`` are by their names in Ark's files. Without ``all_arms`` something is wrong with others, which is noted.
    """
    reading, ledger, node = work.reading, work.ledger, work.reading.keys(item.config)
    camera = Camera(item, work)
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
        ledger.nothing(attach, "camera_type says that the camera is fixed")
    elif word == "attached":
        ledger.kept(kind, f"{camera.key}.attached")
        camera.attached(reading.keys(reading.need(sim, "attach")), arms, all_arms, work.given["objects"])
        ledger.nothing(fix, "camera_type says that the camera is attached")
    else:
        raise reading.wrong(kind or node, f"must be fixed or attached, not {word!r}")
    return camera.entry


def _class(node: Node) -> str:
    folder = node.get("class_dir")
    return str(folder.data).lower() if folder is not None else ""
