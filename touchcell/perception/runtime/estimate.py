"""What perception delivers: a stamped belief over contact pose and shear."""

from __future__ import annotations

from dataclasses import dataclass

from touchcell.geometry.gaussian import PoseGaussian


@dataclass(frozen=True, slots=True)
class ContactEstimate:
    """Belief about one tactile sensor's contact.

    Attributes:
        in_contact: whether the sensor touches anything.
        belief: Gaussian over ``T_s_f``, the surface frame in the sensor frame (SPEC part 2), left perturbation,
            m and rad; None without contact.
        t_frame_ns: capture stamp of the newest frame behind it.
        seq: sequence number of that frame.
        t_ns: time that the belief is for: the frame's, or later where the sensor's motion since has been replayed.
        in_range: False when the network left the range that it was trained on.
        nis: normalised innovation squared of the last correction (6 degrees of freedom), None before the second frame.
        markers: share of the markers expected in view that the estimator has seen, where it looks for markers.
    """

    in_contact: bool
    belief: PoseGaussian | None
    t_frame_ns: int
    seq: int
    t_ns: int
    in_range: bool = True
    nis: float | None = None
    markers: float | None = None
