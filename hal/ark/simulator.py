"""Ark's ``simulator`` section, and what else stands at the top of its global file."""

from __future__ import annotations

from typing import Any

from .ledger import Ledger
from .reading import Node, Reading

__all__ = ["import_simulator"]

_NOTHING = {
    "network": "there is no network: devices are used in the program that opens the rig",
    "other": "programs of one's own are ordinary programs here",
}
"""Keys of the global file."""


def import_simulator(root: Node, reading: Reading, ledger: Ledger) -> dict[str, Any]:
    """The rig's ``description`` and ``simulation``."""
    for key, why in _NOTHING.items():
        ledger.nothing(root.children.get(key), why)
    ledger.nothing(root.children.get("ground_plane"), "a floor is an object here: objects: [floor]")
    entries: dict[str, Any] = {"description": f"from Ark, {root.file.name}"}
    simulation: dict[str, Any] = {}
    node = root.get("simulator")
    if node is not None:
        reading.keys(node)
        name = node.get("name")
        if name is not None:
            entries["description"] = f"{reading.text(name)} (from Ark, {root.file.name})"
            ledger.changed(name, "description", "for people; nothing is called by it")
        _backend(node, ledger)
        ledger.nothing(node.children.get("node_frequency"), "one clock drives everything; see simulation.physics_hz")
        ledger.nothing(
            node.children.get("save_render"),
            "no pictures are written beside the simulation; a camera of the rig has this view if you add one",
        )
        config = node.get("config")
        if config is not None:
            simulation = _config(reading.keys(config), reading, ledger)
    if simulation:
        entries["simulation"] = simulation
    return entries


def _backend(node: Node, ledger: Ledger) -> None:
    backend = node.get("backend_type")
    if backend is not None and backend.data == "pybullet":
        ledger.kept(backend, "", "PyBullet, as every model's drivers.sim says")
    else:
        ledger.changed(backend, "", "PyBullet simulates here")


def _config(node: Node, reading: Reading, ledger: Ledger) -> dict[str, Any]:
    simulation: dict[str, Any] = {}
    mode = node.get("connection_mode")
    if mode is not None and str(mode.data).upper() == "DIRECT":
        ledger.kept(mode, "", "no window opens unless --viewer gui asks for one")
    else:
        ledger.changed(mode, "", "a window is not part of a rig: --viewer gui opens it, in a process of its own")
    frequency = node.get("sim_frequency")
    if frequency is not None:
        simulation["physics_hz"] = reading.number(frequency, positive=True)
        ledger.kept(frequency, "simulation.physics_hz")
    gravity = node.get("gravity")
    if gravity is not None:
        simulation["gravity"] = reading.numbers(gravity, (3,))
        ledger.kept(gravity, "simulation.gravity")
    ledger.nothing(node.children.get("node_frequency"), "one clock drives everything; see simulation.physics_hz")
    ledger.nothing(node.children.get("urdf_dirs"), "was used to find URDFs; their paths are in the rig now")
    return simulation
