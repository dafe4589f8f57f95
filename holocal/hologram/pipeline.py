"""Scene to frame, the thesis's pipeline (figure 3.2): points, full-complex hologram, phase-only encoding, levels.

Pure: the same inputs give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from holocal.errors import SamplingError
from holocal.hologram.clock import Clock
from holocal.hologram.encode.encoder import Encoder, Target
from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta_encoder import Ifta
from holocal.hologram.frame import panel_phase, phase_to_levels
from holocal.hologram.reference import PupilWindow, pupil_window, reference_turns
from holocal.hologram.scenes.image import InitialPhase, RandomPhase, image_cloud
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import HologramSettings
from holocal.hologram.stored import Store
from holocal.hologram.synthesis import synthesise
from holocal.optics.series import Series

__all__ = ["HologramSettings", "Rendered", "render", "render_image"]

_BLOCK = 128  # rows at a time: float64 work that stays in the cache
_WIDEST = 1.2  # times the band: the pupil's image is largest at one side of the panel, half as wide at the other
_MARGIN_BINS = 2.0  # the window is this much wider than the pupil's image: half a pixel of the footprint's edge


@dataclass(frozen=True)
class Rendered:
    """A frame and how it came about.

    `levels` (H, W) uint8 for the panel; `phase_rad` (H, W) float32 in [0, 2 pi), before quantisation; `field` (H, W)
    complex64, the full-complex hologram before the linear phase and the encoding, or None (`skipped` says where the
    brightest amplitude, beyond 1e-12 to 1e12, was scaled to 1); `seconds` per stage;
    `skipped` a sentence for each thing left out; `efficiency` the share of the panel's light that is wanted signal in
    the pupil; `signal_error` after each iteration of the encoder; `encoded` the field of unit modulus, divided by the
    reference, a warm start for the next frame, or None.
    """

    levels: NDArray[np.uint8]
    phase_rad: NDArray[np.float32]
    field: NDArray[np.complex64] | None
    seconds: dict[str, float]
    skipped: list[str]
    efficiency: float
    signal_error: tuple[float, ...] = ()
    encoded: torch.Tensor | None = None


def render(
    clouds: Sequence[PointCloud],
    settings: HologramSettings,
    *,
    encoder: Encoder | None = None,
    keep_complex: bool = False,
    keep_encoded: bool = False,
    response_rad: ArrayLike | None = None,
    store: Store | None = None,
) -> Rendered:
    """Return the frame that shows clouds of points: the one way from any scene to the panel.

    Parameters
    ----------
    clouds
        The scene (`holocal.hologram.scenes`), coherent; one colour.
    settings
        Panel, bench, colour, field, method.
    encoder
        To phase only; the default is IFTA with the settings' iterations.
    keep_complex, keep_encoded
        Keep the full-complex hologram (66 MB at 4K), and the encoded field for the next frame's start.
    response_rad
        (256,) phase of each level; default 2 pi L / 256.
    store
        Keeps phase functions between programs.
    """
    clock = Clock.start()
    reference, transform = reference_turns(settings), _transform(settings)
    _check_band(settings)
    clock.lap("table")
    reach = (transform.reach_rows, transform.reach_columns)
    found = synthesise(clouds, settings, reach=reach, clock=clock, store=store)
    dark = sum(int(np.count_nonzero(cloud.amplitude == 0)) for cloud in clouds)
    count = sum(len(cloud) for cloud in clouds)
    skipped = [f"{dark} of {count} points: dark"] if dark else []
    if found is None:
        return _dark_frame(settings, clock, skipped, keep_complex)
    skipped += found.skipped
    if settings.wavefront is not None and settings.wavefront.is_identity():
        skipped.append("the wavefront correction: it changes nothing")
    complex_field = _undivided(found.field, reference, settings) if keep_complex else None
    clock.lap("complex field")
    target = target_of(found.field, settings)
    clock.lap("to pupil")
    encoded = (encoder or Ifta(settings.iterations))(target)
    clock.lap("encode")
    phase = panel_phase(encoded.field, reference, settings.panel)
    levels = phase_to_levels(phase, response_rad)
    clock.lap("levels")
    if encoded.stopped:
        skipped.append(f"further iterations of the encoder: {encoded.stopped}")
    return Rendered(
        levels,
        phase,
        complex_field,
        clock.seconds,
        skipped,
        encoded.efficiency,
        encoded.signal_error,
        encoded.field if keep_encoded else None,
    )


def target_of(hologram: torch.Tensor, settings: HologramSettings) -> Target:
    """Return what an encoder is to reach: a hologram (H, W) divided by the reference, its spectrum in the pupil."""
    transform = _transform(settings)
    window = torch.from_numpy(_window_mask(settings)).to(settings.device)
    return Target(hologram, transform.forward(hologram), window, transform)


def render_image(
    intensity: ArrayLike,
    settings: HologramSettings,
    *,
    seed: int,
    encoder: Encoder | None = None,
    keep_complex: bool = False,
    response_rad: ArrayLike | None = None,
    initial_phase: InitialPhase | None = None,
) -> Rendered:
    """Return the frame that shows an image at the settings' depth.

    Parameters
    ----------
    intensity
        (rows, columns), not negative; row 0 on top. Covers `settings.fov_rad`, centred on the gaze.
    seed
        Of the random initial phase.
    initial_phase
        Another choice of the points' initial phase than `RandomPhase(seed)`.
    settings, encoder, keep_complex, response_rad
        As in `render`.
    """
    choice = initial_phase or RandomPhase(seed)
    cloud = image_cloud(intensity, fov_rad=settings.fov_rad, depth_m=settings.depth_m, initial_phase=choice)
    return render([cloud], settings, encoder=encoder, keep_complex=keep_complex, response_rad=response_rad)


@lru_cache(maxsize=4)
def _window(where: HologramSettings) -> PupilWindow:
    return pupil_window(where)


def _window_mask(settings: HologramSettings) -> NDArray[np.bool_]:
    """Return which bins of the compact spectrum lie in the pupil's image."""
    return _mask_at(settings.geometry())


@lru_cache(maxsize=2)
def _mask_at(where: HologramSettings) -> NDArray[np.bool_]:
    panel = where.panel
    margin = _MARGIN_BINS / (min(panel.width, panel.height) * panel.pitch_m)
    frequencies = _transform(where).frequencies(panel.pitch_m, panel.pitch_m)
    return _window(where).contains(*frequencies, margin_per_m=margin)


def _check_band(settings: HologramSettings) -> None:
    """Refuse a pupil whose light the panel's pixels cannot tell apart: it would come back on the pupil's other side."""
    band = 0.5 / settings.panel.pitch_m
    widest = max(_window(settings.geometry()).half_size_per_m)
    if not widest <= _WIDEST * band:
        raise SamplingError(
            f"The pupil's image is {widest / band:.2f} times as wide as the panel's band, at "
            f"{settings.wavelength_m * 1e9:.4g} nm and {settings.panel.pitch_m * 1e6:.3g} um.",
            why="Light for its rim would alias to the other side.",
            fix="Use a smaller pupil or gaze, a longer wavelength or a finer pitch.",
            measured=widest,
            limit=_WIDEST * band,
        )


def _transform(settings: HologramSettings) -> WindowedTransform:
    """Return the transform between the panel's pixels and the bins round the pupil's image."""
    panel = settings.panel
    reach_x, reach_y = _window(settings.geometry()).half_size_per_m
    return WindowedTransform(
        panel.height,
        panel.width,
        int(np.ceil(reach_y * panel.height * panel.pitch_m + _MARGIN_BINS)),
        int(np.ceil(reach_x * panel.width * panel.pitch_m + _MARGIN_BINS)),
        settings.device,
    )


def _undivided(hologram: torch.Tensor, reference: Series, settings: HologramSettings) -> NDArray[np.complex64]:
    """Return the full-complex hologram on the panel's pixels, with the reference put back."""
    panel = settings.panel
    hologram = hologram.clone()
    for top in range(0, panel.height, _BLOCK):
        part = slice(top, top + _BLOCK)
        turns = torch.from_numpy(reference.on_grid(panel.x_m, panel.y_m[part]))
        turns.sub_(torch.round(turns)).mul_(2 * np.pi)
        phase = turns.to(torch.float32)
        hologram[part].mul_(torch.polar(torch.ones_like(phase), phase).to(hologram.device))
    return np.asarray(hologram.cpu().numpy())


def _dark_frame(settings: HologramSettings, clock: Clock, skipped: list[str], keep_complex: bool) -> Rendered:
    """Return the frame that shows nothing: the uniform panel sends all light to its zero order, outside the pupil."""
    shape = (settings.panel.height, settings.panel.width)
    clock.lap("levels")
    return Rendered(
        np.zeros(shape, np.uint8),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.complex64) if keep_complex else None,
        clock.seconds,
        [*skipped, "nothing in the scene is on the panel and bright: the frame is uniform"],
        0.0,
    )
