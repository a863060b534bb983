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
        self,
        rig: Rig,
        robot: Robot,
        pad: Gamepad,
        asked: str | None,
        speed: float,
        actions: tuple[str, ...] = (),
        settings: tuple[str, ...] = (),
    ) -> None:
        """Use the mapping that is due now.

        Args:
            asked: The mapping that the user wants, whatever the pad is.
            speed: Share of the mapping's speeds; the console cannot exceed it.
            actions: Those of the mapping that the app knows.
            settings: Those of ``hal.views.SETTINGS`` that the console may change.

        Raises:
            ConfigError: For a bad mapping.
        """
        self._rig, self._robot, self._pad, self._asked = rig, robot, pad, asked
        self._speed = self._speed_max = speed
        self._actions, self._settings = actions, settings
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
        """Use the mapping that is due. Its dead-man must be released and pressed before it counts."""
        import hal

        self.mapping = self._wanted()
        self.teleop = hal.Teleop(self._robot, mapping=self.mapping, speed=self._speed)
        self.deadman = self._pad.hold(self.teleop.mapping.deadman)
        self._show()

    def drive(self, robot: Robot) -> None:
        """Drive this arm from the next session on."""
        self._robot = robot
        self.take()

    def set_speed(self, speed: float) -> None:
        """Drive at this share of the mapping's speeds, or at the greatest one that is allowed."""
        self._speed = self.teleop.speed = min(speed, self._speed_max)
        self._show()

    def set_frame(self, frame: str) -> None:
        """Move along the axes of the arm's base, or of its tool."""
        self.teleop.frame = "tcp" if frame == "tcp" else "base"
        self._show()

    def _show(self) -> None:
        """Show on the console's pages which arm is driven, and what the controls do."""
        from hal.views import DrivingView

        console, teleop = self._rig.console, self.teleop
        if console is None:
            return
        console.explain(teleop.labels(actions=("home", *self._actions)))
        view = DrivingView(self._robot.name, teleop.speed, self._speed_max, teleop.frame, self._settings)
        console.show_driving(view)

    def help(self) -> str:
        """For people, some lines."""
        about = self.teleop.mapping.description
        drives = [f"drives {self._robot.name}"] if len(self._rig.robots) > 1 else []
        lines = [*drives, f"mapping {self.mapping}{': ' if about else ''}{about}", *self.teleop.help(self._pad)]
        return "\n".join(f"  {line}" for line in lines)
