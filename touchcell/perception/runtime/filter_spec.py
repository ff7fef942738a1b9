"""Entry points of contact filters (group ``touchcell.filters``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

from touchcell.plugin_section import PluginSection, Section
from touchcell.registry import Registry

if TYPE_CHECKING:
    from touchcell.perception.runtime.filter import ContactFilter


class FilterConfig(Section):
    """Base of a ``filter:`` section."""

    model: str

    def build(self) -> ContactFilter:
        """Return the filter, before its first observation."""
        raise NotImplementedError(f"{type(self).__name__} builds no filter")


@dataclass(frozen=True, slots=True)
class FilterSpec:
    """Entry point of one filter.

    Attributes:
        name: value of ``model`` in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of its section, which builds the filter.
    """

    name: str
    summary: str
    config: type[FilterConfig]


FILTERS: Final = Registry("touchcell.filters", "filter", FilterSpec)
"""All installed filters."""

FilterSection: TypeAlias = Annotated[FilterConfig, PluginSection(FILTERS, tag="model", default="still_surface")]
"""The ``filter:`` section; one that names no ``model`` means a still surface."""
