"""The program ``hal emulate`` as a module: ``python -m hal_emulators --config RIG``."""

import sys

from .program import main

sys.exit(main())
