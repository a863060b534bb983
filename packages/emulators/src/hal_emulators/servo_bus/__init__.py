"""Emulated arms with servos on a serial bus: pseudo terminals with the names of their ports."""
