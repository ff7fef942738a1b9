"""Emulated devices, each a process of its own, to test drivers without hardware."""
