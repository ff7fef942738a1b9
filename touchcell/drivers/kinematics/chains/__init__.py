"""Descriptions of arms for ``touchcell.drivers.kinematics.chain``."""
