"""Simulated scenes without physics: what a world checks, what is drawn of it, the cameras in it, their pictures.

No driver of its own: this is the one package that drivers with a physics engine may import. An engine implements
:class:`~hal.drivers.scene.world.SimulatedWorld`; everything that is drawn comes from the rig's records and from the
snapshots of that world.
"""
