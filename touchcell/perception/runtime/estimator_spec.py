"""Entry points of contact estimators (group ``touchcell.estimators``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, TypeAlias

from touchcell.drivers.core.protocols import FrameSource
from touchcell.plugin_section import PluginSection, Section
from touchcell.registry import Registry

if TYPE_CHECKING:
    from touchcell.perception.runtime.pipeline import ContactSource


Feature: TypeAlias = str
"""What a contact pose is relative to: the name of a ``FeatureSpec``."""


@dataclass(frozen=True, slots=True)
class EstimatorContext:
    """Inputs of an estimator besides its own section.

    Attributes:
        sensor: name of the sensor in the cell file.
        camera: its frame source.
        truth: source of the true contact; None where it is not known.
        true_edge: source of the true edge under the sensor; None where it is not known.
    """

    sensor: str
    camera: FrameSource
    truth: ContactSource | None = None
    true_edge: ContactSource | None = None


class EstimatorConfig(Section):
    """Base of an ``estimator:`` section.

    Attributes:
        needs_truth: True if it can only be built where the true contact is known, as in a simulated scene.
        reads_frames: True if it builds a ``ContactPipeline``, which takes milliseconds for each camera frame and may
            run in a thread of its own.
        feature: what its contacts are of: a surface, or an edge of one (docs/explanation/edges.md).
        kind: which estimator.
    """

    needs_truth: ClassVar[bool] = False
    reads_frames: ClassVar[bool] = False
    feature: ClassVar[Feature] = "surface"

    kind: str

    def build(self, context: EstimatorContext) -> ContactSource:
        """Return the source of the sensor's contact. Raises ConfigError if it cannot be built as configured."""
        raise NotImplementedError(f"{type(self).__name__} builds no estimator")


@dataclass(frozen=True, slots=True)
class EstimatorSpec:
    """Entry point of one kind of estimator.

    Attributes:
        name: value of ``kind`` in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of its section, which builds the source of contacts.
    """

    name: str
    summary: str
    config: type[EstimatorConfig]


ESTIMATORS: Final = Registry("touchcell.estimators", "estimator", EstimatorSpec)
"""All installed kinds of estimator."""

EstimatorSection: TypeAlias = Annotated[EstimatorConfig, PluginSection(ESTIMATORS)]
"""The ``estimator:`` section of a sensor."""
