"""The picture of a posterior in a report: what it draws, the same bytes, and what is too much or too little for it."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from matplotlib.text import Text
from synthetic import generator

from holocal.app.report.corner import MOST, draw_corner
from holocal.app.report.drawing import data_uri, draw
from holocal.loop.figures import read_figures, write_figures
from holocal.loop.procedure import Figure

COVARIANCE = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, 0.0], [0.0, 0.0, 1e-4]])


def posterior(count=2000, dimensions=3, **arrays):
    """A figure of Gaussian samples; the first three parameters have COVARIANCE."""
    samples = generator(1, dimensions).normal(size=(count, dimensions))
    samples[:, :3] = samples[:, :3] @ np.linalg.cholesky(COVARIANCE[:dimensions, :dimensions]).T
    labels = tuple(f"Z{k + 4}, rad" for k in range(dimensions))
    return Figure("posterior", "Posterior of zone 3", "corner", {"samples": samples, **arrays}, labels=labels)


CONSTANT = np.hstack([np.ones((300, 1)), posterior(300).arrays["samples"]])
HOLED = np.where(np.eye(400, 2) > 0, np.nan, posterior(400, 2).arrays["samples"])


def words(canvas):
    """Every text of a canvas that is seen."""
    return [text.get_text() for text in canvas.findobj(Text) if text.get_visible()]


def test_a_corner_is_drawn_and_twice_the_same():
    figure = posterior(truth=np.zeros(3), laplace_mean=np.zeros(3), laplace_covariance=COVARIANCE)
    first = draw(figure)
    assert first == draw(figure)
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(first.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[0] > 600 and picture.std() > 10  # not blank


def test_a_corner_names_its_parameters_and_what_is_drawn_over_them():
    canvas = draw_corner(posterior(truth=np.zeros(3), laplace_mean=np.zeros(3), laplace_covariance=COVARIANCE))
    assert {"Z4, rad", "Z5, rad", "Z6, rad", "Posterior of zone 3"} <= set(words(canvas))
    assert {"samples, 1 and 2 sigma", "Laplace fit", "truth"} <= set(words(canvas))
    bare = words(draw_corner(posterior()))
    assert "Laplace fit" not in bare and "truth" not in bare


def test_the_ellipses_are_those_of_one_and_two_sigma_with_x_along_the_column():
    mean = np.array([0.1, -0.2, 0.003])
    canvas = draw_corner(posterior(laplace_mean=mean, laplace_covariance=COVARIANCE))
    axes = canvas.axes[3]  # second row, first column: parameter 0 along x, 1 along y
    for sigmas, line in zip((1, 2), axes.lines[-2:], strict=True):
        off = line.get_xydata() - mean[:2]
        away = np.einsum("ni,ij,nj->n", off, np.linalg.inv(COVARIANCE[:2, :2]), off)
        np.testing.assert_allclose(away, sigmas**2, rtol=1e-9)  # rounding


def test_the_curve_over_a_histogram_holds_as_many_samples_as_it():
    canvas = draw_corner(posterior(laplace_mean=np.zeros(3), laplace_covariance=COVARIANCE))
    curve = canvas.axes[4].lines[-1].get_xydata()
    low, high = canvas.axes[4].get_xlim()
    # 30 bins; what lies outside the range is 0.4 % of a Gaussian, and less with its margins
    assert np.trapezoid(curve[:, 1], curve[:, 0]) / ((high - low) / 30) == pytest.approx(2000, rel=0.01)


def test_of_too_many_parameters_the_first_twelve_are_drawn_and_the_picture_says_so():
    canvas = draw_corner(posterior(400, MOST + 3, truth=np.zeros(MOST + 3)))
    assert len(canvas.axes) == MOST**2
    said = words(canvas)
    assert "Posterior of zone 3 (the first 12 of 15 parameters)" in said
    assert "Z15, rad" in said and "Z16, rad" not in said


@pytest.mark.parametrize("count", [0, 1, 99])
def test_too_few_samples_are_said_to_make_no_picture(count):
    canvas = draw_corner(posterior(count))
    assert f"{count} samples: fewer than 100 make no picture." in words(canvas)
    assert data_uri(canvas).startswith("data:image/png")


@pytest.mark.parametrize(
    "figure",
    [
        posterior(100),
        posterior(500, 1, truth=np.array([0.2]), laplace_mean=np.zeros(1), laplace_covariance=np.eye(1)),
        posterior(truth=np.array([1e9, 0.0, 0.0])),
        posterior(truth=np.full(3, np.nan), laplace_mean=np.zeros(2), laplace_covariance=COVARIANCE),
        Figure("p", "Constant", "corner", {"samples": CONSTANT}),
        Figure("p", "Holed", "corner", {"samples": HOLED}),
    ],
    ids=["few", "one parameter", "truth far off", "unknown truth, no whole fit", "a constant", "not finite"],
)
def test_whatever_the_samples_are_a_picture_comes_of_them(figure):
    assert draw(figure).startswith("data:image/png")


def test_names_of_parameters_are_kept_with_the_run(tmp_path):
    figure = posterior(truth=np.zeros(3))
    write_figures(tmp_path, [figure, Figure("other", "Other", "curve", {"y": np.arange(3.0)})])
    kept, other = read_figures(tmp_path)
    assert kept.labels == figure.labels and other.labels == ()
    assert draw(kept) == draw(figure)
