"""A rig's configuration: read, checked as a whole, and resolved into a :class:`~hal.specs.Plan`.

``rigfile`` says what a rig's file may hold, ``models`` and ``objects`` what the files that it names may; ``load`` reads
them and ``resolve`` makes of them what drivers are made from. One ConfigError tells everything that is wrong.
"""

from .loader import RigConfig, load

__all__ = ["RigConfig", "load"]
