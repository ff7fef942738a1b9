"""Benchmarks that tell a user about his own machine and cell: ``touchcell bench NAME``."""
