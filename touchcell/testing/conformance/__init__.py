"""Conformance suite for drivers, built-in and third-party; see ``docs/how-to/write-a-driver.md``."""
