"""Elementary functions of scalars that are bit-identical on every processor.

The functions use only +, -, *, / and sqrt, whose rounding IEEE 754 defines exactly, and scaling by
powers of two, which is exact. The maximum error is 2 units in the last place. The methods and
polynomials are taken from fdlibm (Sun Microsystems 1993). `elementary` applies the functions to
arrays, and `elementary_loops` compiles them.
"""

from __future__ import annotations

import math

import numpy as np

_POWERS_OF_TWO = np.ldexp(1.0, np.arange(-539, 514))


def sin_cos_of(x: float) -> tuple[float, float]:  # noqa: PLR0914 - compiled loops inline it
    """Return the sine and cosine of an angle in radians whose magnitude is below 2^50."""
    if not 0.0 < abs(x) < math.inf:
        return (x, 1.0) if x == 0.0 else (math.nan, math.nan)
    # Compute x - k pi / 2, where pi / 2 is a sum of three numbers and each product is computed in
    # two parts (Dekker 1971).
    k = float(math.floor(x * 0.6366197723675814 + 0.5))
    a = k * 134217729.0
    leading = a - (a - k)
    trailing = k - leading
    product = k * 1.5707963267948966
    product_error = (leading * 1.5707963407039642 - product) + leading * -1.3909067675399456e-08
    product_error = (
        product_error + trailing * 1.5707963407039642
    ) + trailing * -1.3909067675399456e-08
    second_product = k * 6.123233995736766e-17
    partial = x - product  # exact
    y = partial - product_error
    subtracted = y - partial
    remainder = (partial - (y - subtracted)) - (product_error + subtracted)
    partial = y
    y = partial - second_product
    subtracted = y - partial
    remainder += (partial - (y - subtracted)) - (second_product + subtracted)
    remainder -= (
        (leading * 6.123233932053594e-17 - second_product)
        + leading * 6.368317178484799e-25
        + trailing * 6.123233932053594e-17
        + (trailing * 6.368317178484799e-25 + k * -1.4973849048591698e-33)
    )
    partial = y
    y = partial + remainder
    remainder -= y - partial
    z = y * y
    r = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    r = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * r)
    r = 8.33333333332248946124e-03 + z * r
    v = z * y
    sine = y - ((z * (0.5 * remainder - v * r) - remainder) - v * -1.66666666666666324348e-01)
    r = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    r = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * r)
    r = z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * r))
    w = 1.0 - 0.5 * z
    cosine = w + (((1.0 - w) - 0.5 * z) + (z * r - y * remainder))
    quarter = k - 4.0 * math.floor(k * 0.25)
    if quarter == 0.0:
        return sine, cosine
    if quarter == 1.0:
        return cosine, -sine
    return (-sine, -cosine) if quarter == 2.0 else (-cosine, sine)


def exp_of(x: float) -> float:
    """Return the exponential of a number."""
    # The code has no branches, so that the compiler can vectorize loops.
    bounded = x if x < 710.0 else 710.0
    bounded = bounded if bounded > -746.0 else -746.0  # also bounds NaN
    k = math.floor(bounded * 1.4426950408889634 + 0.5)
    reduced = bounded - k * 6.93147180369123816490e-01
    correction = k * 1.90821492927058770002e-10
    y = reduced - correction
    t = y * y
    c = 6.61375632143793436117e-05 + t * (
        -1.65339022054652515390e-06 + t * 4.13813679705723846039e-08
    )
    c = y - t * (1.66666666666666019037e-01 + t * (-2.77777777770155933842e-03 + t * c))
    y = 1.0 - ((correction - (y * c) / (2.0 - c)) - reduced)
    half = k >> 1  # scaling by two factors avoids overflow, and each factor is exact
    y = float(y * _POWERS_OF_TWO[half + 539] * _POWERS_OF_TWO[k - half + 539])
    return y if x == x else x


def log_of(x: float) -> float:
    """Return the natural logarithm of a number."""
    if not 0.0 < x < math.inf:
        return x if x > 0.0 or x != x else (-math.inf if x == 0.0 else math.nan)
    y, k = math.frexp(x)
    if y < 0.7071067811865476:
        y = 2.0 * y
        k = k - 1
    f = y - 1.0
    s = f / (2.0 + f)
    z = s * s
    r = 1.818357216161805012e-01 + z * (1.531383769920937332e-01 + z * 1.479819860511658591e-01)
    r = 2.857142874366239149e-01 + z * (2.222219843214978396e-01 + z * r)
    r = z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 + z * r))
    half = 0.5 * f * f
    return k * 6.93147180369123816490e-01 - (
        (half - (s * (half + r) + k * 1.90821492927058770002e-10)) - f
    )


def arctan2_of(y: float, x: float) -> float:
    """Return the angle in radians of a vector with the components `x` and `y`.

    For the zero vector, the signs of the zeros determine the angle.
    """
    if x != x or y != y:
        return math.nan
    larger = max(abs(x), abs(y))
    smaller = min(abs(x), abs(y))
    t = smaller / larger if 0.0 < larger < math.inf else (1.0 if smaller == math.inf else 0.0)
    # Values of arctan 1/2 and arctan 1, each in two parts.
    base_angle = 0.0
    base_error = 0.0
    if t > 0.6875:
        base_angle = 0.7853981633974483
        base_error = 3.061616997868383e-17
        t = (smaller - larger) / (smaller + larger)
        if smaller == math.inf:
            t = 0.0
    elif t > 0.4375:
        base_angle = 0.4636476090008061
        base_error = 2.2698777452961687e-17
        t = (2.0 * smaller - larger) / (2.0 * larger + smaller)
    z = t * t
    w = z * z
    a = 4.97687799461593236017e-02 + w * 1.62858201153657823623e-02
    a = 9.09088713343650656196e-02 + w * (6.66107313738753120669e-02 + w * a)
    a = z * (3.33333333333329318027e-01 + w * (1.42857142725034663711e-01 + w * a))
    b = -5.83357013379057348645e-02 + w * -3.65315727442169155270e-02
    b = -1.11111104054623557880e-01 + w * (-7.69187620504482999495e-02 + w * b)
    b = w * (-1.99999999998764832476e-01 + w * b)
    angle = base_angle - ((t * (a + b) - base_error) - t)
    if abs(y) > abs(x):
        angle = 1.5707963267948966 - (angle - 6.123233995736766e-17)
    if math.copysign(1.0, x) < 0.0:
        angle = 3.141592653589793 - (angle - 1.2246467991473532e-16)
    return math.copysign(angle, y)
