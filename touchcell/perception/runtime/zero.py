"""Compare the first frame of a run, out of contact, with the model's own: is this the model's sensor and camera?"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from touchcell.geometry.types import ImageArray
from touchcell.perception.errors import CameraError, ImageError, TrainingError
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.model_file import Model
from touchcell.perception.models.prediction import ContactEstimator
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.estimators import calibrated

logger = logging.getLogger(__name__)

_SAME_ZOOM, _SAME_TURN_DEG, _SAME_SHIFT_PX = 0.004, 0.4, 1.5
_MOST_ZOOM, _MOST_TURN_DEG, _MOST_SHIFT_PX = 0.07, 8.0, 20.0
_QUIET = 0.5


@dataclass(frozen=True)
class Zeroed:
    """An estimator and a contact gate for the camera as mounted.

    Attributes:
        estimator: for this camera.
        gate: that compares with this camera's own image out of contact.
        change: that was undone; None where the camera is the model's.
    """

    estimator: ContactEstimator
    gate: ContactGate
    change: CameraChange | None


class ZeroFrame:
    """The comparison. A small change of the camera is undone, a large one is refused.

    Args:
        sensor: its name, for errors.
        model: with an image out of contact.
        known: change that a calibration file states; None for none.
        enter, leave: scores of the contact gate.
    """

    def __init__(self, sensor: str, model: Model, known: CameraChange | None, *, enter: float, leave: float) -> None:
        self._sensor, self._model, self._known = sensor, model, known
        self._enter, self._leave = enter, leave

    def __call__(self, frame: ImageArray, estimator: ContactEstimator, gate: ContactGate) -> Zeroed:
        """Compare a camera frame out of contact.

        Raises:
            CameraError: it shows no lattice of the model's rings, or the camera has moved by more than can be undone.
            ImageError: the frame does not match the model.
        """
        from touchcell.perception.markers.zero_frame import find_change

        # The camera of an adapted model is undone by the estimator; what is compared is its own sensor's image.
        try:
            found = find_change(self._model, [frame])
        except (TrainingError, ImageError) as error:
            if isinstance(error, ImageError) and error.attribute != "content":
                raise
            raise CameraError(
                self._sensor,
                f"the first frame does not show the model's tip out of contact: {error}",
                hint="lift the tip off; is it another sensor than the model's, or another crop?",
            ) from error
        change = self._known
        if _differs(found, self._known, _SAME_ZOOM, _SAME_TURN_DEG, _SAME_SHIFT_PX):
            if _differs(found, self._known, _MOST_ZOOM, _MOST_TURN_DEG, _MOST_SHIFT_PX):
                raise CameraError(
                    self._sensor,
                    f"its camera is not the model's: {_describe(found)}",
                    hint="mend the mount, or `touchcell calibrate` it and name the file in `calibration`",
                )
            logger.warning("sensor %s: its camera has moved, which is undone: %s", self._sensor, _describe(found))
            change = found
            estimator = calibrated(self._model, found)
        reduced = estimator.reduce(frame)
        if change is not self._known or gate.compare(reduced) > _QUIET * self._leave:
            gate = ContactGate(reduced, enter=self._enter, leave=self._leave)
        return Zeroed(estimator, gate, None if change is self._known else change)


def _differs(found: CameraChange, known: CameraChange | None, zoom: float, turn_deg: float, shift_px: float) -> bool:
    before = known or CameraChange(zoom=1.0, turn_deg=0.0, centre_px=found.centre_px, shift_px=(0.0, 0.0))
    apart = math.dist(before.points(np.array(found.centre_px)), found.points(np.array(found.centre_px)))
    return (
        abs(found.zoom / before.zoom - 1.0) > zoom
        or abs(found.turn_deg - before.turn_deg) > turn_deg
        or apart > shift_px
    )


def _describe(found: CameraChange) -> str:
    u, v = found.shift_px
    zoomed = 100.0 * (1.0 / found.zoom - 1.0)
    return f"zoomed by {zoomed:.1f} %, turned by {-found.turn_deg:.1f} deg, shifted by {-u:.1f}, {-v:.1f} px"
