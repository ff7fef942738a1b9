"""``python -m touchcell.testing.emulation NAME ...``, which is ``touchcell emulate NAME ...``."""

from __future__ import annotations

import sys

from touchcell.errors import TouchcellError
from touchcell.testing.emulation.launcher import main

try:
    sys.exit(main(sys.argv[1:]))
except TouchcellError as error:
    sys.exit(f"touchcell emulate: {error}")
