"""``python -m touchcell.testing.emulation NAME ...``, which is ``touchcell emulate NAME ...``."""

from __future__ import annotations

import sys

from touchcell.testing.emulation.launcher import main

sys.exit(main(sys.argv[1:]))
