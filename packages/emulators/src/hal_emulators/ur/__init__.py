"""Emulated controller of a Universal Robots arm, for the unmodified ur_rtde. See docs/ur.md."""
