"""The functions of `elementary_scalars`, compiled."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled, inlined

from . import elementary_scalars

sin_cos = inlined(elementary_scalars.sin_cos_of)
exp = inlined(elementary_scalars.exp_of)
log = inlined(elementary_scalars.log_of)
arctan2 = inlined(elementary_scalars.arctan2_of)


@compiled()
def sin_cos_each(x, sine, cosine):
    """Write sines and cosines of numbers (n,)."""
    for k in range(len(x)):
        sine[k], cosine[k] = sin_cos(x[k])


@compiled()
def exp_each(x, result):
    """Write exponentials of numbers (n,)."""
    for k in range(len(x)):
        result[k] = exp(x[k])


@compiled()
def log_each(x, result):
    """Write logarithms of numbers (n,)."""
    for k in range(len(x)):
        result[k] = log(x[k])


@compiled()
def arctan2_each(y, x, result):
    """Write angles of vectors with coordinates y (n,) and x (n,)."""
    for k in range(len(x)):
        result[k] = arctan2(y[k], x[k])
