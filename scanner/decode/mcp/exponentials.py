"""e^x and ln x of float32 as sums and products, so that loops that hold them run in vector registers.

The compiler calls the C library's functions one value at a time. Relative errors (of the logarithm near 1: absolute)
are below 1.5e-7: two roundings of float32.
"""

from __future__ import annotations

import numpy as np

from scanner.kernel import contracting_kernel

LOG2_E = np.float32(1.442695041)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
"""ln 2 in two parts: the first has few bits, so that its small multiples are exact."""

LOWEST = np.float32(-87.0)
"""Below it e^x is no normal float32."""

LOG_TERMS = tuple(
    np.float32(term)
    for term in (
        0.078666676,
        -0.128217494,
        0.131016338,
        -0.141890003,
        0.166276,
        -0.200019689,
        0.250007722,
        -0.333333215,
        0.499999977,
    )
)
"""(m - ln(1 + m)) / m^2 by powers of m from the eighth down: least squares at Chebyshev's points of sqrt(1/2) - 1 ..
sqrt 2 - 1, 1e-8 off at most."""


@contracting_kernel
def exp_of(x: np.float32) -> np.float32:
    """e^x for x <= 0; e^-87 for what is lower."""
    x = max(x, LOWEST)
    n = np.floor(x * LOG2_E + np.float32(0.5))
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    # Least squares at Chebyshev's points of -ln 2 / 2 .. ln 2 / 2: 3e-9 off at most.
    p = np.float32(1.39485806e-3)
    p = p * r + np.float32(8.37512889e-3)
    p = p * r + np.float32(4.16662183e-2)
    p = p * r + np.float32(1.66664155e-1)
    p = p * r + np.float32(5.00000011e-1)
    p = (p * r * r + r) + np.float32(1)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    result: np.float32 = p * power
    return result


@contracting_kernel
def log_of(x: np.float32) -> np.float32:
    """Natural logarithm of a normal x > 0."""
    bits = np.float32(x).view(np.int32)
    exponent = np.int32((bits >> np.int32(23)) - np.int32(127))
    m = np.int32((bits & np.int32(0x007FFFFF)) | np.int32(0x3F800000)).view(np.float32)
    large = m > np.float32(1.41421356)
    n = np.float32(exponent) + (np.float32(1) if large else np.float32(0))
    m = (np.float32(0.5) * m if large else m) - np.float32(1)
    # ln(1 + m) = m - m^2 p(m)
    p = LOG_TERMS[0]
    for k in range(1, len(LOG_TERMS)):
        p = p * m + LOG_TERMS[k]
    result: np.float32 = n * LN2_HIGH + (m - (m * m * p - n * LN2_LOW))
    return result
