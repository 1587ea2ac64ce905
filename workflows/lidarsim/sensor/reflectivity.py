"""Reflectivity as makers of sensors publish it: a byte for a reflectance that is known by range."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.arrays import Bytes, Floats
from ..base.elementary import exp, log
from ..base.elementary_scalars import log_of
from .materials import RETRO_GAIN

_BEST = 8 * RETRO_GAIN  # reflectance of the best retro-reflective sheets


class ByteScale(NamedTuple):
    """Codes of reflectances: linear up to `code`, which has a `reflectance`, then logarithmic."""

    code: int
    reflectance: float
    most: float  # reflectance of 255

    def codes(self, reflectance: Floats) -> Bytes:
        """Codes (n,) of reflectances (n,); 255 of all beyond the scale."""
        share = reflectance / self.reflectance
        code = self.code * np.minimum(share, 1) + log(np.maximum(share, 1)) / self._step
        return np.rint(np.minimum(code, 255)).astype(np.uint8)

    def reflectances(self, codes: Bytes) -> Floats:
        """Reflectances (n,) of codes (n,): the inverse of `codes`, but for rounding."""
        linear = np.minimum(codes, self.code)
        return self.reflectance * (linear / self.code) * exp(self._step * (codes - linear))

    @property
    def _step(self) -> float:
        """Logarithm of the ratio of neighbouring codes."""
        return log_of(self.most / self.reflectance) / max(255 - self.code, 1) or 1.0


# Of the makers' manuals. Only Hesai publishes all of its scale: the others say that it is
# logarithmic above white, or ends with an ideal retro-reflector.
COUNTS = 10_000  # of an intensity of 1 in the column signal: makers publish no such figure
SCALES = {
    "velodyne": ByteScale(100, 1.0, _BEST),
    "vls128": ByteScale(110, 1.0, _BEST),
    "ouster": ByteScale(100, 1.0, _BEST),
    "hesai": ByteScale(255, 2.55, 2.55),
}
