"""Zernike polynomials against closed forms, exact rational arithmetic, quadrature and differences."""

from __future__ import annotations

from fractions import Fraction
from math import factorial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import UsageError
from holocal.optics.zernike import nm_to_noll, noll_to_nm, zernike, zernike_gradient

# Noll 1976, table I, in polar coordinates
CLOSED_FORMS = {
    1: lambda r, t: np.ones_like(r),
    2: lambda r, t: 2 * r * np.cos(t),
    3: lambda r, t: 2 * r * np.sin(t),
    4: lambda r, t: np.sqrt(3) * (2 * r**2 - 1),
    5: lambda r, t: np.sqrt(6) * r**2 * np.sin(2 * t),
    6: lambda r, t: np.sqrt(6) * r**2 * np.cos(2 * t),
    7: lambda r, t: np.sqrt(8) * (3 * r**3 - 2 * r) * np.sin(t),
    8: lambda r, t: np.sqrt(8) * (3 * r**3 - 2 * r) * np.cos(t),
    9: lambda r, t: np.sqrt(8) * r**3 * np.sin(3 * t),
    10: lambda r, t: np.sqrt(8) * r**3 * np.cos(3 * t),
    11: lambda r, t: np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
    12: lambda r, t: np.sqrt(10) * (4 * r**4 - 3 * r**2) * np.cos(2 * t),
    13: lambda r, t: np.sqrt(10) * (4 * r**4 - 3 * r**2) * np.sin(2 * t),
    14: lambda r, t: np.sqrt(10) * r**4 * np.cos(4 * t),
    15: lambda r, t: np.sqrt(10) * r**4 * np.sin(4 * t),
}


def disc_points(count, seed=0):
    rng = np.random.default_rng(seed)
    r, t = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return r * np.cos(t), r * np.sin(t)


@pytest.mark.parametrize("j", CLOSED_FORMS)
def test_the_first_fifteen_are_nolls_own(j):
    x, y = disc_points(200)
    found = zernike([j], x, y)[0]
    assert np.allclose(found, CLOSED_FORMS[j](np.hypot(x, y), np.arctan2(y, x)), atol=1e-13)


def test_tilts_point_along_plus_x_and_plus_y():
    assert zernike([2, 3], np.array(0.5), np.array(0.0)).tolist() == [1.0, 0.0]
    assert zernike([2, 3], np.array(0.0), np.array(0.5)).tolist() == [0.0, 1.0]


@given(st.integers(1, 100_000))
@settings(deadline=None)
def test_noll_index_and_order_are_each_others_inverse(j):
    n, m = noll_to_nm(j)
    assert abs(m) <= n
    assert (n - m) % 2 == 0
    assert m == 0 or (m > 0) == (j % 2 == 0)
    assert nm_to_noll(n, m) == j


@pytest.mark.parametrize("call", [lambda: noll_to_nm(0), lambda: nm_to_noll(3, 2), lambda: nm_to_noll(2, -4)])
def test_indices_that_do_not_exist_are_refused(call):
    with pytest.raises(UsageError):
        call()


def test_they_are_orthonormal_over_the_disc():
    # Gauss-Legendre in rho^2 and an even circle integrate products of order up to 2 x 21 exactly
    node, weight = np.polynomial.legendre.leggauss(30)
    r, t = np.sqrt((node + 1) / 2), 2 * np.pi * np.arange(64) / 64
    x, y = (r[:, None] * f(t) for f in (np.cos, np.sin))
    z = zernike(range(1, 232), x, y)  # orders 0 to 20
    gram = np.einsum("irt,jrt,r->ij", z, z, weight / 2 / 64)
    assert np.abs(gram - np.eye(231)).max() < 1e-12  # 30 x 64 terms of rounding


def rational_radial(n, m, r):
    """Return R_n^m at a Fraction from the factorial formula, exactly."""
    total = Fraction(0)
    for s in range((n - m) // 2 + 1):
        c = factorial(n - s) // (factorial(s) * factorial((n + m) // 2 - s) * factorial((n - m) // 2 - s))
        total += (-1) ** s * c * r ** (n - 2 * s)
    return total


@pytest.mark.parametrize(("n", "m"), [(20, 0), (21, 7), (40, 0), (40, 2), (40, 38), (40, 40), (39, 1), (60, 10)])
def test_high_orders_agree_with_exact_rational_arithmetic(n, m):
    j = nm_to_noll(n, m)
    norm = np.sqrt((n + 1) * (2 if m else 1))
    for r in (Fraction(0), Fraction(1, 8), Fraction(1, 2), Fraction(7, 8), Fraction(255, 256), Fraction(1)):
        x = np.array(float(r))
        exact = norm * float(rational_radial(n, m, r))
        assert abs(float(zernike([j], x, np.array(0.0))[0]) - exact) < 1e-11
        # d/dr of the factorial formula, along x where cos(m t) is stationary
        step = Fraction(1, 10**9)
        slope = norm * float((rational_radial(n, m, r + step) - rational_radial(n, m, r - step)) / (2 * step))
        found = zernike_gradient([j], x, np.array(0.0))[0, 0]
        # the difference quotient's own error is f''' step^2 / 6: n^6 1e-18 = 5e-8 at order 60
        assert abs(found - slope) < 1e-11 * max(abs(slope), 1.0) + norm * n**6 * 1e-18


def test_gradients_agree_with_differences_in_every_direction():
    x, y = disc_points(50, seed=1)
    step = 1e-6
    js = list(range(1, 67))
    found = zernike_gradient(js, x, y)
    for axis, (dx, dy) in enumerate(((step, 0), (0, step))):
        slope = (zernike(js, x + dx, y + dy) - zernike(js, x - dx, y - dy)) / (2 * step)
        assert np.abs(found[..., axis] - slope).max() < 1e-6  # rounding: 1e-16 x 10 / 1e-6, times the slope's 100


def test_nothing_special_happens_at_the_centre():
    js = list(range(1, 862))  # to order 40
    zero = np.zeros(1)
    assert np.isfinite(zernike(js, zero, zero)).all()
    gradient = zernike_gradient(js, zero, zero)[:, 0]
    assert np.isfinite(gradient).all()
    assert gradient[1].tolist() == [2.0, 0.0]
    assert gradient[2].tolist() == [0.0, 2.0]


def test_batches_keep_their_shape():
    x, y = np.zeros((4, 1, 3)), np.ones((5, 1))
    assert zernike([1, 7, 4], x, y).shape == (3, 4, 5, 3)
    assert zernike_gradient([1, 7, 4], x, y).shape == (3, 4, 5, 3, 2)
