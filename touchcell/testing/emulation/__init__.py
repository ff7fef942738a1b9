"""Devices that exist only on the wire, each a process of its own, to test drivers without hardware."""
