"""Biomechanical limits of contact with people: ISO/TS 15066:2016, Annex A, Table A.2 (also ISO 10218-2:2025, Annex M).

Largest permissible quasi-static pressure and force of each body region. Transient contact, shorter than half a second,
may reach the multiple given, and is not permissible at the head. Compare with your copy of the standard before you
rely on a number: these values are a research result, not a guarantee against pain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True, slots=True)
class BodyRegion:
    """Limits of one region.

    Attributes:
        number: of the specific body area in the table.
        pressure_n_cm2: largest quasi-static pressure.
        force_n: largest quasi-static force.
        transient: multiple of both in transient contact; None where such contact is not permissible.
    """

    number: int
    pressure_n_cm2: float
    force_n: float
    transient: float | None = 2.0


BODY_REGIONS: Final[Mapping[str, BodyRegion]] = MappingProxyType(
    {
        "middle_of_forehead": BodyRegion(1, 130, 130, None),
        "temple": BodyRegion(2, 110, 130, None),
        "masticatory_muscle": BodyRegion(3, 110, 65, None),
        "neck_muscle": BodyRegion(4, 140, 150),
        "seventh_neck_vertebra": BodyRegion(5, 210, 150),
        "shoulder_joint": BodyRegion(6, 160, 210),
        "fifth_lumbar_vertebra": BodyRegion(7, 210, 210),
        "sternum": BodyRegion(8, 120, 140),
        "pectoral_muscle": BodyRegion(9, 170, 140),
        "abdominal_muscle": BodyRegion(10, 140, 110),
        "pelvic_bone": BodyRegion(11, 210, 180),
        "deltoid_muscle": BodyRegion(12, 190, 150),
        "humerus": BodyRegion(13, 220, 150),
        "radial_bone": BodyRegion(14, 190, 160),
        "forearm_muscle": BodyRegion(15, 180, 160),
        "arm_nerve": BodyRegion(16, 180, 160),
        "forefinger_pad_dominant": BodyRegion(17, 300, 140),
        "forefinger_pad_other": BodyRegion(18, 270, 140),
        "forefinger_end_joint_dominant": BodyRegion(19, 280, 140),
        "forefinger_end_joint_other": BodyRegion(20, 220, 140),
        "thenar_eminence": BodyRegion(21, 200, 140),
        "palm_dominant": BodyRegion(22, 260, 140),
        "palm_other": BodyRegion(23, 260, 140),
        "back_of_hand_dominant": BodyRegion(24, 200, 140),
        "back_of_hand_other": BodyRegion(25, 190, 140),
        "thigh_muscle": BodyRegion(26, 250, 220),
        "kneecap": BodyRegion(27, 220, 220),
        "middle_of_shin": BodyRegion(28, 220, 130),
        "calf_muscle": BodyRegion(29, 210, 130),
    }
)
"""By name, in the order of the table."""
