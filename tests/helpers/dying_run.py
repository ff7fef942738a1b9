"""``python -m tests.helpers.dying_run MESSAGES SIGNAL CELL OUT``: a run that is ended by a signal of its own.

The signal comes once the black box has taken MESSAGES messages, so that no clock decides when.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

from touchcell.cell.cli.main import main
from touchcell.cell.recording.message_types import Encoded
from touchcell.cell.runtime.black_box import BlackBox


def run(messages: int, number: signal.Signals, cell: str, out: str) -> int:
    """Run the cell until the signal."""
    add = BlackBox.add
    count = 0

    def add_and_die(box: BlackBox, added: Sequence[tuple[str, int, Encoded]]) -> None:
        nonlocal count
        add(box, added)
        count += len(added)
        if count >= messages:
            os.kill(os.getpid(), number)

    BlackBox.add = add_and_die  # type: ignore[assignment, method-assign]
    return main(["run", cell, "--out", out, "--quiet"])


if __name__ == "__main__":
    sys.exit(run(int(sys.argv[1]), signal.Signals[sys.argv[2]], sys.argv[3], sys.argv[4]))
