"""Emulator of Robotiq grippers, on a pseudo terminal or the text port of a UR's controller."""
