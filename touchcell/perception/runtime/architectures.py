"""The architectures that ship. Their estimators are imported when a model of theirs is loaded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.architecture_spec import ArchitectureSpec
from touchcell.perception.models.marker_architecture import MarkerArchitecture

if TYPE_CHECKING:
    from touchcell.perception.models.model_file import Model
    from touchcell.perception.models.prediction import ContactEstimator


def _image_network(model: Model) -> ContactEstimator:
    from touchcell.perception.runtime.inference import ContactModel

    return ContactModel(model)


def _marker_estimator(model: Model) -> ContactEstimator:
    from touchcell.perception.markers.estimator import MarkerEstimator

    return MarkerEstimator(model)


GDN: Final = ArchitectureSpec(
    "gdn", "convolutional network: image to a Gaussian density of the contact", Architecture, _image_network
)
CNN: Final = ArchitectureSpec("cnn", "convolutional network: image to the contact alone", Architecture, _image_network)
MARKERS: Final = ArchitectureSpec(
    "markers", "markers matched to a lattice; their displacements to a Gaussian", MarkerArchitecture, _marker_estimator
)
