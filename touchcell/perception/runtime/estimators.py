"""Load a trained model of any kind."""

from __future__ import annotations

from pathlib import Path

from touchcell.perception.models.architecture_spec import ARCHITECTURES
from touchcell.perception.models.camera_change import CameraChange, load_change
from touchcell.perception.models.camera_frames import served_from_camera
from touchcell.perception.models.model_file import Model, load_model
from touchcell.perception.models.prediction import ContactEstimator


def load_estimator(
    path: Path,
    calibration: Path | None = None,
    *,
    from_camera: bool = False,
    crop_corner_px: tuple[int, int] | None = None,
) -> ContactEstimator:
    """Open a model file of any kind.

    Args:
        path: model file.
        calibration: calibration file of the camera, where it is not the one the model was trained with
            (``touchcell calibrate``).
        from_camera: for grey 640x480 camera frames, where the model was trained on images that are published cropped
            and thresholded.
        crop_corner_px: (left, top) of that crop in the frame; None for its centre.

    Raises:
        ModelError: as ``model_file.load_model``.
        ConfigError: the calibration file cannot be used.
    """
    model = load_model(path)
    if from_camera:
        model = served_from_camera(model, corner=crop_corner_px)
    found = None
    if calibration is not None:
        found = load_change(calibration)
    return calibrated(model, found)


def calibrated(model: Model, found: CameraChange | None = None) -> ContactEstimator:
    """Return the estimator of a model, for the camera that it was adapted to, and for a change of that one."""
    change = model.header.camera
    if found is not None:
        change = found if change is None else change.after(found)
    estimator = estimator_of(model)
    if change is None:
        return estimator
    from touchcell.perception.runtime.calibrated_estimator import CalibratedEstimator

    return CalibratedEstimator(estimator, change)


def estimator_of(model: Model) -> ContactEstimator:
    """Build the estimator that a model of any kind describes."""
    estimator: ContactEstimator = ARCHITECTURES.load(model.header.architecture.kind).build(model)
    return estimator
