"""``python -m touchcell``: the command line."""

import sys

from touchcell.cell.cli.main import main

sys.exit(main())
