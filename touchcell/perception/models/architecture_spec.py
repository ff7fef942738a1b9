"""Entry points of estimator architectures (group ``touchcell.architectures``): kinds of model files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Generic, TypeAlias, TypeVar

from touchcell.plugin_section import PluginSection, Section
from touchcell.registry import Registry


class ArchitectureConfig(Section):
    """Base of the architecture in the header of a model file.

    Attributes:
        reports_markers: True if its predictions hold the fraction of markers detected (``Prediction.markers``).
        kind: which architecture.
        input_size: (height, width) of the preprocessed image.
    """

    reports_markers: ClassVar[bool] = False

    kind: str
    input_size: tuple[int, int]

    @property
    def widest_sigma(self) -> float:
        """Largest standard deviation that its estimators report before calibration, in label half-ranges."""
        return 1.0

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of the float32 tensors of a model file."""
        raise NotImplementedError(f"{type(self).__name__} names no tensors")


ModelT = TypeVar("ModelT")
EstimatorT_co = TypeVar("EstimatorT_co", covariant=True)


@dataclass(frozen=True, slots=True)
class ArchitectureSpec(Generic[ModelT, EstimatorT_co]):
    """Entry point of one architecture. Its module imports no inference library: that happens in ``build``.

    Attributes:
        name: value of ``architecture.kind`` in the header of a model file.
        summary: one line for ``touchcell list``.
        config: pydantic model of the architecture in the header.
        build: makes the ``prediction.ContactEstimator`` that a ``model_file.Model`` of this kind describes.
    """

    name: str
    summary: str
    config: type[ArchitectureConfig]
    build: Callable[[ModelT], EstimatorT_co]


AnyArchitecture: TypeAlias = ArchitectureSpec[Any, Any]
"""An architecture that was found by name."""

ARCHITECTURES: Final[Registry[AnyArchitecture]] = Registry("touchcell.architectures", "architecture", ArchitectureSpec)
"""All installed architectures."""

ArchitectureSection: TypeAlias = Annotated[ArchitectureConfig, PluginSection(ARCHITECTURES)]
"""The architecture in the header of a model file."""
