"""Mass, inertia, friction and stiffness of links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .contacts import contact_parameters
from .engine import Body

_FRICTIONS = ("lateral_friction", "rolling_friction", "spinning_friction")
_CONTACT = (*_FRICTIONS, "restitution", "contact_stiffness", "contact_damping")


def read_dynamics(model: Any, body: Body, link: int) -> dict[str, Any]:
    """Return those of :data:`~hal.drivers.scene.values.DYNAMICS` that MuJoCo has."""
    number = body.ids[link]
    values: dict[str, Any] = {name: getattr(body.contacts[link], name) for name in _CONTACT}
    values["mass"] = float(model.body_mass[number])
    values["inertia"] = model.body_inertia[number].tolist()
    return values


def write_dynamics(spec: Any, body: Body, link: int, values: Mapping[str, Any]) -> None:
    """Set some of the values of :func:`read_dynamics`, by name, in the ``mujoco.MjSpec``."""
    contact, node = body.contacts[link], spec.body(body.link_path(link))
    node.mass = values.get("mass", node.mass)
    node.inertia = values.get("inertia", node.inertia)
    for name in _CONTACT:
        if name in values:
            setattr(contact, name, values[name])
    parameters = contact_parameters(contact, node.mass, spec.option.timestep)._asdict()
    for shape in range(body.solids[link]):
        for name, value in parameters.items():
            setattr(spec.geom(f"{body.link_path(link)}/{shape}"), name, value)
