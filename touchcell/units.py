"""The unit that a key or column carries at the end of its name."""

from __future__ import annotations

import re
from typing import Final

_UNITS: Final = {
    "mm_deg": "mm, deg",
    "mm_deg_s": "mm/s, deg/s",
    "mm_per_sqrt_s": "mm/sqrt(s)",
    "deg_per_sqrt_s": "deg/sqrt(s)",
    "mm_s_per_sqrt_s": "mm/s/sqrt(s)",
    "deg_s_per_sqrt_s": "deg/s/sqrt(s)",
    "n_m_s_rad": "N m s/rad",
    "n_m_rad": "N m/rad",
    "n_mm": "N/mm",
    "n_m": "N m",
    "n": "N",
    "per_s2": "1/s^2",
    "per_s": "1/s",
    "m_s3": "m/s^3",
    "m_s2": "m/s^2",
    "m_s": "m/s",
    "rad_s3": "rad/s^3",
    "rad_s2": "rad/s^2",
    "rad_s": "rad/s",
    "mm_s": "mm/s",
    "deg_s": "deg/s",
    "mm": "mm",
    "m": "m",
    "deg": "deg",
    "rad": "rad",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
    "s": "s",
    "hz": "Hz",
    "px": "px",
    "g": "g",
    "kg": "kg",
    "percent": "%",
    "ticks": "ticks",
}
_SUFFIX: Final = re.compile(r"(?:^|_)(" + "|".join(sorted(_UNITS, key=len, reverse=True)) + r")$")


def unit_of(name: str) -> str:
    """Return the unit at the end of ``name``, as "mm/s" of "speed_mm_s"; "" for a name without one."""
    if name == "twist":
        return "m/s, rad/s"
    found = _SUFFIX.search(name)
    return _UNITS[found[1]] if found and found.start() > 0 else ""
