"""``python -m drivers.emulators NAME ...``, which is ``touchcell emulate NAME ...``."""

from __future__ import annotations

import sys

from drivers.emulators.launcher import main

sys.exit(main(sys.argv[1:]))
