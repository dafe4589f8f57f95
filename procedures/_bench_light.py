"""What a bench would make of an array's spots: where the camera sees them, for any pose of mirror and panel.

On the panel the spots share the light: where fewer waves meet, each has more of it. A spot's light is therefore not
spread over the pupil as that of a picture's point is, and on an aberrated bench its middle lies elsewhere, up to half a
camera pixel (docs/physics.md 11). A pose of the bench and a beam that explain the spots with both defoci say by how
much; what they are does not matter here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ive

from holocal.estimate.bench_pose import DISPLACEMENTS, PoseFit, bench_at, fit_pose
from holocal.estimate.camera_lens import ideal_pixels
from holocal.optics.panel_rays import Landed, PanelRays, landed, middles, panel_rays
from holocal.optics.spots import derivative
from holocal.threads import each
from procedures._aberration_spots import EDGE_M, Array, Recipe, SpotArray, added_phase, nominal_bench, soft_disc

BLOCK = 128  # pixels of the panel: one ray of each spot; 32 give the same to 0.01 px
BEAM = ("beam_x", "beam_y", "beam_xx", "beam_yy")  # natural logarithm of its intensity at the panel's edge
CAMERA = ("camera_x", "camera_y", "camera_roll", "camera_scale")  # pixels, of roll and scale at the picture's edge
NUISANCE = (*BEAM, *CAMERA)
PARAMETERS = (*NUISANCE, *DISPLACEMENTS)
BEAM_PRIOR = (0.5, 0.5, 2.0, 2.0)
CAMERA_PX = 0.02  # how well a simulated camera's pointing, roll and scale are taken to be known
PRIOR = np.concatenate([BEAM_PRIOR, [CAMERA_PX] * len(CAMERA), np.ones(len(DISPLACEMENTS))])  # degrees and mm
MODEL_PX = 0.02  # of a middle that the model cannot tell: crosstalk, the pixels' own light


@dataclass(frozen=True)
class ArrayLight:
    """An array's rays: `shown` with each recipe, sharing the panel; `alone`, as a point of a picture sends them."""

    array: SpotArray
    shown: tuple[PanelRays, ...]
    alone: PanelRays


def array_light(array: SpotArray, recipes: Sequence[Recipe]) -> ArrayLight:
    """Return an array's rays with recipes of one amplitude: they differ in their defocus alone."""
    passed = _passed(array)
    strength = passed * array.amplitude**2
    share = strength / np.maximum(strength.sum(axis=1, keepdims=True), 1e-30)
    return ArrayLight(
        array, tuple(_rays(array, recipe, _kept(share)) for recipe in recipes), _rays(array, None, passed)
    )


class LightModel:
    """Where an array's rays are seen, by beam and pose; the last pose's are kept, as the beam costs next to nothing."""

    def __init__(self, array: SpotArray, rays: Sequence[PanelRays]) -> None:
        self._array, self._rays = array, rays
        self._nominal = nominal_bench(array.facts)
        self._pose: bytes | None = None
        self._landed: list[Landed] = []
        self._passed: list[Array] = []

    def places_px(self, values: Array) -> Array:
        """Return (rays' spots x 2,) ideal pixels for the values of `PARAMETERS`."""
        beam, turned, pose = np.split(values, [len(BEAM), len(NUISANCE)])
        if pose.tobytes() != self._pose:
            bench = bench_at(self._nominal, pose)
            self._landed = each(lambda k: landed(bench, self._rays[k]), len(self._rays))
            self._passed = [pupil_light(self._array, at) for at in self._landed]
            self._pose = pose.tobytes()
        found = []
        for at, passed, rays in zip(self._landed, self._passed, self._rays, strict=True):
            light = rays.light * passed * beam_light(self._array, beam, rays.slm_m)
            found.append(self._seen(ideal_pixels(middles(at, light, rays.first), self._array.facts.camera), turned))
        return np.concatenate(found)

    def _seen(self, places: Array, turned: Array) -> Array:
        """Return (spots x 2,) places (spots, 2) as a camera sees them that is off by `CAMERA`."""
        camera = self._array.facts.camera
        u = (places - (np.array([camera.width, camera.height]) - 1) / 2) / (camera.width / 2)
        across = np.stack([-u[:, 1], u[:, 0]], axis=1)
        return np.asarray((places + turned[:2] + turned[2] * across + turned[3] * u).ravel())


def pupil_light(array: SpotArray, at: Landed) -> Array:
    """Return what the camera's pupil lets through of rays, (n,)."""
    return soft_disc(at.pupil_m, array.facts.pupil_diameter_m / 2, EDGE_M) ** 2


def beam_light(array: SpotArray, beam: Array, slm_m: Array) -> Array:
    """Return the beam's intensity at places (n, 2) of the panel, (n,), for the values of `BEAM`; 1 in the middle."""
    u = slm_m / np.asarray(array.panel.half_size_m)
    return np.asarray(np.exp(u @ beam[:2] + u**2 @ beam[2:]))


@dataclass(frozen=True)
class SpotData:
    """What a fit explains: `middles_px` (m,), ideal pixels, with errors `sigma_px` (m,), NaN where none is known; the
    `model` says where they would be."""

    model: LightModel
    middles_px: Array
    sigma_px: Array


def spot_data(lights: Sequence[ArrayLight], middle_px: Sequence[Array], sigma_px: Sequence[Array]) -> SpotData:
    """Return the data of arrays whose spots have middles (recipes, spots, 2), each coordinate with errors (spots,)."""
    sigma = [
        np.broadcast_to(np.hypot(own, MODEL_PX)[None, :, None], np.shape(one)).ravel()
        for own, one in zip(sigma_px, middle_px, strict=True)
    ]
    return SpotData(
        LightModel(lights[0].array, [own for light in lights for own in light.shown]),
        np.concatenate([np.asarray(one).ravel() for one in middle_px]),
        np.concatenate(sigma),
    )


def fit_light(data: SpotData, prior: Array = PRIOR) -> PoseFit:
    """Return the beam and the bench (`PARAMETERS`) that explain the data, and had errors `prior` (p,) before."""
    return fit_pose(data.model.places_px, data.middles_px, data.sigma_px, prior)


def moved_px(light: ArrayLight, values: Array) -> Array:
    """Return by how much (spots, 2) a picture's points lie off the mean of the middles of their spots, pixels."""
    model = LightModel(light.array, [*light.shown, light.alone])
    places = model.places_px(values).reshape(len(light.shown) + 1, -1, 2)
    return np.asarray(np.nan_to_num(places[-1] - places[:-1].mean(axis=0)))


def _grid(array: SpotArray) -> tuple[Array, Array]:
    return array.waves.block_grid(BLOCK)


def _passed(array: SpotArray) -> Array:
    """Return what passes the nominal pupil of every spot's light, (places, spots)."""
    pupil = array.waves.pupil.on_grid(*_grid(array))
    passed = soft_disc(pupil, array.facts.pupil_diameter_m / 2, EDGE_M) ** 2
    return np.asarray(passed.reshape(-1, passed.shape[-1]))


def _kept(share: Array) -> Array:
    """Return what the phase of a sum of waves keeps of a wave's light, by its share of the sum's.

    The others are many and of random phase: the mean phasor of a constant in a complex Gaussian (Rice). It is pi / 4 of
    a small share, and all of 1.
    """
    ratio = np.minimum(share / np.maximum(1 - share, 1e-9), 1e9)
    return np.asarray(np.pi / 4 * ratio * (ive(0, ratio / 2) + ive(1, ratio / 2)) ** 2)


def _rays(array: SpotArray, recipe: Recipe | None, light: Array) -> PanelRays:
    """Return the rays of waves with light (places, spots), each place's less what its pixels' areas keep back."""
    x, y = _grid(array)
    waves = array.waves if recipe is None else array.waves.with_phase(lambda q: added_phase(array, recipe, q))
    slopes = np.stack([derivative(waves.turns, axis).on_grid(x, y) for axis in (1, 0)], axis=-1)
    slopes = slopes.reshape((*light.shape, 2))
    panel = array.panel
    turns = (slopes - np.asarray(panel.illumination_frequency_per_m)) * panel.pitch_m
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return panel_rays(places, slopes, light * np.prod(np.sinc(turns) ** 2, axis=-1), array.wavelength_m)
