"""Conformance suite for drivers, built-in and third-party; see ``docs/drivers.md``."""
