"""Developer benchmarks, printed by ``touchcell bench NAME``."""
