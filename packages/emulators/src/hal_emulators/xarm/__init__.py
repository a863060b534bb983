"""Emulated control box of a UFACTORY arm, for the unmodified xarm-python-sdk. See docs/xarm.md."""
