"""Short programs that use touchcell on simulated devices; each runs by itself: ``python examples/move_arm.py``."""
