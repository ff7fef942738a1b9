"""``python -m touchcell.cell.ui.beside FOLDER PORT``: the page of one run, while its parent process lives."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from touchcell.cell.runtime.child_processes import end_all
from touchcell.errors import ConfigError, TouchcellError

_END_S: Final = 3.0


@contextmanager
def page_beside(folder: Path, port: int, *, moves: bool = False) -> Iterator[None]:
    """Serve the page of a run from a process of its own within the context; it prints its address itself.

    Args:
        folder: of the run.
        port: on the loopback interface.
        moves: whether the page moves the arms: what is held on it then waits for no other process.

    Raises:
        ConfigError: NiceGUI is not installed.
    """
    from importlib.util import find_spec

    if find_spec("nicegui") is None:
        raise ConfigError("needs nicegui, which is not installed", key="--ui", hint="pip install 'touchcell[ui]'")
    command = [
        sys.executable,
        "-m",
        "touchcell.cell.ui.beside",
        str(folder),
        str(port),
        *(["--moves"] if moves else []),
    ]
    # In a session of its own, Ctrl-C in the terminal reaches the run alone.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        yield
    finally:
        end_all([process], _END_S)


def main() -> int:
    """Serve until the parent has gone."""
    from touchcell.cell.ui.server import NICE, serve_page

    parent, folder = os.getppid(), Path(sys.argv[1])
    nice = 0 if "--moves" in sys.argv else NICE

    def orphaned() -> bool:
        return os.getppid() != parent

    def ready(address: str) -> None:
        print(f"page: {address}", flush=True)

    try:
        serve_page(folder.parent, int(sys.argv[2]), ready, run=folder.name, until=orphaned, nice=nice)
    except TouchcellError as error:
        print(f"no page: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
