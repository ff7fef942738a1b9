"""Check that an image shows a tip's markers, from its texture alone: for estimators that do not detect markers."""

from __future__ import annotations

import numpy as np

from touchcell.geometry.types import Array, ImageArray

_PARTS = 4
_BAND = (0.55, 1.7)
_BRIGHTNESS = (0.6, 1.5)
_LEAST_CONTRAST = 0.65
_LEAST_SHARE = 0.75
_LEAST_PART = 0.1
_TEXTURED = 0.3
_LEAST_SIDE_PX = 32


class MarkerTexture:
    """Test whether a preprocessed image has the brightness and spatial frequencies of the markers out of contact.

    Markers are brighter than the skin and have a typical spacing, which a contact changes by less than the width of the
    tested band. Black, white, noise, inverted images and images of which a part is missing are not plausible; a torn
    or rolled image of the same tip is.

    Args:
        reference: uint8 (height, width), preprocessed, out of contact.
    """

    def __init__(self, reference: ImageArray) -> None:
        height, width = reference.shape
        self._side = (height // _PARTS, width // _PARTS)
        self._mean = float(reference.mean())
        frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
        power = self._power(reference)
        power[frequency < 0.04] = 0.0
        peak = float((frequency * power).sum() / max(float(power.sum()), 1e-12))
        self._band = (frequency > _BAND[0] * peak) & (frequency < _BAND[1] * peak)
        self._beyond = frequency > 0.04
        self._energy, self._share = self._spectrum(reference)
        self._parts = self._contrasts(reference)

    @property
    def usable(self) -> bool:
        """True if the reference itself has the texture of markers."""
        return min(self._side) * _PARTS >= _LEAST_SIDE_PX and self._energy > 0.0 and self._share > _TEXTURED

    def measure(self, reduced: ImageArray) -> tuple[float, float, float, float]:
        """Return brightness, contrast, share of the band and least contrast of a part, relative to the reference."""
        energy, share = self._spectrum(reduced)
        marked = self._parts > 0.5 * float(np.median(self._parts))
        parts = self._contrasts(reduced)[marked] / self._parts[marked]
        return (
            float(reduced.mean()) / max(self._mean, 1.0),
            float(np.sqrt(energy / max(self._energy, 1e-12))),
            share / max(self._share, 1e-12),
            float(parts.min()) if len(parts) else 0.0,
        )

    def plausible(self, reduced: ImageArray) -> bool:
        """Return True if a preprocessed image (height, width) may show the tip's markers."""
        brightness, contrast, share, part = self.measure(reduced)
        return (
            _BRIGHTNESS[0] <= brightness <= _BRIGHTNESS[1]
            and contrast >= _LEAST_CONTRAST
            and share >= _LEAST_SHARE
            and part >= _LEAST_PART
        )

    def _spectrum(self, image: ImageArray) -> tuple[float, float]:
        power = self._power(image)
        total = float(power[self._beyond].sum())
        band = float(power[self._band].sum())
        return band, band / max(total, 1e-12)

    @staticmethod
    def _power(image: ImageArray) -> Array:
        spectrum = np.fft.rfft2(image.astype(np.float32) / np.float32(255.0 * np.sqrt(image.size)))
        power: Array = spectrum.real**2 + spectrum.imag**2
        return power

    def _contrasts(self, image: ImageArray) -> Array:
        rows, columns = self._side
        parts = image[: _PARTS * rows, : _PARTS * columns].reshape(_PARTS, rows, _PARTS, columns)
        contrasts: Array = parts.astype(np.float32).std(axis=(1, 3)).astype(np.float64)
        return contrasts
