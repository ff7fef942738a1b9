"""Names of the coordinate frames of a cell, as recordings and viewers have them."""

from __future__ import annotations

from typing import Final

WORLD: Final = "world"
"""The frame that all bases stand in."""


def base_frame(arm: str) -> str:
    """Return the name of the frame of an arm's base, by the arm's role."""
    return f"arms/{arm}/base"


def link_frame(arm: str, number: int) -> str:
    """Return the name of the frame of the link behind an arm's joint, counted from 1."""
    return f"arms/{arm}/link{number}"


def tcp_frame(arm: str) -> str:
    """Return the name of the frame of an arm's tool centre point."""
    return f"arms/{arm}/tcp"


def sensor_frame(sensor: str) -> str:
    """Return the name of a sensor's frame: at the centre of its tip, z outwards."""
    return f"sensors/{sensor}"


def contact_frame(sensor: str) -> str:
    """Return the name of the surface frame that a sensor estimates."""
    return f"sensors/{sensor}/contact"


def object_frame(name: str) -> str:
    """Return the name of a free object's frame."""
    return f"objects/{name}"


def surface_frame(name: str) -> str:
    """Return the name of the frame of a surface, table or obstacle."""
    return f"surfaces/{name}"
