"""Random numbers that depend on a seed and a counter alone, so that a saved stream continues with the same ones.

    u_k = (h(k, 1) + h(k, 2)) / 2^53 from 27 and 26 bits of two hashes of 32 bits;     z_k = Phi^-1(u_k)

The hash multiplies and shifts (a multiply-xorshift finaliser, twice: for the low and the high half of the counter). All
whole numbers stay below 2^49, so that C gives the same. Phi^-1 is that of Wichura, Algorithm AS 241, Applied Statistics
37 (1988), precise to 1e-16.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import kernel, log

MASK = 0xFFFFFFFF
HALF = 0xFFFF
FIRST, SECOND, GOLDEN = 0x21F0AAAD, 0xD35A2D97, 0x9E3779B9


@kernel
def multiplied(x: int, by: int) -> int:
    """x by mod 2^32."""
    return ((x & HALF) * by + ((((x >> 16) * by) & HALF) << 16)) & MASK


@kernel
def mixed(x: int) -> int:
    """A bijection of 32 bits; a xor b is (a | b) - (a & b)."""
    y = x >> 16
    x = (x | y) - (x & y)
    x = multiplied(x, FIRST)
    y = x >> 15
    x = (x | y) - (x & y)
    x = multiplied(x, SECOND)
    y = x >> 15
    return (x | y) - (x & y)


@kernel
def word(counter: int, seed: int, which: int) -> int:
    """32 bits."""
    low = mixed(((counter & MASK) + multiplied(seed & MASK, GOLDEN)) & MASK)
    return mixed((low + multiplied((counter >> 32) & MASK, FIRST) + which * GOLDEN + (seed >> 32)) & MASK)  # type: ignore[no-any-return]


@kernel
def uniform(counter: int, seed: int) -> float:
    """Between 0 and 1, neither of which it is."""
    high, low = word(counter, seed, 1) >> 5, word(counter, seed, 2) >> 6
    return (high * 67108864.0 + low + 0.5) / 9007199254740992.0  # type: ignore[no-any-return]


@kernel
def normal(counter: int, seed: int) -> float:
    """Of the standard normal distribution."""
    p = uniform(counter, seed)
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = (((((((2.5090809287301226727e3 * r + 3.3430575583588128105e4) * r + 6.7265770927008700853e4) * r
               + 4.5921953931549871457e4) * r + 1.3731693765509461125e4) * r + 1.9715909503065514427e3) * r
               + 1.3314166789178437745e2) * r + 3.3871328727963666080e0)  # fmt: skip
        low = (((((((5.2264952788528545610e3 * r + 2.8729085735721942674e4) * r + 3.9307895800092710610e4) * r
               + 2.1213794301586595867e4) * r + 5.3941960214247511077e3) * r + 6.8718700749205790830e2) * r
               + 4.2313330701600911252e1) * r + 1.0)  # fmt: skip
        return q * top / low  # type: ignore[no-any-return]
    r = np.sqrt(-log(min(p, 1.0 - p)))
    if r <= 5.0:
        r -= 1.6
        top = (((((((7.74545014278341407640e-4 * r + 2.27238449892691845833e-2) * r + 2.41780725177450611770e-1) * r
               + 1.27045825245236838258e0) * r + 3.64784832476320460504e0) * r + 5.76949722146069140550e0) * r
               + 4.63033784615654529590e0) * r + 1.42343711074968357734e0)  # fmt: skip
        low = (((((((1.05075007164441684324e-9 * r + 5.47593808499534494600e-4) * r + 1.51986665636164571966e-2) * r
               + 1.48103976427480074590e-1) * r + 6.89767334985100004550e-1) * r + 1.67638483018380384940e0) * r
               + 2.05319162663775882187e0) * r + 1.0)  # fmt: skip
    else:
        r -= 5.0
        top = (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r + 1.24266094738807843860e-3) * r
               + 2.65321895265761230930e-2) * r + 2.96560571828504891230e-1) * r + 1.78482653991729133580e0) * r
               + 5.46378491116411436990e0) * r + 6.65790464350110377720e0)  # fmt: skip
        low = (((((((2.04426310338993978564e-15 * r + 1.42151175831644588870e-7) * r + 1.84631831751005468180e-5) * r
               + 7.86869131145613259100e-4) * r + 1.48753612908506148525e-2) * r + 1.36929880922735805310e-1) * r
               + 5.99832206555887937690e-1) * r + 1.0)  # fmt: skip
    return top / low if q > 0.0 else -top / low  # type: ignore[no-any-return]
