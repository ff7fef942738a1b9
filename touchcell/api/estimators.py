"""Trained estimators by file or name."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from touchcell.perception.models.prediction import ContactEstimator
from touchcell.perception.runtime import estimators
from touchcell.perception.runtime.network_estimator import model_path


def load_estimator(
    model: str | PathLike[str] = "builtin:sim_gdn", *, calibration: str | PathLike[str] | None = None
) -> ContactEstimator:
    """A trained estimator, ready to predict the contact in an image.

        contact = tc.load_estimator("builtin:sim_gdn").predict(image)
        print(contact.pose_mm_deg, contact.sigma_mm_deg)

    Args:
        model: model file, or ``builtin:NAME`` for one that ships.
        calibration: file of ``touchcell calibrate``, where another camera taught the model.

    Raises:
        ModelError: the file is missing or no model.
        ConfigError: the calibration file cannot be used.
    """
    return estimators.load_estimator(
        model_path(str(model)), calibration=None if calibration is None else Path(calibration)
    )
