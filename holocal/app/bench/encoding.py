"""Encoders: their time on the panel, and image quality as a pixel-averaging camera sees it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from holocal.app import session
from holocal.app.bench.measure import Unit, peak_memory_mib
from holocal.app.bench.synthesis import picture, settings_of, synthesise
from holocal.app.capturing import capture
from holocal.hologram.encode.direct_search import DirectSearch
from holocal.hologram.encode.double_phase import DoublePhase
from holocal.hologram.encode.encoder import Encoder, Target
from holocal.hologram.encode.error_diffusion import ErrorDiffusion
from holocal.hologram.encode.gradient_descent import GradientDescent
from holocal.hologram.encode.ifta import Encoded
from holocal.hologram.encode.ifta_encoder import Ifta
from holocal.hologram.pipeline import HologramSettings, render_image, target_of
from holocal.hologram.quality import encoder_table, photographs, psnr_db
from holocal.hologram.scenes.image import QuadraticPhase, RandomPhase, ZeroPhase
from holocal.hologram.settings import Warped
from holocal.optics.bench import image_tangents
from holocal.records.rig import load_rig

Row = dict[str, Any]
ENCODERS: tuple[tuple[str, Encoder], ...] = (
    ("IFTA, 1 iteration", Ifta(1)),
    ("IFTA, 10 iterations", Ifta(10)),
    ("gradient descent, 10 iterations", GradientDescent(10)),
    ("direct search, 2 passes", DirectSearch(2)),
    ("error diffusion", ErrorDiffusion()),
    ("double phase", DoublePhase()),
)
_VIGNETTING_DEGREE = 6
SHOWN_DEG = (12.0, 8.0)  # the part of the field that most of the pupil sees lit by the 4K panel


def on_panel(width: int, height: int, *, runs: int) -> Iterator[Row]:
    """Yield a row per encoder: time, the error that it leaves in the window, the share of the light that is signal."""
    unit, settings = Unit(height, width), settings_of(width, height, Warped())
    found = synthesise(picture(settings), settings)
    assert found is not None
    target: Target = target_of(found.field, settings)
    for name, encoder in ENCODERS:
        kept: dict[str, Encoded] = {}

        def work(encoder: Encoder = encoder, kept: dict[str, Encoded] = kept) -> None:
            kept["result"] = encoder(target)

        timing = unit.ratio(work, runs=runs)
        result = kept["result"]
        yield (
            {"table": "encoders", "size": f"{width}x{height}", "encoder": name}
            | timing.row()
            | {
                "signal_error": result.signal_error[-1],
                "efficiency": result.efficiency,
            }
        )


def one_iteration(width: int, height: int, *, runs: int) -> Row:
    """Return the cost of one IFTA iteration: six less one, in fifths."""
    unit, settings = Unit(height, width), settings_of(width, height, Warped())
    found = synthesise(picture(settings), settings)
    assert found is not None
    target = target_of(found.field, settings)
    ratios, seconds, units = [], [], []
    for _ in range(max(3, runs)):
        few = unit.ratio(lambda: Ifta(1)(target), runs=1, warm=False)
        many = unit.ratio(lambda: Ifta(6)(target), runs=1, warm=False)
        seconds.append((many.seconds - few.seconds) / 5)
        units.append((many.unit_seconds + few.unit_seconds) / 2)
        ratios.append(seconds[-1] / units[-1])
    return {
        "table": "encoders",
        "size": f"{width}x{height}",
        "encoder": "IFTA, each further iteration",
        "seconds": float(np.median(seconds)),
        "ratio_p": float(np.median(ratios)),
        "unit_seconds": float(np.median(units)),
    }


def whole_frame(width: int, height: int, *, runs: int) -> Row:
    """Return the cost from a scene of 750 x 750 points to the frame, plans warm, with seconds per stage."""
    unit, settings = Unit(height, width), settings_of(width, height, Warped())
    intensity = np.random.default_rng(7).uniform(0.05, 1.0, (750, 750))
    stages: list[dict[str, float]] = []
    seeds = iter(range(1000))

    def work() -> None:
        stages.append(render_image(intensity, settings, seed=next(seeds)).seconds)

    timing = unit.ratio(work, runs=runs)
    middle = {name: float(np.median([one[name] for one in stages[1:]])) for name in stages[-1]}
    return (
        {"table": "frame", "size": f"{width}x{height}", "work": "scene to frame, 10 iterations"}
        | timing.row()
        | {
            "stages_seconds": middle,
            "peak_memory_mib": peak_memory_mib(),
        }
    )


def fourier_quality(*, images: int, counts: tuple[int, ...]) -> Iterator[Row]:
    """Yield rows of the plain Fourier geometry that packages publish: 512 x 512 image, 1024 x 1024 panel."""
    chosen = dict(list(photographs().items())[:images])
    for row in encoder_table(chosen, counts=counts):
        yield {
            "table": "quality",
            "image": row.image,
            "start": row.start,
            "grid": row.grid,
            "encoder": row.method,
            "iterations": row.iterations,
            "ratio_p": row.pairs,
            "grid_db": row.quality.grid_db,
            "camera_db": row.quality.camera_db,
            "half_pixel_off_db": row.quality.shifted_db,
            "efficiency": row.quality.efficiency,
        }


def bench_quality(*, rig: str = "simulated-ideal") -> Iterator[Row]:
    """Yield what the camera of a rig sees of a photograph over the middle of the field, per encoder.

    PSNR of amplitudes, peak 1, after a scale that varies smoothly over the picture (total degree 6): what is left of
    the pupil and the panel at each direction is the bench's, not the encoder's. Region: the picture less 3 pixels.
    """
    image = next(iter(photographs(512).values())) ** 2
    with session.opened_rig(load_rig(rig)) as device:
        facts = device.facts()
        wavelength_m = facts.wavelengths_m[len(facts.wavelengths_m) // 2]
        settings = replace(
            settings_of(facts.slm.width, facts.slm.height, Warped()),
            wavelength_m=wavelength_m,
            fov_rad=(float(np.deg2rad(SHOWN_DEG[0])), float(np.deg2rad(SHOWN_DEG[1]))),
        )
        smooth = QuadraticPhase(wavelength_m, settings.fov_rad, settings.bench.pupil_diameter_m)
        for encoder_name, encoder, count, phase in (
            ("IFTA", Ifta(10), 10, RandomPhase(3)),
            ("IFTA", Ifta(50), 50, RandomPhase(3)),
            ("IFTA", Ifta(10), 10, smooth),
            ("IFTA", Ifta(50), 50, smooth),
            ("IFTA", Ifta(50), 50, ZeroPhase()),
            ("gradient descent", GradientDescent(10), 10, RandomPhase(3)),
            ("error diffusion", ErrorDiffusion(), 0, RandomPhase(3)),
            ("double phase", DoublePhase(), 0, RandomPhase(3)),
        ):
            shown = cv2.resize(image, _camera_pixels(settings, facts.camera.field_rad, facts.camera.width))
            shown = np.clip(shown, 0, 1)
            rendered = render_image(shown, settings, seed=3, encoder=encoder, initial_phase=phase)
            frame = capture(device, rendered.levels, wavelength_m=wavelength_m, exposure_s=None)
            seen = np.asarray(frame.counts, np.float64)
            yield {
                "table": "camera",
                "rig": rig,
                "encoder": encoder_name,
                "start": {RandomPhase: "random", ZeroPhase: "zero"}.get(type(phase), "smooth"),
                "iterations": count,
                "camera_db": camera_psnr(seen, shown, settings, facts.camera.field_rad),
                "efficiency": rendered.efficiency,
            }


def _camera_pixels(settings: HologramSettings, field_rad: tuple[float, float], width: int) -> tuple[int, int]:
    """Return (columns, rows) of an image with as many pixels as the camera has over its field."""
    per_tan = width / (2 * np.tan(field_rad[0] / 2))
    columns, rows = (round(float(2 * np.tan(fov / 2) * per_tan)) for fov in settings.fov_rad)
    return columns, rows


def camera_psnr(
    seen: NDArray[np.float64],
    wanted: NDArray[np.floating[Any]],
    settings: HologramSettings,
    field_rad: tuple[float, float],
) -> float:
    """Return the PSNR, dB, of a camera's picture (h, w) over the part that an image (rows, columns) covers."""
    height, width = seen.shape
    x_tan, y_tan = image_tangents(width, height, field_rad)
    half = np.tan(np.asarray(settings.fov_rad) / 2)
    columns = ((x_tan / half[0] + 1) / 2 * wanted.shape[1] - 0.5).astype(np.float32)
    rows = ((1 - y_tan / half[1]) / 2 * wanted.shape[0] - 0.5).astype(np.float32)
    across, down = np.broadcast_arrays(columns[None, :], rows[:, None])
    expected = cv2.remap(np.asarray(wanted, np.float32), across.copy(), down.copy(), cv2.INTER_LINEAR)
    inside = (down > 3) & (down < wanted.shape[0] - 4) & (across > 3) & (across < wanted.shape[1] - 4)
    u, v = np.meshgrid(x_tan / half[0], y_tan / half[1])
    terms = [u**i * v**j for i in range(_VIGNETTING_DEGREE + 1) for j in range(_VIGNETTING_DEGREE + 1 - i)]
    basis = np.stack([term[inside] for term in terms], axis=-1)
    light = expected[inside].astype(np.float64)
    fitted = np.linalg.lstsq(basis * light[:, None], seen[inside], rcond=None)[0]
    scale = np.maximum(basis @ fitted, 1e-3 * float(np.max(basis @ fitted)))
    return psnr_db(np.sqrt(np.maximum(seen[inside] / scale, 0)), np.sqrt(light))


def on_device(width: int, height: int, device: str, *, runs: int) -> Row:
    """Return the time of a frame with its heavy arrays on another device; the FFT pair is that device's."""
    settings = replace(settings_of(width, height, Warped()), device=device)
    unit = Unit(height, width)
    intensity = np.random.default_rng(7).uniform(0.05, 1.0, (750, 750))

    def work() -> None:
        render_image(intensity, settings, seed=1)
        if device != "cpu":
            torch.cuda.synchronize()

    timing = unit.ratio(work, runs=runs)
    return {"table": "frame", "size": f"{width}x{height}", "work": f"scene to frame on {device}"} | timing.row()
