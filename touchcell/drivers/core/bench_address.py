"""Addresses that lead to no device of a bench."""

from __future__ import annotations

import ipaddress
import os
from contextlib import suppress

PSEUDO_TERMINALS = "/dev/pts/"
VIRTUAL_CAN = ("vcan", "vxcan")


def is_this_machine(host: str) -> bool:
    """Return whether a host name or an IP address is this machine's loopback, where emulators listen."""
    if host.lower().rstrip(".") in ("localhost", "localhost.localdomain", "ip6-localhost", "ip6-loopback"):
        return True
    with suppress(ValueError):
        address = ipaddress.ip_address(host)
        return address.is_loopback or address.is_unspecified
    return False


def is_pseudo_terminal(port: str) -> bool:
    """Return whether a serial port, or what it links to, is a pseudo-terminal of this machine."""
    return os.path.realpath(port).startswith(PSEUDO_TERMINALS)


def is_virtual_can(interface: str, channel: str) -> bool:
    """Return whether a CAN channel of python-can is a virtual bus of this machine."""
    if interface == "socketcan":
        return channel.startswith(VIRTUAL_CAN)
    return interface in ("virtual", "udp_multicast", "touchcell_hub")
