"""Entry points of contact filters (group ``touchcell.filters``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Protocol, TypeAlias

from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.plugin_section import PluginSection, Section
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class FilterState:
    """Estimate, with its sensor pose and time, and its consistency with the last frame."""

    belief: PoseGaussian
    T_base_sensor: Array
    t_ns: int
    nis: float | None = None


def state_before(state: FilterState | None, t_ns: int) -> FilterState:
    """Return ``state``, from which an estimate at ``t_ns`` may be predicted.

    Raises:
        ValueError: there was no observation yet, or ``t_ns`` is before it.
    """
    if state is None:
        raise ValueError("predict before the first observation")
    if t_ns < state.t_ns:
        raise ValueError(f"cannot predict back from {state.t_ns} to {t_ns} ns")
    return state


class ContactFilter(Protocol):
    """Interface of the filters ``PoseFilter`` and ``moving_surface.MovingSurfaceFilter``."""

    def reset(self) -> None:
        """Clear the state: the next observation starts a new contact."""
        ...

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        """Predict the estimate for the sensor at ``T_base_sensor`` at ``t_ns``; the state is unchanged."""
        ...

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        """Fuse an observation made at ``t_ns`` with the sensor at ``T_base_sensor``; returns the new state."""
        ...


class FilterConfig(Section):
    """Base of a ``filter:`` section.

    Attributes:
        model: which filter.
    """

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
        feature: name of the feature whose motion relative to the sensor it predicts.
        anchored: True if its contacts count from where they were first touched, on something that stands still: where a
            contact glides or is carried along, its shear grows without end.
    """

    name: str
    summary: str
    config: type[FilterConfig]
    feature: str = "surface"
    anchored: bool = False


FILTERS: Final = Registry("touchcell.filters", "filter", FilterSpec)
"""All installed filters."""

FilterSection: TypeAlias = Annotated[FilterConfig, PluginSection(FILTERS, tag="model", default="still_surface")]
"""The ``filter:`` section; one that names no ``model`` means a still surface."""
