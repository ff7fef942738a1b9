"""Benchmarks of the user's own machine and cell: ``touchcell bench NAME``."""
