"""Typed device drivers: lifecycle, capabilities, stamped samples, commands that expire, and a registry."""
