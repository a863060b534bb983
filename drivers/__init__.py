"""Backends: one folder per kind of device, imported only by name through :mod:`hal.registry`."""

import os

__path__ = [os.path.realpath(folder) for folder in __path__]  # as in hal/__init__.py
