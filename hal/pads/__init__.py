"""Gamepads below :class:`hal.Gamepad`: models as data, conversion of events into controls, and the choice of a pad."""
