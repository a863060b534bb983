"""Import of configuration files of Ark (2025) as a rig's file, with a report of every key.

``reading`` reads Ark's YAML with line numbers, ``entries`` lists its robots, sensors and objects, ``robots`` (with
``arm_model`` for arms without a model here) and ``scene`` (cameras, objects, simulator) convert them, ``output`` writes
the rig's YAML and the report, ``importing`` runs the import, and ``program`` is the command ``hal import-ark``.
"""

from .entries import ArkOptions
from .importing import Imported, import_ark

__all__ = ["ArkOptions", "Imported", "import_ark"]
