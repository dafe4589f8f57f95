"""Zernike polynomials to radial order 40 (Noll 861): orthonormal, bounded, their phases right to 1e3 rad."""

from __future__ import annotations

from fractions import Fraction
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.hologram.warped_sum import phasor
from holocal.optics.zernike import noll_to_nm, zernike, zernike_gradient

LAST = 861  # the last of order 40
ALL = range(1, LAST + 1)


def disc(rings=42, spokes=84):
    """Nodes and weights that integrate polynomials of degree 82 over the unit disc exactly, mean 1."""
    node, weight = np.polynomial.legendre.leggauss(rings)
    r, t = np.sqrt((node + 1) / 2), 2 * np.pi * np.arange(spokes) / spokes
    x, y = ((r[:, None] * f(t)).ravel() for f in (np.cos, np.sin))
    return x, y, np.repeat(weight / 2 / spokes, spokes)


def exact(noll, x, y):
    """Return Z_j at Fractions times 1 / norm, exactly, and the norm: real and imaginary parts of (x + iy)^m in whole
    numbers, the radial part from its binomials."""
    n, m = noll_to_nm(noll)
    r2, a = x * x + y * y, abs(m)
    total = Fraction(0)
    for s in range((n - a) // 2 + 1):
        total += (-1) ** s * comb(n - s, s) * comb(n - 2 * s, (n - a) // 2 - s) * r2 ** ((n - a) // 2 - s)
    re, im = Fraction(1), Fraction(0)
    for _ in range(a):
        re, im = re * x - im * y, re * y + im * x
    return total * (im if m < 0 else re), (n + 1) * (2 if m else 1)


def test_all_861_are_orthonormal():
    x, y, weight = disc()
    z = zernike(ALL, x, y)
    gram = (z * weight) @ z.T
    assert np.abs(gram - np.eye(LAST)).max() < 1e-11  # 3528 terms of up to 82, rounded to 1e-16 each


def test_all_861_gradients_have_the_squared_norm_that_their_order_gives():
    # in the metric I - r r^T the squared norm is n (n + 2), and different polynomials' gradients are orthogonal
    x, y, weight = disc(44, 90)
    gradient = zernike_gradient(ALL, x, y)
    radial = gradient[..., 0] * x + gradient[..., 1] * y
    gram = np.einsum("ipk,jpk,p->ij", gradient, gradient, weight, optimize=True) - (radial * weight) @ radial.T
    order = np.array([noll_to_nm(j)[0] for j in ALL])
    assert np.abs(gram - np.diag(order * (order + 2))).max() < 1e-10 * 40 * 42


def test_nothing_exceeds_its_rim_value_on_the_disc():
    # |R_n^m| <= R_n^m(1) = 1: any loss of digits by cancellation would break this at order 40
    x, y, _ = disc()
    bound = np.array([np.sqrt((n + 1) * (2 if m else 1)) for n, m in map(noll_to_nm, ALL)])
    assert np.all(np.abs(zernike(ALL, x, y)) <= bound[:, None] * (1 + 1e-13))


def test_the_rim_and_the_centre_are_exact():
    t = 2 * np.pi * np.arange(7) / 7 + 0.3
    z = zernike(ALL, np.cos(t), np.sin(t))
    centre = zernike(ALL, np.array(0.0), np.array(0.0))
    for i, (n, m) in enumerate(map(noll_to_nm, ALL)):
        norm = np.sqrt((n + 1) * (2 if m else 1))
        # cos(t) itself is rounded: rho is 1 within 2e-16 and the slope there is n^2, 1600, times the norm, 9
        assert np.abs(z[i] - norm * (np.sin(-m * t) if m < 0 else np.cos(m * t))).max() < 1e-11
        assert centre[i] == (0.0 if m else (-1) ** (n // 2) * norm)


@pytest.mark.parametrize("noll", [820 + 1, 824, 831, 840, 860, 861, 790, 801])
def test_order_40_agrees_with_exact_rational_arithmetic_at_points_off_the_axes(noll):
    for x, y in ((3, 5), (-200, 150), (255, 1), (-1, -1), (101, -231)):
        value, square = exact(noll, Fraction(x, 256), Fraction(y, 256))
        found = float(zernike([noll], np.array(x / 256), np.array(y / 256))[0])
        assert abs(found - float(value) * np.sqrt(square)) < 1e-12


def test_gradients_of_order_40_agree_with_differences_up_to_the_rim():
    rng = np.random.default_rng(3)
    r, t = np.sqrt(np.r_[rng.random(30), 1.0, 0.0]), 2 * np.pi * rng.random(32)
    x, y, step = r * np.cos(t), r * np.sin(t), 1e-4
    found = zernike_gradient(ALL, x, y)
    for axis, (dx, dy) in enumerate(((1, 0), (0, 1))):
        # sixth-order differences: their error is f^(7) h^6 / 140, at the rim (n^2)^7 / 7!! x 1e-24 / 140 = 1e-8
        slope = sum(
            c
            * (zernike(ALL, x + i * step * dx, y + i * step * dy) - zernike(ALL, x - i * step * dx, y - i * step * dy))
            for i, c in ((1, 0.75), (2, -0.15), (3, 1 / 60))
        )
        assert np.abs(found[..., axis] - slope / step).max() < 1e-7  # of up to 40 x 42 x 9


@pytest.mark.parametrize("coefficient", [1.0, 1e3, 1e6])
def test_a_series_with_large_coefficients_is_right_modulo_2_pi(coefficient):
    # 60 terms of order up to 40, |phase| up to 60 x 9 x coefficient, against exact sums reduced in whole turns
    rng = np.random.default_rng(0)
    nolls = sorted(rng.choice(np.arange(1, LAST + 1), 60, replace=False).tolist())
    for x, y in ((0.25, -0.5), (0.703125, 0.703125), (-0.0078125, 0.99609375)):
        signs = rng.choice([-1.0, 1.0], 60)
        found = float(coefficient * signs @ zernike(nolls, np.array(x), np.array(y)))
        wanted = sum(
            np.longdouble(c * coefficient) * np.longdouble(v.numerator) / v.denominator * np.sqrt(np.longdouble(s))
            for c, (v, s) in ((c, exact(j, Fraction(x), Fraction(y))) for c, j in zip(signs, nolls, strict=True))
        )
        # 60 rounded terms of up to 9: 1e-13 per radian of coefficient
        assert abs(found - float(wanted)) < 1e-13 * coefficient + 1e-13
        turns = wanted / (2 * np.longdouble("3.14159265358979323846264338327950288"))
        rest = float(turns - np.round(turns)) * 2 * np.pi
        # float32 cosines of a phase reduced in float64: 2e-7, and what the phase itself has lost
        assert abs(complex(phasor(np.array(found))) - np.exp(1j * rest)) < 4e-7 + 2e-13 * coefficient


@given(st.integers(1, LAST), st.floats(0, 1), st.floats(0, 2 * np.pi))
@settings(deadline=None, max_examples=60, derandomize=True)
def test_turning_the_point_by_a_period_changes_nothing(noll, radius, angle):
    _, m = noll_to_nm(noll)
    turned = angle + 2 * np.pi / max(abs(m), 1)
    one, other = (float(zernike([noll], radius * np.cos(a), radius * np.sin(a))[0]) for a in (angle, turned))
    assert np.isfinite(one)
    assert one == pytest.approx(other, abs=2e-12)  # m times the rounding of an angle near 2 pi, times the norm


@pytest.mark.parametrize("shape", [(1,), (1, 1), (1, 13), (13, 1), (0,), (2, 0, 3)])
def test_arrays_of_any_shape_even_empty_keep_it(shape):
    at = np.full(shape, 0.3)
    assert zernike([1, LAST], at, at).shape == (2, *shape)
    assert zernike_gradient([1, LAST], at, at).shape == (2, *shape, 2)
    assert zernike([], at, at).shape == (0, *shape)
