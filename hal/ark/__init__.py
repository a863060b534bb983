"""Coming from Ark: its configuration files made into a rig's file, with an account of every key.

``reading`` knows Ark's YAML and where each key stands, ``ledger`` what became of it, ``places`` where Ark finds files.
``simulator``, ``arms`` (with ``real_config``), ``sensors`` and ``things`` make a rig's entries of its sections.
``known`` has facts about arms that the hal has, ``arm_model`` makes a model for another one, ``links`` reads its URDF.
``text`` writes YAML that a person can read, and ``importing`` does all of it.
"""

from .importing import Imported, import_ark
from .options import Options

__all__ = ["Imported", "Options", "import_ark"]
