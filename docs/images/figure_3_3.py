"""Draw thesis figure 3.3 with the simulated bench: four texts, one zone against 2 x 2 zones, and the warped patches.

``python docs/images/figure_3_3.py`` writes ``figure_3_3.png`` beside itself and prints the table of README.md.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from holocal.hologram.pipeline import render_image
from holocal.hologram.settings import HologramSettings, Warped, Zones
from holocal.optics.bench import Bench, Panel
from holocal.records.rig import load_rig
from rigs.simulated import open_rig
from rigs.simulated.rig import SimulatedRig

mpl.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float64]

PIXELS, FIELD_DEG = 750, 20.0  # of the image: what the thesis shows (4.1)
WAVELENGTH_M = 515e-9
PLACES_DEG = {"HOLO": (-6.0, 5.0), "CAL": (6.0, 5.0), "ZONE": (-6.0, -5.0), "WARP": (6.0, -5.0)}
FONT, SCALE, STROKE_PX = cv2.FONT_HERSHEY_SIMPLEX, 1.25, 2  # capitals of 0.7 degrees, strokes of 0.13
WINDOW_DEG = (2.4, 1.0)  # half width and half height of what is measured and enlarged around a text
SEED = 1
SATURATED = 1e-3  # share of pixels that may saturate
WHITE = 0.65  # of full scale is drawn white


def text_image() -> Array:
    """Return the image, (750, 750) intensities 0 to 1."""
    image = np.zeros((PIXELS, PIXELS), np.uint8)
    for text, place in PLACES_DEG.items():
        column, row = pixel_of(place, PIXELS, FIELD_DEG)
        (width, height), _ = cv2.getTextSize(text, FONT, SCALE, STROKE_PX)
        at = (round(column - width / 2), round(row + height / 2))
        cv2.putText(image, text, at, FONT, SCALE, 255, STROKE_PX, cv2.LINE_AA)
    return image / 255.0


def pixel_of(place_deg: tuple[float, float], pixels: int, field_deg: float) -> tuple[float, float]:
    """Return the (column, row) of a direction in a rectilinear picture."""
    x, y = np.tan(np.deg2rad(place_deg)) / np.tan(np.deg2rad(field_deg / 2))
    return (x * pixels + pixels - 1) / 2, (pixels - 1 - y * pixels) / 2


def settings(**choice: object) -> HologramSettings:
    """Return the thesis's panel, colour and field, with a choice of synthesis."""
    field = float(np.deg2rad(FIELD_DEG))
    start = HologramSettings(Panel(3840, 2160, 3.74e-6), Bench(), WAVELENGTH_M, (field, field))
    return replace(start, **choice)  # type: ignore[arg-type]


def photograph(rig: SimulatedRig, levels: NDArray[np.uint8]) -> Array:
    """Return the camera's picture of a frame, as a share of full scale, as bright as `SATURATED` allows."""
    rig.slm.show(levels)
    full = rig.camera.describe().full_scale
    exposure = rig.camera.set_exposure(1e-4)
    for _ in range(6):
        counts = rig.camera.grab().counts
        tail = float(np.quantile(counts, 1 - SATURATED))
        if 0.75 * full < tail < 0.98 * full:
            break
        exposure = rig.camera.set_exposure(exposure * (0.9 * full / max(tail, 1.0) if tail < full else 0.3))
    frame = rig.camera.grab()
    sys.stdout.write(f"  exposure {frame.exposure_s * 1e3:.3f} ms, saturated {frame.saturated_fraction:.2e}\n")
    return np.asarray(frame.counts, np.float64) / full


def window_of(text: str, pixels: int, field_deg: float) -> tuple[slice, slice]:
    """Return the rows and columns around a text."""
    x, y = PLACES_DEG[text]
    left, top = pixel_of((x - WINDOW_DEG[0], y + WINDOW_DEG[1]), pixels, field_deg)
    right, bottom = pixel_of((x + WINDOW_DEG[0], y - WINDOW_DEG[1]), pixels, field_deg)
    return slice(round(top), round(bottom) + 1), slice(round(left), round(right) + 1)


def on_camera(image: Array, pixels: int, field_deg: float) -> Array:
    """Return the image as a perfect display would show it to the camera."""
    scale = np.tan(np.deg2rad(field_deg / 2)) / np.tan(np.deg2rad(FIELD_DEG / 2)) * PIXELS / pixels
    at = ((np.arange(pixels) - (pixels - 1) / 2) * scale + (PIXELS - 1) / 2).astype(np.float32)
    return np.asarray(cv2.remap(image.astype(np.float32), *np.meshgrid(at, at), cv2.INTER_LINEAR), np.float64)


def sharpness(picture: Array, ideal: Array, text: str, field_deg: float) -> tuple[float, float]:
    """Return the correlation of picture and ideal around a text, and the share of its light that is on the strokes.

    The dark level is zero on this rig. Strokes: where the ideal is above 0.05.
    """
    where = window_of(text, picture.shape[0], field_deg)
    seen, wanted = picture[where], ideal[where]
    return float(np.corrcoef(seen.ravel(), wanted.ravel())[0, 1]), float(seen[wanted > 0.05].sum() / seen.sum())


def main() -> None:
    """Render, photograph, measure, draw."""
    image = text_image()
    choices = {
        "1 zone (thesis's method)": settings(method=Zones(1)),
        "2 x 2 zones (thesis's method)": settings(method=Zones(2)),
        "warped patches (holocal's default)": settings(method=Warped()),
    }
    rig = open_rig(load_rig("simulated-ideal"))
    rig.light.select(WAVELENGTH_M)
    rig.light.on()
    pixels = rig.camera.describe().width
    field_deg = float(np.rad2deg(rig.camera.describe().field_rad[0]))
    ideal = on_camera(image, pixels, field_deg)
    pictures = {}
    for name, choice in choices.items():
        sys.stdout.write(f"{name}\n")
        rendered = render_image(image, choice, seed=SEED)
        pictures[name] = photograph(rig, rendered.levels)
        for text in PLACES_DEG:
            correlation, share = sharpness(pictures[name], ideal, text, field_deg)
            sys.stdout.write(f"  {text}: correlation {correlation:.2f}, light on the strokes {share:.0%}\n")
    rig.close()
    draw(pictures, field_deg, Path(__file__).with_suffix(".png"))


def draw(pictures: dict[str, Array], field_deg: float, out: Path) -> None:
    """Draw each picture, and its four texts enlarged below it."""
    figure = plt.figure(figsize=(15, 6.85), facecolor="white")
    frame = {"left": 0.005, "right": 0.995, "bottom": 0.01, "top": 0.94}
    grid = figure.add_gridspec(2, 3, height_ratios=(4.0, 2.1), wspace=0.02, hspace=0.03, **frame)
    for column, (name, picture) in enumerate(pictures.items()):
        pixels = picture.shape[0]
        left, top = pixel_of((-8.5, 6.8), pixels, field_deg)
        right, bottom = pixel_of((8.5, -6.8), pixels, field_deg)
        whole = figure.add_subplot(grid[0, column])
        show(whole, picture[round(top) : round(bottom), round(left) : round(right)])
        whole.set_title(name, fontsize=17)
        below = grid[1, column].subgridspec(2, 2, wspace=0.02, hspace=0.02)
        for i, text in enumerate(PLACES_DEG):
            show(figure.add_subplot(below[i // 2, i % 2]), picture[window_of(text, pixels, field_deg)])
    figure.savefig(out, dpi=100, pil_kwargs={"optimize": True}, metadata={"Software": None})
    plt.close(figure)
    small = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
    levels = np.rint(small / 255.0 * 31) * (255 / 31)  # 32 greys: half the size, and nobody sees it in speckle
    cv2.imwrite(str(out), levels.astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def show(axes: plt.Axes, part: Array) -> None:
    """Draw a part of a picture, bright up to `WHITE`, with a gamma of 2 so that speckled strokes read as strokes."""
    axes.imshow(np.sqrt(np.clip(part / WHITE, 0, 1)), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


if __name__ == "__main__":
    main()
