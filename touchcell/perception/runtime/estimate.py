"""Output of perception: a stamped Gaussian over contact pose and shear."""

from __future__ import annotations

from dataclasses import dataclass

from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.features.feature_model import TouchedFeature


@dataclass(frozen=True, slots=True)
class ContactEstimate:
    """Estimate of one tactile sensor's contact.

    Attributes:
        in_contact: True if the sensor touches anything.
        belief: Gaussian over ``T_s_f``, the surface frame in the sensor frame (docs/glossary.md, "contact pose and
            shear"), left perturbation, m and rad; None without contact.
        t_frame_ns: capture stamp of the newest frame it is based on.
        seq: sequence number of that frame.
        t_ns: time of the estimate: the frame's, or later where it was propagated by the sensor's motion since.
        in_range: False when the network's output is outside its training range.
        nis: normalised innovation squared of the last correction (6 degrees of freedom), None before the second frame.
        touched: what it touches, with probabilities; None without a classifier.
        change: how much the newest image differs from the zero frame, 0 to 1, as the contact gate measures it; None
            without a gate.
        markers: fraction of the markers expected in view that were detected, for a marker estimator.
        measured: Gaussian of the frame by itself, before any filter; None without contact, or without a model.
        refusal: why the frame does not show the contact as the model's camera would; empty where it does.
    """

    in_contact: bool
    belief: PoseGaussian | None
    t_frame_ns: int
    seq: int
    t_ns: int
    in_range: bool = True
    nis: float | None = None
    markers: float | None = None
    measured: PoseGaussian | None = None
    refusal: str = ""
    change: float | None = None
    touched: TouchedFeature | None = None
