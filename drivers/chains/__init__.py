"""Descriptions of arms for ``drivers.kinematics``."""
