"""Zernike polynomials and their Cartesian gradients, by Noll index, by recurrence.

Noll index from 1, Noll normalisation (the rms over the unit disc is the coefficient), even j cosine, odd j sine, angle
from +x towards +y (R. J. Noll, doi:10.1364/JOSA.66.000207).

Each polynomial is taken as ``N P_k^(0,m)(2 rho^2 - 1) Re or Im (x + i y)^m`` with k = (n - m) / 2: the Jacobi
polynomials P by their three-term recurrence in k, the powers by products. No factorial, no angle, no division by rho:
nothing special happens at the centre, and order 100 is as good as order 4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from holocal.errors import UsageError
from holocal.optics.bench import Array


def noll_to_nm(noll: int) -> tuple[int, int]:
    """Return (n, m) of a Noll index; m > 0 is the cosine, m < 0 the sine.

    >>> [noll_to_nm(j) for j in (1, 2, 3, 4, 5, 6)]
    [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2)]
    """
    if noll < 1:
        raise UsageError(f"Noll index {noll} does not exist; the first is 1.")
    n = int((np.sqrt(8 * noll - 7) - 1) / 2)
    within = noll - n * (n + 1) // 2  # 1 .. n + 1 inside the order
    m = 2 * (within // 2) if n % 2 == 0 else 2 * ((within + 1) // 2) - 1
    return n, m if noll % 2 == 0 else -m


def nm_to_noll(n: int, m: int) -> int:
    """Return the Noll index of (n, m).

    >>> nm_to_noll(4, -2)
    13
    """
    if n < 0 or abs(m) > n or (n - m) % 2:
        raise UsageError(f"There is no Zernike polynomial of order n = {n} and m = {m}.")
    first = n * (n + 1) // 2
    if m == 0:
        return first + 1
    low = first + abs(m)  # the two of this |m| are `low` and `low + 1`; the cosine is the even one
    return low + (low % 2 if m > 0 else 1 - low % 2)


def zernike(noll: Sequence[int], x: Array, y: Array) -> Array:
    """Return the polynomials, (len(noll), ...), at points of the plane in units of the disc's radius.

    Parameters
    ----------
    noll
        Noll indices, in any order.
    x, y
        (...) coordinates; the unit disc is where they are orthonormal, outside they grow as polynomials do.
    """
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    u = 2 * (x * x + y * y) - 1
    out = np.empty((len(noll), *x.shape))
    for m, places in _by_azimuth(noll).items():
        power = _power(x, y, m)
        for k, radial in _jacobi(0, m, u, max(k for _, k, _ in places)):
            for i, _, sine in (p for p in places if p[1] == k):
                out[i] = _norm(m, k) * radial * (power.imag if sine else power.real)
    return out


def zernike_gradient(noll: Sequence[int], x: Array, y: Array) -> Array:
    """Return the gradients (d/dx, d/dy), (len(noll), ..., 2), per radius of the disc.

    With P' = (k + m + 1) / 2 P_{k-1}^(1,m+1) and d(x + iy)^m = m (x + iy)^(m-1) (1, i).
    """
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    u = 2 * (x * x + y * y) - 1
    out = np.empty((len(noll), *x.shape, 2))
    for m, places in _by_azimuth(noll).items():
        power = _power(x, y, m)
        lower = m * _power(x, y, m - 1) if m else np.zeros_like(power)
        last = max(k for _, k, _ in places)
        slopes = _jacobi(1, m + 1, u, last - 1)
        for k, radial in _jacobi(0, m, u, last):
            slope = (k + m + 1) / 2 * next(slopes)[1] if k else 0.0
            for i, _, sine in (p for p in places if p[1] == k):
                part, dx, dy = (power.imag, lower.imag, lower.real) if sine else (power.real, lower.real, -lower.imag)
                out[i, ..., 0] = _norm(m, k) * (4 * x * slope * part + radial * dx)
                out[i, ..., 1] = _norm(m, k) * (4 * y * slope * part + radial * dy)
    return out


def _by_azimuth(noll: Sequence[int]) -> dict[int, list[tuple[int, int, bool]]]:
    """Return {|m|: [(place in the output, k, is it the sine)]}."""
    groups: dict[int, list[tuple[int, int, bool]]] = {}
    for i, j in enumerate(noll):
        n, m = noll_to_nm(j)
        groups.setdefault(abs(m), []).append((i, (n - abs(m)) // 2, m < 0))
    return groups


def _norm(m: int, k: int) -> float:
    n = m + 2 * k
    return float(np.sqrt((n + 1) * (2 if m else 1)))


def _power(x: Array, y: Array, m: int) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    """Return (x + iy)^m by repeated squaring: no angle, exact at the centre."""
    base, out = x + 1j * y, np.ones(x.shape, np.complex128)
    while m:
        if m & 1:
            out = out * base
        base, m = base * base, m >> 1
    return out


def _jacobi(a: int, b: int, u: Array, last: int) -> Iterator[tuple[int, Array]]:
    """Yield (k, P_k^(a,b)(u)) for k = 0 .. last by the three-term recurrence (DLMF 18.9.2)."""
    before, now = np.zeros_like(u), np.ones_like(u)
    for k in range(last + 1):
        yield k, now
        s = 2 * k + a + b
        if k == 0:
            before, now = now, (a + 1) + (a + b + 2) * (u - 1) / 2
            continue
        scale = 2 * (k + 1) * (k + a + b + 1) * s
        linear = (s + 1) * (s * (s + 2) * u + (a * a - b * b))
        before, now = now, (linear * now - 2 * (k + a) * (k + b) * (s + 2) * before) / scale
