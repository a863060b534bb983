"""What the controls of a pad do in an app: the mapping that was asked for, or the one that the pad is meant for."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hal.deadman import Deadman
    from hal.gamepad import Gamepad
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.teleop import Teleop

__all__ = ["Steering"]


class Steering:
    """The mapping of a pad, which changes with the pad: a SpaceMouse may be plugged in where a gamepad was before."""

    teleop: Teleop
    deadman: Deadman
    mapping = ""

    def __init__(
        self, rig: Rig, robot: Robot, pad: Gamepad, asked: str | None, speed: float, actions: tuple[str, ...] = ()
    ) -> None:
        """``asked`` is the mapping that a person wants, whatever the pad is; ``actions`` are those of the mapping that
        the app knows. Raises ConfigError for a bad mapping."""
        self._rig, self._robot, self._pad, self._asked, self._speed = rig, robot, pad, asked, speed
        self._actions = actions
        self.take()

    def _wanted(self) -> str:
        """While no pad is there, the one before."""
        if self._asked or (self.mapping and not self._pad.state().connected):
            return self._asked or self.mapping
        return self._pad.mapping or "default"

    @property
    def is_due(self) -> bool:
        """Was a pad plugged in that is meant for another mapping?"""
        return self._wanted() != self.mapping

    def distrust(self) -> str:
        """Why that pad may not drive this arm; nothing where it may."""
        spec = self._robot.spec
        return (self._pad.distrust() or "") if spec.attended and not spec.emulated else ""

    def take(self) -> None:
        """Use the mapping that is due. Its dead-man must be let go of and pressed before it counts."""
        import hal

        self.mapping = self._wanted()
        self.teleop = hal.Teleop(self._robot, mapping=self.mapping, speed=self._speed)
        self.deadman = self._pad.hold(self.teleop.mapping.deadman)
        if self._rig.console is not None:
            self._rig.console.explain(self.teleop.labels(actions=("home", *self._actions)))

    def help(self) -> str:
        """For people, some lines."""
        about = self.teleop.mapping.description
        drives = [f"drives {self._robot.name}"] if len(self._rig.robots) > 1 else []
        lines = [*drives, f"mapping {self.mapping}{': ' if about else ''}{about}", *self.teleop.help(self._pad)]
        return "\n".join(f"  {line}" for line in lines)
