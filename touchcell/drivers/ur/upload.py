"""``python -m touchcell.drivers.ur.upload HOST``: send ur-rtde's control program to a controller, then exit.

ur-rtde's control interface reconnects by itself and races its own threads, and its destructor sleeps half a second with
the interpreter's lock held. Here the kernel takes its threads and sockets away when the upload is done.
"""

from __future__ import annotations

import os
import sys


def main(host: str) -> None:
    """Clear the command register, upload, and end; what went wrong goes to standard error with exit code 1.

    The register is cleared first, for it outlives programs and clients: a program that starts while it still says
    speedL would move at once. ur-rtde's control interface does that on construction.
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
