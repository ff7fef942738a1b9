"""``python -m touchcell.drivers.ur.upload HOST``: send ur-rtde's control program to a controller, then exit.

ur-rtde's control interface reconnects by itself and has races between its threads, and its destructor sleeps half a
second with the GIL held. In a process of its own the kernel cleans up its threads and sockets after the upload.
"""

from __future__ import annotations

import os
import sys


def main(host: str) -> None:
    """Clear the command register, upload, and exit; an error goes to standard error with exit code 1.

    The register is cleared first, because it outlives programs and clients: a program that starts while it still holds
    speedL would move at once. ur-rtde's control interface clears it on construction.
    """
    from rtde_control import RTDEControlInterface

    try:
        control = RTDEControlInterface(host, flags=RTDEControlInterface.FLAG_NO_WAIT)
        control.reuploadScript()
    except RuntimeError as error:
        print(error, file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1])
