"""The picture of a spot through a known frame: against the plain sum over the panel's blocks; and its derivatives."""

import numpy as np
import pytest

from holocal.estimate.field_model import fit_field, legendre_of_noll, modes_of, zone_evidence
from holocal.estimate.spot_fit import ZoneProblem, coarse_to_fine
from holocal.estimate.spot_model import BESIDE, Pupil, PupilBox, SpotModel, Window, pixel_rule, products
from holocal.estimate.zone_data import Noise, Priors, ZoneData
from holocal.optics.zernike import zernike

WAVELENGTH_M = 515e-9
K = 2 * np.pi / WAVELENGTH_M
PUPIL = Pupil(radius_m=0.8e-3, edge_m=2e-4, wavelength_m=WAVELENGTH_M)
TURN = np.radians(4.0)
PIXEL = 5.8e-4
DIRECTION = PIXEL * np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), 0.97 * np.cos(TURN)]])
RELIEF_M = 12e-3 * np.eye(2)
WINDOW = Window(100, 80, (9, 7), DIRECTION, RELIEF_M)
MIXED_M = np.array([[11.2e-3, -1.6e-3], [-1.6e-3, 13.0e-3]])  # of a zone at the 4K bench's edge
RELIEF_SLOPE = np.moveaxis(np.array([[[0.85, 0.0], [0.0, -0.74]], [[0.0, 0.79], [0.79, 0.0]]]), 0, -1)  # d R / d q
DEGREE = 4


def blocks(bend_per_m, seed=0, noise=0.1):
    """Pupil points of blocks on an even grid, and a defocused wave on them with noise of its own."""
    x = np.arange(-0.62e-3, 0.45e-3, 1.4e-5)
    y = np.arange(-0.35e-3, 0.41e-3, 1.4e-5)
    q = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rng = np.random.default_rng(seed)
    grain = rng.normal(size=len(q)) + 1j * rng.normal(size=len(q))
    values = np.exp(0.5j * K * bend_per_m * np.sum(q**2, axis=1)) + noise * grain
    return q, values.astype(np.complex64)


def model_of(frames, degree=DEGREE, window=WINDOW, **bends):
    box = PupilBox.around(frames[0][0], window, 0.1e-3)
    return SpotModel(window, frames, box, PUPIL, degree=degree, **bends), box


def plain_picture(frame, wavefront, shift_m, oversample=9, relief_m=RELIEF_M, relief_slope=None):
    """Power per pixel by the plain sum: blocks to the pupil's plane to directions, finely sampled, no shortcut.

    The way to the pupil: E(ds) = sum v exp(i k q ds + i k ds R(q) ds / 2) over a wide range of directions, back to the
    pupil's plane, times its transmission, and out again.
    """
    slope = np.zeros((2, 2, 2)) if relief_slope is None else relief_slope
    q, values = frame
    values = values * np.exp(1j * wavefront(q))
    span = 60 * PIXEL  # six times the spot's width
    n = 161
    s = (np.arange(n) - n // 2) * span / n
    sx, sy = np.meshgrid(s, s)
    if relief_slope is None:
        to_s = [np.exp(1j * K * np.outer(s, axis)) for axis in (q[:, 0], q[:, 1])]
        there = np.einsum("an,bn,n->ba", to_s[0], to_s[1], values, optimize=True)
    else:
        ds = np.stack([sx.ravel(), sy.ravel()], axis=-1)
        bent = ds + 0.5 * np.einsum("ni,ijk,nj->nk", ds, slope, ds)
        there = np.concatenate([np.exp(1j * K * part @ q.T) @ values for part in np.array_split(bent, 40)])
        there = there.reshape(n, n)
    form = relief_m[0, 0] * sx**2 + 2 * relief_m[0, 1] * sx * sy + relief_m[1, 1] * sy**2
    there = there * np.exp(0.5j * K * form)
    p = np.arange(-1.1e-3, 1.1e-3, 2 * np.pi / (K * span))
    back = np.exp(-1j * K * np.outer(p, s))
    plane = back @ there @ back.T  # (p_y, p_x)
    px, py = np.meshgrid(p, p)
    z = np.clip((PUPIL.radius_m - np.hypot(px - shift_m[0], py - shift_m[1])) / PUPIL.edge_m, -0.5, 0.5)
    plane = plane * (0.5 + 0.5 * np.sin(np.pi * z)) / n**2
    out = np.zeros(WINDOW.shape)
    fine = (np.arange(oversample) - (oversample - 1) / 2) / oversample
    for row in range(WINDOW.shape[0]):
        for column in range(WINDOW.shape[1]):
            dx, dy = np.meshgrid(column - WINDOW.half[0] + fine, WINDOW.half[1] - row + fine)
            ds = np.stack([dx.ravel(), dy.ravel()], axis=-1) @ DIRECTION.T
            waves = [np.exp(1j * K * np.outer(ds[:, axis], p)) for axis in (0, 1)]
            out[row, column] = np.mean(np.abs(np.einsum("ny,yx,nx->n", waves[1], plane, waves[0])) ** 2)
    return out


def test_a_picture_is_that_of_the_plain_sum():
    frame, shift = blocks(9.0), np.array([0.15e-3, -0.1e-3])
    model, box = model_of([frame])
    terms = np.zeros(len(products(DEGREE)))
    terms[3:8] = [0.6, -0.4, 0.3, 0.2, -0.2]
    found = model.intensity(terms, np.zeros_like(terms), shift)[0].numpy()
    wanted = plain_picture(frame, lambda q: box.legendre(q, DEGREE) @ terms, shift)
    error = np.linalg.norm(found - wanted) / np.linalg.norm(wanted)
    # The way to the pupil takes the pixels' directions for orthogonal: 0.5 % at 4 degrees and 3 % of squeeze.
    assert error < 0.012


@pytest.mark.parametrize("bend_per_m", [9.0, -9.0])
def test_a_relief_that_differs_over_the_pupil_moves_rim_and_picture(bend_per_m):
    frame, shift = blocks(bend_per_m, noise=0.0), np.array([0.25e-3, -0.1e-3])
    wanted = plain_picture(frame, lambda q: 0.0 * q[:, 0], shift, relief_m=MIXED_M, relief_slope=RELIEF_SLOPE)

    def error(window, **bends):
        problem = ZoneProblem(
            model_of([frame], window=window, **bends)[0],
            ZoneData(wanted[None], np.ones((1, *window.shape), bool), np.ones(1)),
            Noise(1.0, 0.0),
        )
        vector = np.zeros(problem.layout.count)
        vector[problem.layout.shift] = 1e3 * shift
        picture = problem.expected(vector)[0]
        return np.linalg.norm(picture - wanted) / np.linalg.norm(wanted)

    # the picture's bend, in pixels of the window: D^-1 (ds (dR / dq) ds / 2) for ds = D (x, y)
    in_pixels = np.einsum("ia,ijk,jb->abk", DIRECTION, RELIEF_SLOPE, DIRECTION) / 2 @ np.linalg.inv(DIRECTION).T
    curve = np.stack([in_pixels[0, 0], in_pixels[0, 1] + in_pixels[1, 0], in_pixels[1, 1]], axis=-1)
    whole = Window(100, 80, (9, 7), DIRECTION, MIXED_M, RELIEF_SLOPE, curve)
    modelled = error(whole, bends_per_m=[bend_per_m], bent_about_m=np.zeros(2))
    assert modelled < 0.009
    assert error(whole) > 1.3 * modelled  # the rim where the mean relief has it
    assert error(Window(100, 80, (9, 7), DIRECTION, MIXED_M), bends_per_m=[0.0]) > 1.3 * modelled


def test_an_envelope_falls_over_the_picture():
    zero, frame = np.zeros(len(products(DEGREE))), blocks(9.0)
    plain = model_of([frame])[0].intensity(zero, zero, np.zeros(2))[0].numpy()
    sloped = Window(100, 80, (9, 7), DIRECTION, RELIEF_M, envelope=np.array([0.01, -0.02]))
    fallen = model_of([frame], window=sloped)[0].intensity(zero, zero, np.zeros(2))[0].numpy()
    assert fallen[2, 15] / plain[2, 15] == pytest.approx(np.exp(0.01 * 6 - 0.02 * 5), rel=1e-4)  # 6 right, 5 up


def test_row_0_is_on_top_and_columns_run_to_the_right():
    q, values = blocks(0.0, noise=0.0)
    tilted = values * np.exp(1j * K * q @ (-DIRECTION @ np.array([4.0, 3.0])))  # seen at 4 pixels right, 3 up
    model, _ = model_of([(q, tilted.astype(np.complex64))])
    zero = np.zeros(len(products(DEGREE)))
    picture = model.intensity(zero, zero, np.zeros(2))[0].numpy()
    row, column = np.unravel_index(picture.argmax(), picture.shape)
    assert (column - WINDOW.half[0], WINDOW.half[1] - row) == (4, 3)


def problem_of(model, vector_of=None, seed=1, peak=3000.0):
    """Counts of a model at a vector, with noise."""
    noise = Noise(6.0, 0.41)
    shape = (model.frames, *WINDOW.shape)
    bare = ZoneProblem(model, ZoneData(np.zeros(shape), np.ones(shape, bool), np.ones(model.frames)), noise)
    vector = np.zeros(bare.layout.count) if vector_of is None else vector_of(bare)
    scale = peak / bare.expected(vector).max(axis=(1, 2))
    clean = ZoneProblem(model, ZoneData(np.zeros(shape), np.ones(shape, bool), scale), noise)
    counts = clean.expected(vector)
    counts = counts + np.random.default_rng(seed).normal(size=shape) * np.sqrt(noise.variance(counts))
    return ZoneProblem(model, ZoneData(counts, np.ones(shape, bool), scale), noise), vector


def random_vector(problem, seed=5):
    rng, layout = np.random.default_rng(seed), problem.layout
    vector = np.zeros(layout.count)
    vector[layout.wavefront] = rng.normal(0, 0.3, layout.terms - 1)
    vector[layout.amplitude] = rng.normal(0, 0.1, layout.amplitude_terms)
    vector[layout.shift] = [0.1, -0.15]
    vector[layout.power], vector[layout.tilt] = 0.01, rng.normal(0, 0.02, 2 * (layout.frames - 1))
    vector[layout.blur], vector[layout.affine] = 0.02, rng.normal(0, 2e-3, 4)
    return vector


def test_derivatives_are_those_of_difference_quotients():
    model, _ = model_of([blocks(9.0), blocks(-9.0, 1)])
    problem, vector = problem_of(model, random_vector)
    _, slopes = problem.derivatives(vector, DEGREE)
    for i in range(problem.layout.count):
        step = np.zeros_like(vector)
        step[i] = 1e-3
        quotient = (problem.expected(vector + step) - problem.expected(vector - step)) / 2e-3
        # float32 pictures of 3000 counts leave 0.3 counts per step of 1e-3
        assert np.linalg.norm(slopes[i] - quotient) < 0.02 * np.linalg.norm(quotient) + 30.0, i


@pytest.mark.parametrize("rms", [0.3, 2.0])
def test_a_wavefront_is_found_to_the_error_that_is_given(rms):
    model, box = model_of([blocks(12.0), blocks(-12.0, 1), blocks(0.0, 2)])
    off, z = [], []
    for seed in range(3):

        def truth(problem, seed=seed):
            vector = np.zeros(problem.layout.count)
            rng = np.random.default_rng(seed)
            degree = np.array([i + j for i, j in products(DEGREE)])[1:]
            terms = np.where(degree >= 2, rng.normal(size=len(degree)) / degree**1.5, 0.0)
            values = box.legendre(blocks(0.0)[0], DEGREE)[:, 1:] @ terms
            vector[problem.layout.wavefront] = terms * rms / values.std()
            return vector

        problem, vector = problem_of(model, truth, seed)
        fit = coarse_to_fine(problem, Priors(), DEGREE)
        wave = box.legendre(blocks(0.0)[0], DEGREE)[:, 1:]
        inside = np.linalg.norm(blocks(0.0)[0], axis=1) < 0.7e-3
        q = blocks(0.0)[0][inside]
        plane = np.concatenate([np.ones((len(q), 1)), q * 1e3], axis=1)
        left = wave[inside] @ (fit.wavefront_rad - vector[fit.layout.wavefront])
        left = left - plane @ np.linalg.lstsq(plane, left, rcond=None)[0]
        off.append(left.std())
        own = fit.layout.wavefront
        z.append((fit.wavefront_rad - vector[own]) / np.sqrt(np.diag(fit.covariance)[own]))
        assert fit.converged
        assert fit.chi2 == pytest.approx(1.0, abs=0.15)  # 855 pixels: 3 standard errors of chi-square
    assert np.median(off) < 0.03
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6  # 3 draws of 14 numbers that hang together


def test_zernike_polynomials_over_a_box_are_exactly_their_legendre_products():
    box = PupilBox((0.2e-3, -0.1e-3), (0.5e-3, 0.3e-3), WINDOW.to_pupil)
    noll, rng = modes_of(DEGREE), np.random.default_rng(0)
    coefficients = rng.normal(size=len(noll))
    q = (rng.uniform(-1, 1, (60, 2)) * box.half_m + box.centre_m) @ box.to_pupil
    series = legendre_of_noll(noll, box, DEGREE, 1.5e-3) @ coefficients
    wanted = coefficients @ zernike(noll, q[:, 0] / 1.5e-3, q[:, 1] / 1.5e-3)
    assert np.allclose(box.legendre(q, DEGREE) @ series, wanted, atol=1e-12)


def test_zones_that_see_different_strips_tell_together_what_none_tells_alone():
    from holocal.estimate.field_model import ZoneEvidence

    rng = np.random.default_rng(7)
    noll = modes_of(3)
    half = (0.22, 0.22)
    tangents = np.stack(np.meshgrid(np.linspace(-0.17, 0.17, 5), np.linspace(-0.17, 0.17, 5)), axis=-1).reshape(-1, 2)
    slope = rng.normal(size=(len(noll), 3))
    truth = slope[:, 0] + tangents / 0.22 @ slope[:, 1:].T
    evidence = []
    for zone in range(25):
        seen = rng.normal(size=(3, len(noll)))  # three combinations of seven
        sigma = 0.01
        said = seen @ truth[zone] + sigma * rng.normal(size=3)
        evidence.append(ZoneEvidence(seen.T @ seen / sigma**2, seen.T @ said / sigma**2))
    evidence[6] = None  # a dead zone
    field = fit_field(evidence, tangents, half, noll)
    error = field.zones - truth
    assert np.sqrt(np.mean(error**2)) < 0.02
    spread = np.sqrt(np.array([np.diag(c) for c in field.zone_covariance]))
    assert 0.5 < np.sqrt(np.mean((error / spread) ** 2)) < 1.6
    assert np.abs(error[6]).max() < 5 * spread[6].max()
    # what the others say of a zone does not know its own word: the plain way, without it
    without = fit_field([None if z == 3 else e for z, e in enumerate(evidence)], tangents, half, noll)
    if (without.high, without.deviation) == (field.high, field.deviation):
        assert np.allclose(without.zones[3], field.predicted[3], atol=1e-6)


def test_evidence_of_a_fit_is_its_own_answer():
    model, box = model_of([blocks(12.0), blocks(-12.0, 1)])

    def truth(problem):
        vector = np.zeros(problem.layout.count)
        vector[problem.layout.wavefront][2:5] = [0.5, -0.3, 0.4]
        return vector

    problem, _ = problem_of(model, truth)
    fit = coarse_to_fine(problem, Priors(), DEGREE)
    said = zone_evidence(fit, box, DEGREE, 1.5e-3)
    own = np.linalg.solve(said.information + 1e-6 * np.eye(len(said.information)), said.weighted)
    q = blocks(0.0)[0]
    plane = np.concatenate([np.ones((len(q), 1)), q * 1e3], axis=1)
    both = [
        own @ zernike(modes_of(DEGREE), q[:, 0] / 1.5e-3, q[:, 1] / 1.5e-3),
        box.legendre(q, DEGREE)[:, 1:] @ fit.wavefront_rad,
    ]
    one, other = (v - plane @ np.linalg.lstsq(plane, v, rcond=None)[0] for v in both)
    assert (one - other).std() < 0.02


@pytest.mark.parametrize("periods", [0.4, 1.3, 2.0, 3.4])
def test_few_weighted_samples_are_the_mean_over_a_pixel(periods):
    """A slit's intensity at random places: its frequencies reach `periods` per pixel and fall off towards it."""
    rule = pixel_rule(periods)
    assert abs(rule.sum() - 1) < 3e-3 and np.allclose(rule, rule[::-1])
    rng = np.random.default_rng(3)
    fine = len(rule) - 2 * BESIDE
    places = (np.arange(len(rule)) - (len(rule) - 1) / 2) / fine
    node, weight = np.polynomial.legendre.leggauss(60)
    off, size = [], []
    for _ in range(60):
        amplitude = rng.normal(size=24) + 1j * rng.normal(size=24)
        frequency = rng.uniform(-periods / 2, periods / 2, 24)

        def light(at, a=amplitude, f=frequency):
            return np.abs(np.exp(2j * np.pi * np.outer(at, f)) @ a) ** 2

        exact = float(weight @ light(node / 2)) / 2
        off.append(float(rule @ light(places)) - exact)
        size.append(exact)
    assert np.sqrt(np.mean(np.square(off))) < 6e-3 * np.sqrt(np.mean(np.square(size)))


def test_a_window_beyond_the_picture_is_dark_there():
    picture = np.arange(1.0, 13.0).reshape(3, 4)
    window = Window(3, 0, (1, 1), DIRECTION, RELIEF_M)
    assert window.cut(picture).tolist() == [[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [7.0, 8.0, 0.0]]
    assert not window.cut(np.ones((3, 4), np.bool_))[0].any()
