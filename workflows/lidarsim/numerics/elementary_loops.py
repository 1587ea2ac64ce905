"""Compiled loops that apply the functions in `elementary_scalars` to arrays."""

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
    """Write the sine and cosine of each number to the output arrays."""
    for k in range(len(x)):
        sine[k], cosine[k] = sin_cos(x[k])


@compiled()
def exp_each(x, result):
    """Write the exponential of each number to the output array."""
    for k in range(len(x)):
        result[k] = exp(x[k])


@compiled()
def log_each(x, result):
    """Write the natural logarithm of each number to the output array."""
    for k in range(len(x)):
        result[k] = log(x[k])


@compiled()
def arctan2_each(y, x, result):
    """Write the angle of each vector to the output array."""
    for k in range(len(x)):
        result[k] = arctan2(y[k], x[k])
