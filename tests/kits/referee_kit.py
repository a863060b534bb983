"""The same run on each engine of the simulated world, to compare them: the recorded tour of a gamepad."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hal
from hal.config.data_files import find_data
from hal.geometry import Pose

TOUR = str(find_data("config", "teleop/tour.jsonl"))
RATE_HZ = 50


@dataclass(frozen=True)
class TourRun:
    """What the tour did on one engine, in lock-step."""

    q_set: NDArray[np.float64]
    """Set-points of the arm, tick by tick (N, 7), rad."""
    q: NDArray[np.float64]
    """Joint positions at every command (M, 7), rad."""
    width: NDArray[np.float64]
    """Width of the gripper at every command (M,), m."""
    ticks: NDArray[np.int64]
    """Number of set-points so far at every command (M,)."""
    releases: tuple[float, ...]
    """Speed of the fastest joint at each release of the dead-man, rad/s."""
    touched: int | None
    """Set-points before the arm first touched anything; None if it never did."""
    end: Pose
    """Pose of the tcp at the end, in the arm's base frame."""

    @property
    def lag(self) -> float:
        """Largest distance of a joint from its set-point, rad."""
        sent = self.ticks > 0
        return float(np.abs(self.q[sent] - self.q_set[self.ticks[sent] - 1]).max())


def drive_tour(engine: str, *overrides: str, config: Any = "panda_table") -> TourRun:
    """Drive a rig by the recorded tour in lock-step."""
    setpoints: list[Any] = []
    q, width, ticks = [], [], []
    touched: int | None = None
    releases, held = [], False
    with hal.open(
        config, sim=True, engine=engine, clock="lock_step", pad=TOUR, overrides=["cameras={}", *overrides]
    ) as rig:
        driver, arm, pad = rig.driver("panda"), rig.robots["panda"], rig.gamepads["pad"]
        write = driver.write

        def note(setpoint: Any) -> Any:
            setpoints.append(setpoint.q)
            return write(setpoint)

        driver.write = note
        teleop = hal.Teleop(arm)
        deadman = pad.hold(teleop.mapping.deadman)
        with arm.control(deadman=deadman, rate_hz=RATE_HZ) as control:
            for tick in rig.clock.rate(RATE_HZ):
                motion, grip = teleop.step(pad.state(), tick.dt)
                control.send(motion, grip=grip)
                state = arm.state()
                if held and not deadman.held:
                    releases.append(float(abs(state.dq_set).max()))
                held = deadman.held
                q.append(state.q)
                width.append(arm.gripper.state().width if arm.gripper is not None else 0.0)
                ticks.append(len(setpoints))
                if touched is None and any(found.a != found.b for found in rig.world.contacts("panda")):
                    touched = len(setpoints)
                if pad.finished:
                    break
        end = arm.state().tcp
    return TourRun(np.array(setpoints), np.array(q), np.array(width), np.array(ticks), tuple(releases), touched, end)


def draw_state(engine: str, state: dict[str, Any] | None = None) -> tuple[dict[str, hal.Frame], dict[str, Any]]:
    """Draw a rig in lock-step with all its cameras.

    Args:
        engine: Name of the engine.
        state: Where the arm and the objects are; None for where a motion takes them on this engine.

    Returns:
        The frames by camera, and the state that they show.
    """
    with hal.open("panda_table", sim=True, engine=engine, clock="lock_step", pad="none") as rig:
        arm, world = rig.robots["panda"], rig.world
        if state is None:
            rig.clock.sleep(0.5)
            arm.move_to(arm.home + 0.2, speed=0.5)
            state = {"q": arm.state().q, **{name: world.pose(name) for name in ("cube", "duck")}}
        world.reset("panda", q=state["q"])
        for name in ("cube", "duck"):
            world.set_pose(name, state[name])
        return {name: camera.read() for name, camera in rig.cameras.items()}, state
