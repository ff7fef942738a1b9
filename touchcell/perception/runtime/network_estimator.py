"""Contacts from camera images by a trained model, a contact gate and a filter."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, Self

from pydantic import NonNegativeInt, PositiveFloat, model_validator

from touchcell.errors import ConfigError
from touchcell.input_file import BUILTIN, InputFile, files_in
from touchcell.paths import CLASSIFIERS, MODELS
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext, EstimatorSpec, Feature
from touchcell.perception.runtime.feature_spec import EDGE
from touchcell.perception.runtime.filter_spec import FilterSection
from touchcell.plugin_section import Section

if TYPE_CHECKING:
    from touchcell.perception.features.feature_model import FeatureModel
    from touchcell.perception.models.model_file import Model
    from touchcell.perception.runtime.pipeline import ContactPipeline

_MODEL: Final = InputFile(
    "a model file",
    files_in(MODELS, ".safetensors"),
    BUILTIN,
    hint="`touchcell train --data DIR --out NAME.safetensors` writes one, --model names another",
)
_FEATURES: Final = InputFile(
    "a classifier's file",
    files_in(CLASSIFIERS, ".safetensors"),
    BUILTIN,
    hint="`touchcell train-sim --feature kinds --out NAME.safetensors` writes one",
)
_CALIBRATION: Final = InputFile("a calibration file", hint="`touchcell calibrate` writes one")


class GateConfig(Section):
    """The contact gate: mean change of the marker image, in per cent, that begins and ends a contact.

    Attributes:
        touch_percent: change of the image above which a contact begins.
        release_percent: change of the image below which it ends.
    """

    touch_percent: PositiveFloat
    release_percent: PositiveFloat

    @model_validator(mode="after")
    def _hysteresis(self) -> Self:
        if self.release_percent >= self.touch_percent:
            raise ValueError(
                f"release_percent {self.release_percent:g} is not below touch_percent {self.touch_percent:g}: "
                "a contact would end as it begins"
            )
        return self


class NetworkEstimator(EstimatorConfig):
    """Image -> network -> filter. ``calibration`` is a file of ``touchcell calibrate``.

    Attributes:
        model: model file, or ``builtin:NAME`` for one that ships.
        calibration: file of ``touchcell calibrate``, where another camera taught the model.
        from_camera: the camera gives grey 640x480 frames, and the model was trained on images as data sets are
            published: cropped, black and white.
        crop_corner_px: with ``from_camera``: left and top of the crop in the frame; none for the frame's centre.
        gate: decides about contact without the network; without it every frame goes through the network.
        zero_frame: ``compare`` the first frame of a run, out of contact, with the model's own, where there is a gate:
            a small change of the camera is undone, a large one refused; or ``skip`` that.
        features: file of a classifier of what is touched (``touchcell train-sim --feature kinds``), or
            ``builtin:NAME``; it reads the markers of a marker model.
        filter: fuses the estimates over time; without it each frame stands by itself.
    """

    reads_frames: ClassVar[bool] = True

    kind: Literal["network"]
    model: Annotated[str, _MODEL]
    calibration: Annotated[str | None, _CALIBRATION] = None
    from_camera: bool = False
    crop_corner_px: tuple[NonNegativeInt, NonNegativeInt] | None = None
    gate: GateConfig | None = None
    zero_frame: Literal["compare", "skip"] = "compare"
    filter: FilterSection | None = None
    features: Annotated[str | None, _FEATURES] = None

    def build(self, context: EstimatorContext) -> ContactPipeline:
        """Return the pipeline.

        Raises:
            ModelError: the model file cannot be used.
            ConfigError: a contact gate is configured for a model without an image out of contact.
        """
        import cv2

        from touchcell.perception.models.camera_change import load_change
        from touchcell.perception.models.camera_frames import served_from_camera
        from touchcell.perception.models.model_file import load_model
        from touchcell.perception.runtime.contact_gate import ContactGate
        from touchcell.perception.runtime.estimators import calibrated
        from touchcell.perception.runtime.pipeline import ContactPipeline
        from touchcell.perception.runtime.zero import ZeroFrame

        # A second thread gains nothing on images of this size, and takes a core from other sensors.
        cv2.setNumThreads(1)
        known = None if self.calibration is None else load_change(Path(self.calibration))
        stored = load_model(model_path(self.model))
        if self.from_camera:
            stored = served_from_camera(stored, corner=self.crop_corner_px)
        model = calibrated(stored, known)
        contact_gate, zero = None, None
        if self.gate is not None:
            if model.reference is None:
                raise ConfigError(
                    f"model {self.model} holds no image out of contact, which a contact gate compares with",
                    key=f"sensors.{context.sensor}.estimator.gate",
                    value=self.model,
                    hint="leave out `gate:`, so that every frame goes through the network",
                )
            enter, leave = self.gate.touch_percent / 100, self.gate.release_percent / 100
            contact_gate = ContactGate(model.reference, enter=enter, leave=leave)
            if self.zero_frame == "compare":
                zero = ZeroFrame(context.sensor, stored, known, enter=enter, leave=leave)
        pose_filter = None if self.filter is None else self.filter.build()
        return ContactPipeline(
            context.camera,
            model,
            contact_gate=contact_gate,
            pose_filter=pose_filter,
            zero=zero,
            features=self._classifier(context.sensor, stored),
        )

    def _classifier(self, sensor: str, model: Model) -> FeatureModel | None:
        """Return the classifier. Raises ModelError, and ConfigError where the model has no or other markers."""
        from touchcell.perception.features.feature_model import load_feature_model
        from touchcell.perception.models.marker_architecture import MarkerArchitecture

        if self.features is None:
            return None
        name = self.features
        classifier = load_feature_model(
            CLASSIFIERS / f"{name.removeprefix(BUILTIN)}.safetensors" if name.startswith(BUILTIN) else Path(name)
        )
        architecture = model.header.architecture
        if not isinstance(architecture, MarkerArchitecture) or architecture.markers != classifier.markers:
            raise ConfigError(
                f"it reads {classifier.markers} markers, which model {self.model} does not find",
                key=f"sensors.{sensor}.estimator.features",
                value=name,
                hint="use a marker model of the same sensor, or leave out `features:`",
            )
        return classifier


class EdgeNetworkEstimator(NetworkEstimator):
    """As ``network``, with a model that was trained on contacts with edges (``touchcell train-sim --feature edge``).

    A filter that holds the contact still does not suit it: the edge frame glides along the edge with the sensor.
    """

    feature: ClassVar[Feature] = EDGE.name

    kind: Literal["edge_network"]  # type: ignore[assignment]


def model_path(name: str) -> Path:
    """Return the file behind a cell file's ``model:``: a path, or ``builtin:NAME`` for one that ships."""
    return MODELS / f"{name.removeprefix(BUILTIN)}.safetensors" if name.startswith(BUILTIN) else Path(name)


EDGE_NETWORK = EstimatorSpec("edge_network", "as network, of the edge under the sensor", EdgeNetworkEstimator)
NETWORK = EstimatorSpec("network", "trained model, contact gate and filter on the sensor's images", NetworkEstimator)
