"""Meshes of the shipped cells, as files; ``touchcell.cell.experiments.sample_meshes`` makes them."""
