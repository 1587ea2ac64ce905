"""Scales on which manufacturers report range-corrected reflectances as single bytes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..media.materials import RETRO_GAIN
from ..numerics.arrays import Bytes, Floats
from ..numerics.elementary import exp, log
from ..numerics.elementary_scalars import log_of

_BEST = 8 * RETRO_GAIN  # reflectance of the best retroreflective sheeting


class ByteScale(NamedTuple):
    """Scale of reflectances as bytes, linear up to `code` and logarithmic above."""

    code: int
    reflectance: float  # reflectance at `code`
    max_reflectance: float  # reflectance at code 255

    def encode(self, reflectance: Floats) -> Bytes:
        """Encode reflectances as bytes.

        Reflectances above the end of the scale have the code 255. Both arrays have shape (n,).
        """
        return np.rint(self.unrounded_codes(reflectance)).astype(np.uint8)

    def unrounded_codes(self, reflectance: Floats) -> Floats:
        """Return the codes of reflectances before they are rounded, from 0 to 255.

        Both arrays have shape (n,).
        """
        fraction = reflectance / self.reflectance
        code = self.code * np.minimum(fraction, 1)
        bright = np.flatnonzero(fraction > 1)
        code[bright] += log(fraction[bright]) / self._step
        return np.minimum(code, 255)

    def decode(self, codes: Bytes | Floats) -> Floats:
        """Decode codes to reflectances. This inverts `unrounded_codes`.

        Both arrays have shape (n,).
        """
        reflectance = self.reflectance * (np.minimum(codes, self.code) / self.code)
        bright = np.flatnonzero(codes > self.code)
        reflectance[bright] *= exp(self._step * (codes[bright] - self.code))
        return reflectance

    @property
    def _step(self) -> float:
        """Logarithm of the ratio between the reflectances of adjacent codes."""
        return log_of(self.max_reflectance / self.reflectance) / max(255 - self.code, 1) or 1.0


# Value of the column `signal` for an intensity of 1. Manufacturers do not publish this factor.
COUNTS = 10_000
# The scales follow the manufacturers' manuals. Only Hesai publishes its complete scale. The other
# manuals state that the scale is logarithmic above white, or that it ends at an ideal
# retroreflector.
SCALES = {
    "velodyne": ByteScale(100, 1.0, _BEST),
    "vls128": ByteScale(110, 1.0, _BEST),
    "ouster": ByteScale(100, 1.0, _BEST),
    "hesai": ByteScale(255, 2.55, 2.55),
    "livox": ByteScale(150, 1.0, _BEST),
}
