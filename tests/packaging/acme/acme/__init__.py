"""Plug-ins of a package outside touchcell, one module each."""
