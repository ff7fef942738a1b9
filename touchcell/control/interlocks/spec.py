"""Entry points of interlocks (group ``touchcell.interlocks``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class InterlockSpec:
    """Entry point of one kind of interlock.

    Attributes:
        name: value of ``kind`` in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of its section, which builds the interlock.
    """

    name: str
    summary: str
    config: type[InterlockSettings]


INTERLOCKS: Final = Registry("touchcell.interlocks", "interlock", InterlockSpec)
"""All installed kinds of interlock."""
