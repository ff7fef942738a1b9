"""Tactile robot cells: typed device drivers, tactile perception, SE(3) control and safe task state machines."""
