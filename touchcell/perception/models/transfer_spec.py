"""Transfer of a marker model to another sensor of its kind: the part of the model file that describes it."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Six = tuple[Number, Number, Number, Number, Number, Number]
SixPositive = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
SixNotNegative = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]

BLOCKS: Final = ("shear", "tilt", "depth", "torsion")
"""Gaussian processes: of the shear vector, of the tilt vector, of depth and of torsion."""

PAIRS: Final = ("shear", "tilt")
"""Blocks with two outputs."""

KERNEL: Final = 14
"""Number of kernel parameters of a block."""


BANDS: Final = 5
"""Bands of rings whose displacements are inputs, where a lattice has so many rings."""


class BlockSpec(BaseModel):
    """One Gaussian process.

    Attributes:
        kernel: logarithms of its parameters, see ``transfer.kernel``.
        mean: of its targets.
        unit: standard deviation of its targets.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    kernel: Annotated[tuple[Number, ...], Field(min_length=KERNEL, max_length=KERNEL)]
    mean: Number
    unit: Positive


class TransferSpec(BaseModel):
    """Gaussian processes from the networks' outputs and the sensor's own marker displacements to its contacts.

    Attributes:
        markers: number of markers in the lattice.
        contacts: number of labelled contacts that it was fitted to.
        components: number of principal components of the displacements.
        image_turn: sign of the rotation of the networks' axes when the markers turn from u to v.
        mirror_axes_rad: of shear and of tilt, axes about which the networks' outputs are reflected with the markers.
        mirrored: the new sensor's image is a mirror image of the old one's, or its labels' axes are left-handed.
        shear_axes_rad: angle from the networks' shear to the labels'.
        tilt_axes_rad: angle from the networks' tilt to the labels'.
        shear_unit_mm, tilt_unit_deg, torsion_unit_deg, depth_unit_mm: typical magnitudes of the networks' outputs.
        output_mean, output_sd: of the networks' outputs, mm and degrees.
        component_unit_px: typical magnitude of the components.
        ring_turn_rad: angle from the markers' shift in the image to the networks' shear.
        ring_units_px: typical magnitudes of ``transfer.ring_modes``, band by band.
        blocks: the Gaussian processes, in the order of ``BLOCKS``.
        network_share, process_share: factors of the networks' and the processes' standard deviations.
        floor: standard deviation in addition, mm and degrees; along and across the shear, then z, alpha, beta, gamma.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    markers: int = Field(gt=0)
    contacts: int = Field(gt=1)
    components: int = Field(gt=0)
    image_turn: Literal[-1, 1]
    mirror_axes_rad: tuple[Number, Number]
    mirrored: bool
    shear_axes_rad: Number
    tilt_axes_rad: Number
    shear_unit_mm: Positive
    tilt_unit_deg: Positive
    torsion_unit_deg: Positive
    depth_unit_mm: Positive
    output_mean: Six
    output_sd: SixPositive
    component_unit_px: Positive
    ring_turn_rad: Number
    ring_units_px: tuple[Positive, ...]
    blocks: tuple[BlockSpec, BlockSpec, BlockSpec, BlockSpec]
    network_share: SixNotNegative
    process_share: SixNotNegative
    floor: SixNotNegative

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of its tensors in a model file."""
        n, k, m = self.contacts, self.components, self.markers
        shapes: dict[str, tuple[int, ...]] = {
            "transfer.outputs": (n, 6),
            "transfer.scores": (n, k),
            "transfer.rings": (n, len(self.ring_units_px) // 3, 3, 2),
            "transfer.mean": (2 * m,),
            "transfer.basis": (k, 2 * m),
        }
        for name in BLOCKS:
            rows = 2 * n if name in PAIRS else n
            shapes[f"transfer.{name}.weights"] = (rows,)
            shapes[f"transfer.{name}.inverse"] = (rows, rows)
        return shapes
