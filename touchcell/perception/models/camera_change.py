"""Geometric difference between a camera and the one a model was trained with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchcell.errors import ConfigError
from touchcell.geometry.types import Array, ImageArray
from touchcell.input_file import read_yaml

Number = Annotated[float, Field(allow_inf_nan=False)]


class CameraChange(BaseModel):
    """A similarity from this sensor's image pixels to those of the sensor the model was trained on.

    Attributes:
        zoom: magnification of the training camera relative to this one.
        turn_deg: rotation of the image about ``centre_px``, from u to v.
        centre_px: centre of the undeformed markers in this camera.
        shift_px: from there to their centre in the training camera.
        frames: number of images that it was estimated from.
        rms_px: residual of the undeformed markers after the change.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True, defer_build=True)

    schema_: Literal[1] = Field(default=1, alias="schema")
    zoom: float = Field(gt=0.2, lt=5.0, allow_inf_nan=False)
    turn_deg: Number
    centre_px: tuple[Number, Number]
    shift_px: tuple[Number, Number]
    frames: int = Field(default=0, ge=0)
    rms_px: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)

    @property
    def matrix(self) -> Array:
        """(2, 3) matrix from homogeneous pixels of this camera to pixels of the training camera."""
        turn = np.deg2rad(self.turn_deg)
        linear = self.zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        centre = np.array(self.centre_px)
        return np.column_stack([linear, centre + np.array(self.shift_px) - linear @ centre])

    def after(self, first: CameraChange) -> CameraChange:
        """Return the composition of two changes: ``first``, then this one."""
        there = self.points(first.points(np.array(first.centre_px)))
        du, dv = there - np.array(first.centre_px)
        return CameraChange(
            zoom=self.zoom * first.zoom,
            turn_deg=self.turn_deg + first.turn_deg,
            centre_px=first.centre_px,
            shift_px=(float(du), float(dv)),
            frames=first.frames,
            rms_px=first.rms_px,
        )

    def points(self, pixels: Array) -> Array:
        """Return (..., 2) px of the training camera, of pixels (..., 2) of this one."""
        matrix = self.matrix
        moved: Array = pixels @ matrix[:, :2].T + matrix[:, 2]
        return moved

    def image(self, image: ImageArray) -> ImageArray:
        """Return an image as the training camera would have taken it; outside is black, binary images stay binary."""
        import cv2

        height, width = image.shape[:2]
        warped = np.asarray(cv2.warpAffine(image, self.matrix, (width, height), flags=cv2.INTER_CUBIC), dtype=np.uint8)
        if ((image == 0) | (image == 255)).all():
            return np.where(warped > 127, np.uint8(255), np.uint8(0))
        return warped

    def undone(self, image: ImageArray) -> ImageArray:
        """Return an image of the training camera as this one would have taken it."""
        import cv2

        height, width = image.shape[:2]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, self.matrix, (width, height), flags=flags), dtype=np.uint8)

    def save(self, path: Path) -> None:
        """Write a calibration file."""
        import yaml

        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(self.model_dump(mode="json", by_alias=True), sort_keys=False), encoding="utf-8")


def load_change(path: Path) -> CameraChange:
    """Read a calibration file.

    Raises:
        ConfigError: the file is missing or invalid.
    """
    import yaml

    try:
        return CameraChange.model_validate(read_yaml(path))
    except OSError as error:
        hint = "make one with `touchcell calibrate`"
        raise ConfigError(f"cannot be read: {error.strerror}", file=str(path), hint=hint) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not YAML: {error}", file=str(path)) from None
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(first["msg"], file=str(path), key=".".join(map(str, first["loc"]))) from None
