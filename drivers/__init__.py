"""Backends: one folder per kind of device, imported only by name through :mod:`hal.registry`."""
