"""Emulator of the other side of every CAN arm in a rig: ``python -m hal.drivers.can.emulator --help``."""
