"""Emulator of the other side of every CAN arm in a rig: ``hal emulate can --help``."""
