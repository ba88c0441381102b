"""The random numbers of `simulate` again, in Python's integers and SciPy's quantiles."""

from __future__ import annotations

import numpy as np
from scipy import special

FAULTS, PROCESS, MEASUREMENT, PRIOR = range(4)
LOW = 2**32 - 1


def philox(counter, key):
    """Philox4x32 with 10 rounds (Salmon et al. 2011)."""
    c, k = list(counter), list(key)
    for _ in range(10):
        a, b = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(b >> 32) ^ c[1] ^ k[0], b & LOW, (a >> 32) ^ c[3] ^ k[1], a & LOW]
        k = [(k[0] + 0x9E3779B9) & LOW, (k[1] + 0xBB67AE85) & LOW]
    return c


def uniforms(seed, trial, sample, stream, count):
    """Numbers of one sample and purpose: two per block of the counter."""
    numbers = []
    for i in range((count + 1) // 2):
        w = philox((i, sample, trial, stream), (seed & LOW, seed >> 32))
        numbers += [(((w[j + 1] << 32 | w[j]) >> 12) + 0.5) * 2.0**-52 for j in (0, 2)]
    return np.array(numbers[:count])


def normals(seed, trial, sample, stream, count):
    return special.ndtri(uniforms(seed, trial, sample, stream, count))


def chosen(law, chance):
    """Which outcome of a law a uniform number means."""
    return int(np.searchsorted(np.cumsum(law)[:-1], chance, side="right"))
