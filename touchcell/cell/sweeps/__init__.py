"""Sweeps: many runs of one cell over grids and samples of its keys, measured, tabulated and drawn."""
