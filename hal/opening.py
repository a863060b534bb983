"""``hal.open``: read a rig's configuration and open its devices.

The first process of a rig in real time is started before this one imports anything large: both do so at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .host.process import drop_prepared, prepare_host

if TYPE_CHECKING:
    from .rig import Rig


def open_rig(
    config: str | Path | Mapping[str, Any] = "panda_table",
    *,
    sim: bool | None = None,
    driver: str | None = None,
    clock: str | None = None,
    engine: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    pad: str | None = None,
    viewer: str = "none",
    console: bool = False,
    listen: str | None = None,
    realtime: bool = True,
) -> Rig:
    """Open a rig. Nothing moves.

    Args:
        config: Path of a rig file, name of a built-in rig, or a dict of the same structure.
        sim: True simulates every device, False makes every device real; None keeps the flags of the rig file.
        driver: Driver that replaces those of all devices; ``"mock"`` needs no devices and no simulation.
        clock: ``"real_time"`` or ``"lock_step"``; None keeps that of the rig file.
        engine: Engine of the simulated world: ``"pybullet"``, ``"mujoco"``, or ``"auto"`` for the first of them that is
            installed; None keeps that of the rig file. :attr:`~hal.specs.Plan.engine` of :attr:`Rig.plan` names it.
        overrides: Values for keys of the rig file, as ``KEY=VALUE`` strings or a mapping.
        pad: Device behind a pad of ``model: auto``: ``auto``, ``evdev``, ``web`` (the console), ``terminal``, ``demo``
            (a recorded tour), the path of a recording, or ``none`` for no pad.
        viewer: ``"gui"`` opens a window with the simulated world, ``"3d"`` serves a page with the arms in 3D.
        console: Serve the console, even if another pad drives.
        listen: Address and port of the console, ``ADDRESS[:PORT]``; this computer only by default.
        realtime: Request real-time scheduling (SCHED_FIFO) and locked memory for the servos in real time; if they are
            refused, :attr:`Rig.notes` has the remedy.

    Returns:
        The rig; close it, or use it in a ``with`` statement.

    Raises:
        ConfigError: The rig file is wrong; lists every problem.
        CommandError: An argument is wrong.
        DriverMissing: A library is not installed; the message has the command that installs it.
        DeviceNotFound: No such device.
        ConnectionLost: A device does not answer.
        NotSupported: A viewer or a console that this rig cannot have.
    """
    if clock == "real_time" or (clock is None and driver is None):
        prepare_host()
    try:
        from .config import load
        from .rig import Rig
        from .views import Listen

        where = Listen.parse(listen)
        plan = load(config, sim=sim, driver=driver, clock=clock, engine=engine, overrides=overrides).resolve()
        rig = Rig(plan)
        with rig._close_if_it_fails():
            rig._open(pad=pad, viewer=viewer, console=console, listen=where, realtime=realtime)
        return rig
    finally:
        drop_prepared()
