"""The programs."""

import os

__path__ = [os.path.realpath(folder) for folder in __path__]  # as in hal/__init__.py
