"""Run time against error, printed by ``touchcell bench NAME``."""
