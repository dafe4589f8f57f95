"""Pictures of dot targets and of holographic spots, with the truth: where each dot is, and its row and column."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

FINER = 4  # sub-pixels along each axis: a disc's coverage of a pixel is then known to 1 %


@dataclass(frozen=True)
class Target:
    """A target as the camera sees it; lengths in pixels, angles in degrees, `k1` at the picture's corner."""

    width: int = 900
    height: int = 700
    spacing: float = 24.0
    radius: float = 6.0
    rotation: float = 0.0
    k1: float = 0.0
    perspective: tuple[float, float] = (0.0, 0.0)  # the change of scale from the middle to the edge, along x and y
    aspect: float = 1.0
    dark: bool = True
    contrast: float = 0.75
    blur: float = 0.8
    noise: float = 0.01
    missing: float = 0.0
    dark_quadrant: float = 1.0  # light in one quadrant
    vignetting: float = 0.0
    stains: int = 0
    sizes: float = 0.0  # standard deviation of the dots' log radius
    marked: tuple[tuple[int, int], ...] = ()  # (column, row) of dots 1.6 times as large
    shadow: float = 12.0  # pixels over which the quadrant's light falls off
    ruler: float = 0.0  # height in spacings of a bar across the picture, below the middle
    seed: int = 0

    def but(self, **changes) -> Target:
        return replace(self, **changes)


@dataclass(frozen=True)
class Seen:
    """`image` (h, w); of every dot wholly in the picture `centre` (n, 2), `row`, `column` (n,), whether `shown`."""

    image: np.ndarray
    centre: np.ndarray
    row: np.ndarray
    column: np.ndarray
    shown: np.ndarray


def place(target: Target, lattice: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) of lattice points (n, 2), (column, row) about the middle."""
    angle = np.deg2rad(target.rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    at = lattice * np.array([1.0, target.aspect]) * target.spacing @ turn.T
    half = np.array([target.width, target.height]) / 2
    at = at / (1 + (at / half) @ np.array(target.perspective))[:, None]
    r2 = (at**2).sum(axis=1) / (half**2).sum()
    return at * (1 + target.k1 * r2)[:, None] + half - 0.5


def picture(target: Target) -> Seen:
    """Return the target's picture: discs averaged over each pixel, blurred, unevenly lit, with noise and stains."""
    rng = np.random.default_rng(target.seed)
    reach = int(1.6 * np.hypot(target.width, target.height) / target.spacing / min(1, target.aspect) / 2) + 2
    column, row = (k.ravel() for k in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)))
    lattice = np.column_stack([column, row]).astype(float)
    half = np.array([target.width, target.height]) / 2
    # Lattice points whose image folds back or lies near the horizon are not on the target.
    step = 1e-3
    centre = place(target, lattice)
    du = (place(target, lattice + np.array([step, 0])) - centre) / step
    dv = (place(target, lattice + np.array([0, step])) - centre) / step
    area = (du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]) / target.spacing**2 / target.aspect
    radius = target.radius * np.sqrt(np.clip(area, 0.01, 10))
    inside = (np.abs(centre - half + 0.5) < half + radius[:, None] + 1).all(axis=1) & (area > 0.15)
    inside &= _unfolded(target, lattice)
    centre, row, column, radius = centre[inside], row[inside], column[inside], radius[inside]
    if target.sizes:
        radius = radius * np.exp(rng.normal(0, target.sizes, len(radius)))
    for c, r in target.marked:
        radius[(column == c) & (row == r)] *= 1.6
    shown = rng.random(len(centre)) >= target.missing
    if target.ruler:
        top, bottom = bar(target)
        shown &= (centre[:, 1] + radius < top - 2) | (centre[:, 1] - radius > bottom + 2)
    cover = coverage(target.width, target.height, centre[shown], radius[shown])
    if target.blur:
        cover = cv2.GaussianBlur(cover, (0, 0), target.blur)
    y, x = np.mgrid[: target.height, : target.width]
    light = 1 - target.vignetting * (((x - half[0]) ** 2 + (y - half[1]) ** 2) / (half**2).sum())
    across, down = (np.clip(at / target.shadow, -30, 30) for at in (x - half[0], y - half[1]))
    soft = 1 / (1 + np.exp(-across)) / (1 + np.exp(-down))
    light = light * (1 - (1 - target.dark_quadrant) * soft)
    image = light * ((1 - target.contrast * cover) if target.dark else (1 - target.contrast + target.contrast * cover))
    if target.ruler:
        image[top:bottom] = 0.6
        image[top : (top + bottom) // 2, :: max(4, round(target.spacing / 3))] = 0.05
    for _ in range(target.stains):
        at, size = rng.uniform([0, 0], 2 * half), rng.uniform(0.3, 1.2) * target.spacing
        image = image * (1 - rng.uniform(0.2, 0.6) * np.exp(-0.5 * ((x - at[0]) ** 2 + (y - at[1]) ** 2) / size**2))
    image = 0.8 * image + target.noise * rng.normal(size=image.shape)
    image = np.clip(np.round(image * 255), 0, 255) / 255
    whole = (centre - radius[:, None] > 1).all(axis=1) & (centre + radius[:, None] < 2 * half - 2).all(axis=1)
    return Seen(image.astype(np.float32), centre[whole], row[whole], column[whole], shown[whole])


def bar(target: Target) -> tuple[int, int]:
    """Return the first row of the ruler and the first below it."""
    top = round(0.6 * target.height)
    return top, top + round(target.ruler * target.spacing)


def _unfolded(target: Target, lattice: np.ndarray) -> np.ndarray:
    """Return which lattice points (n, 2) are before the horizon and before the barrel's turning point."""
    angle = np.deg2rad(target.rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    at = lattice * np.array([1.0, target.aspect]) * target.spacing @ turn.T
    half = np.array([target.width, target.height]) / 2
    depth = 1 + (at / half) @ np.array(target.perspective)
    r2 = (at**2).sum(axis=1) / np.where(depth > 0.2, depth, np.inf) ** 2 / (half**2).sum()
    return (depth > 0.2) & (1 + 3 * target.k1 * r2 > 0.2)


def coverage(width: int, height: int, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the share (height, width) of each pixel that discs cover."""
    fine = np.zeros((height * FINER, width * FINER), np.float32)
    for (cx, cy), r in zip((centre + 0.5) * FINER - 0.5, radius * FINER, strict=True):
        x0, x1 = max(0, int(cx - r - 2)), min(fine.shape[1], int(cx + r + 3))
        y0, y1 = max(0, int(cy - r - 2)), min(fine.shape[0], int(cy + r + 3))
        if x0 < x1 and y0 < y1:
            y, x = np.ogrid[y0:y1, x0:x1]
            patch = fine[y0:y1, x0:x1]
            np.maximum(patch, np.clip(r - np.hypot(x - cx, y - cy) + 0.5, 0, 1), out=patch)
    return fine.reshape(height, FINER, width, FINER).mean(axis=(1, 3))


def spots(target: Target, *, sigma: float = 2.5, grain: float = 1.6, ghosts: float = 0.15) -> Seen:
    """Return a holographic frame: speckled spots on dark, ghosts mirrored through the middle, a bright zero order."""
    seen = picture(target.but(noise=0.0, blur=0.0, dark=False, stains=0, missing=0.0, dark_quadrant=1.0))
    rng = np.random.default_rng(target.seed + 1)
    shown = rng.random(len(seen.centre)) >= target.missing
    half = np.array([target.width, target.height]) / 2
    y, x = np.mgrid[: target.height, : target.width]
    amplitude = cv2.GaussianBlur(rng.normal(size=(*seen.image.shape, 2)), (0, 0), grain)
    speckle = (amplitude**2).sum(axis=2)
    speckle /= speckle.mean()
    light = np.zeros(seen.image.shape)

    def add(at: np.ndarray, strength: float, width: float) -> None:
        c, r, reach = round(at[0]), round(at[1]), int(5 * width) + 1
        rows, columns = slice(max(0, r - reach), r + reach + 1), slice(max(0, c - reach), c + reach + 1)
        d2 = (x[rows, columns] - at[0]) ** 2 + (y[rows, columns] - at[1]) ** 2
        light[rows, columns] += strength * np.exp(-0.5 * d2 / width**2)

    for at in seen.centre[shown]:
        add(at, rng.uniform(0.6, 1.4), sigma)
        add(2 * half - at + [0.31 * target.spacing, 0.22 * target.spacing], ghosts, sigma)
    soft = 1 / (1 + np.exp(-(x - half[0]) / 12)) / (1 + np.exp(-(y - half[1]) / 12))
    light = (light + 0.02) * (1 - (1 - target.dark_quadrant) * soft) * speckle
    zero = half + np.array([0.4 * target.spacing, -0.3 * target.spacing])
    light = light + 20 * np.exp(-0.5 * ((x - zero[0]) ** 2 + (y - zero[1]) ** 2) / (0.4 * target.spacing) ** 2)
    counts = rng.poisson(light * 300) + rng.normal(0, 3, light.shape)
    image = np.clip(np.round(counts + 20), 0, 4095) / 4095
    return Seen(image.astype(np.float32), seen.centre, seen.row, seen.column, shown)
