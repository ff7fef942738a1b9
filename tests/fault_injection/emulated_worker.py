"""Run cases of ``tests.fault_injection.emulated_matrix`` in a process that a vendor's library may crash.

``python -m tests.fault_injection.emulated_worker ADDRESS`` reads a case from each line of its standard input and
writes the result as JSON. Addresses of emulators count up from ADDRESS.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from tests.fault_injection.emulated_matrix import Bench, Place


def main() -> None:
    """Run cases until the input ends."""
    # Output of libraries is kept apart from the results.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with tempfile.TemporaryDirectory(prefix="touchcell-faults-") as folder:
        bench = Bench(Path(folder), int(sys.argv[1]))
        for line in sys.stdin:
            print(json.dumps(asdict(bench.run(Place(**json.loads(line))))), file=answers, flush=True)


if __name__ == "__main__":
    main()
