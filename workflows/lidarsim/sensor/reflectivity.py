"""Reflectivity as makers of sensors define it: bytes for reflectances, calibrated by range."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..media.materials import RETRO_GAIN
from ..numerics.arrays import Bytes, Floats
from ..numerics.elementary import exp, log
from ..numerics.elementary_scalars import log_of

_BEST = 8 * RETRO_GAIN  # reflectance of the best retro-reflective sheets


class ByteScale(NamedTuple):
    """Codes of reflectances: linear up to `code`, then logarithmic."""

    code: int
    reflectance: float  # reflectance of `code`
    max_reflectance: float  # reflectance of the code 255

    def codes(self, reflectance: Floats) -> Bytes:
        """Return the codes (n,) of reflectances (n,), 255 for reflectances beyond the scale."""
        share = reflectance / self.reflectance
        code = self.code * np.minimum(share, 1) + log(np.maximum(share, 1)) / self._step
        return np.rint(np.minimum(code, 255)).astype(np.uint8)

    def reflectances(self, codes: Bytes) -> Floats:
        """Return the reflectances (n,) of codes (n,): the inverse of `codes`, but for rounding."""
        linear = np.minimum(codes, self.code)
        return self.reflectance * (linear / self.code) * exp(self._step * (codes - linear))

    @property
    def _step(self) -> float:
        """Logarithm of the ratio of the reflectances of neighboring codes."""
        return log_of(self.max_reflectance / self.reflectance) / max(255 - self.code, 1) or 1.0


COUNTS = 10_000  # value of an intensity of 1 in the column signal: makers publish no such figure
# From the makers' manuals. Only Hesai publishes its scale completely: other makers say that the
# scale is logarithmic above white, or ends with an ideal retro-reflector.
SCALES = {
    "velodyne": ByteScale(100, 1.0, _BEST),
    "vls128": ByteScale(110, 1.0, _BEST),
    "ouster": ByteScale(100, 1.0, _BEST),
    "hesai": ByteScale(255, 2.55, 2.55),
    "livox": ByteScale(150, 1.0, _BEST),
}
