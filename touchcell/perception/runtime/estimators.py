"""Load a trained model of any kind."""

from __future__ import annotations

from pathlib import Path

from touchcell.perception.models.architecture_spec import ARCHITECTURES
from touchcell.perception.models.model_file import Model, load_model
from touchcell.perception.models.prediction import ContactEstimator


def load_estimator(path: Path, calibration: Path | None = None) -> ContactEstimator:
    """Open a model file of any kind.

    Args:
        path: model file.
        calibration: calibration file of the camera, where it is not the one the model was trained with
            (``touchcell calibrate``).

    Raises:
        ModelError: as ``model_file.load_model``.
        ConfigError: the calibration file cannot be used.
    """
    model = load_model(path)
    change = model.header.camera
    if calibration is not None:
        from touchcell.perception.models.camera_change import load_change

        found = load_change(calibration)
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
