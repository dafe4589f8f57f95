"""What a search without a model tries, and where it stands: the plan, made once, and the state between frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import UsageError
from holocal.estimate.lit_pupil import QUADRATIC, LitPupil, mean_gradient, spreading_bias, visible_modes

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BEFORE, CENTRE, PUSH, REFINE, AVERAGE, AFTER, DONE = "before", "centre", "push", "refine", "average", "after", "done"
TILT = (2, 3)
PUSH_RAD = 0.7  # rms over the lit part; measured: 0.5 to 1 are alike, 2 leaves a third more
LARGEST_PUSH_RAD = 15.0  # of any one coefficient: a combination that is hardly seen would need hundreds
STEEPEST = 600.0  # rad per radius squared: a strip 0.1 radius high is spread by 17 rad per radius, 1.6 pixels


@dataclass(frozen=True)
class SearchPlan:
    """What is tried, zone by zone; made once by `search_plan`.

    `trial_noll` are the indices of a trial's columns: tilt, the biases' 4 to 6, and those searched. `modes`
    (zones, modes, len(noll)) are the visible combinations, rows of zeros where a zone has fewer; `length` (zones,
    modes) how long each is in Noll terms; `dropped` (zones,) the effect of the
    others, per rad of each; `bias` and `untilt` (zones, len(trial_noll)) and (zones, 2, ...) the
    bias, and the tilts that hold the spot's centroid in place; `gradient_per_px` (2, 2) what moves the spot.
    """

    noll: tuple[int, ...]
    trial_noll: tuple[int, ...]
    modes: Array
    length: Array
    dropped: Array
    bias: Array
    untilt: Array
    gradient_per_px: Array
    prior_rad: float
    passes: int
    refinements: int
    averages: int

    @property
    def zones(self) -> int:
        """How many zones there are."""
        return len(self.modes)

    @property
    def seen(self) -> Mask:
        """(zones, modes) which combinations there are."""
        return np.asarray(self.length > 0)

    def frames(self, passes: int) -> int:
        """Return how many frames a search of that many passes takes."""
        each = 2 * (1 + self.modes.shape[1]) + 2 * self.refinements
        return int(4 + passes * each + 2 * self.averages)

    @property
    def largest_rad(self) -> float:
        """The largest coefficient, tilt left out, that a trial adds to what was found."""
        pushes = np.abs(self.modes * self.pushes_rad[:, :, None])
        return float(np.abs(self.bias[:, 2:]).max(initial=0.0) + pushes.max(initial=0.0))

    @property
    def pushes_rad(self) -> Array:
        """(zones, modes) by how much each mode is pushed, rms over the lit part."""
        largest = np.abs(self.modes).max(axis=2)
        return np.asarray(np.minimum(PUSH_RAD, LARGEST_PUSH_RAD * inverse(largest)))

    @property
    def priors_rad(self) -> Array:
        """(zones, modes) how large each combination may be, rms over the lit part."""
        return np.asarray(self.prior_rad * inverse(self.length))

    @property
    def columns(self) -> list[int]:
        """The columns of a trial that are searched."""
        return [self.trial_noll.index(j) for j in self.noll]


@dataclass(frozen=True)
class SearchState:
    """Where a search stands: made by `start`, moved on by `take`; arrays, numbers, strings and bools only.

    `stage` and `step` say which frame is next. `modes_rad` (zones, modes) and `tilt_rad` (zones, 2) are the correction
    so far; `covariance` (zones, modes, modes) its error; `slopes` (zones, modes, h, w) the answers of the difference;
    `plain` (zones, h, w) the difference that was not pushed, `plain_usable` where it is known; `moved_rad` and
    `first_rad` (zones,) the last step and the last pass's first; `waiting` and `waiting_usable` the first picture of a
    pair; `tries_rad` (zones, averages, modes) the corrections that are averaged; `left` (zones, h, w) the mean of what
    their pairs left unexplained, `left_square` (zones,) the mean of its sum of squares; `share_before`, `share_fall`
    and `share_sigma` (zones,) how sharp a spot was, by how much less it is, and the error of that.
    """

    stage: str
    step: int
    passes: int
    frames: int
    modes_rad: Array
    tilt_rad: Array
    covariance: Array
    moved_rad: Array
    first_rad: Array
    misfit: Array
    slopes: NDArray[np.float32]
    plain: Array
    plain_usable: Mask
    waiting: Array
    waiting_usable: Mask
    tries_rad: Array
    left: Array
    left_square: Array
    dark: Mask
    share_before: Array
    share_fall: Array
    share_sigma: Array

    @property
    def done(self) -> bool:
        """Whether no frame is wanted any more."""
        return self.stage == DONE


def search_plan(
    lit: Sequence[LitPupil],
    noll: tuple[int, ...] = tuple(range(4, 16)),
    *,
    px_per_gradient: Array,
    spread_px: float = 5.0,
    prior_rad: float = 2.0,
    dropped_rad: float = 0.02,
    passes: int = 3,
    refinements: int = 3,
    averages: int = 6,
) -> SearchPlan:
    """Return the plan of a search.

    Parameters
    ----------
    lit
        The lit part of each zone's pupil, as it is expected.
    noll
        What is searched, from 4 upwards.
    px_per_gradient
        (2, 2) by how many columns and rows a gradient of 1 rad per pupil radius along x and y moves the spot; it
        steers spots and sizes biases only, some 10 % is good enough.
    spread_px
        Size of a biased spot, rms along each axis. A window of 41 pixels holds 5 with 4 rad of aberration on top.
    prior_rad
        How large each coefficient may be, as a standard deviation.
    dropped_rad
        Combinations that change the wavefront by less, per rad of coefficients, are left alone.
    """
    if len(set(noll)) != len(noll) or not noll or min(noll) < 4:
        raise UsageError(f"A search of Noll indices {noll} is none.", fix="Name each once, from 4 upwards.")
    if not lit:
        raise UsageError("A search needs at least one zone.")
    if passes < 1 or refinements < 1 or averages < 2:
        raise UsageError(f"{passes} passes, {refinements} refinements and {averages} averages; at least 1, 1 and 2.")
    trial_noll = (*TILT, *sorted({*QUADRATIC, *noll}))
    gradient_per_px = np.linalg.inv(np.asarray(px_per_gradient, np.float64))
    found = [visible_modes(part, noll, dropped_rad=dropped_rad) for part in lit]
    count = max(1, max(len(combinations) for combinations, _, _ in found))
    modes, length = np.zeros((len(lit), count, len(noll))), np.zeros((len(lit), count))
    bias, untilt = np.zeros((len(lit), len(trial_noll))), np.zeros((len(lit), 2, len(trial_noll)))
    places = [trial_noll.index(j) for j in QUADRATIC]
    gradient_rad = spread_px * float(np.sqrt(np.abs(np.linalg.det(gradient_per_px))))
    for zone, (part, (combinations, sizes, _)) in enumerate(zip(lit, found, strict=True)):
        modes[zone, : len(sizes)], length[zone, : len(sizes)] = combinations, sizes
        bias[zone, places] = spreading_bias(part, gradient_rad=gradient_rad, steepest=STEEPEST)
        untilt[zone, :, 2:] = -mean_gradient(part, trial_noll[2:]) / 2  # Noll 2 is 2 x, 3 is 2 y
    return SearchPlan(
        noll=noll,
        trial_noll=trial_noll,
        modes=modes,
        length=length,
        dropped=np.array([left for _, _, left in found]),
        bias=bias,
        untilt=untilt,
        gradient_per_px=gradient_per_px,
        prior_rad=prior_rad,
        passes=passes,
        refinements=refinements,
        averages=averages,
    )


def start(plan: SearchPlan, *, window: tuple[int, int] = (41, 41), correction_rad: Array | None = None) -> SearchState:
    """Return the state before the first frame, for windows of that many rows and columns.

    `correction_rad` (zones, len(noll)) is what to start from, 0 if left out; what the lit part does not show is left.
    """
    zones, count = plan.length.shape
    modes_rad = np.zeros((zones, count))
    if correction_rad is not None:
        modes_rad = np.einsum("zmj,zj->zm", plan.modes, correction_rad) * inverse(plan.length) ** 2
    return SearchState(
        stage=BEFORE,
        step=0,
        passes=0,
        frames=0,
        modes_rad=modes_rad,
        tilt_rad=np.zeros((zones, 2)),
        covariance=np.stack([np.diag(row) for row in plan.priors_rad**2]),
        moved_rad=np.full(zones, np.inf),
        first_rad=np.full(zones, np.inf),
        misfit=np.full(zones, np.inf),
        slopes=np.zeros((zones, count, *window), np.float32),
        plain=np.zeros((zones, *window)),
        plain_usable=np.zeros((zones, *window), bool),
        waiting=np.zeros((zones, *window)),
        waiting_usable=np.zeros((zones, *window), bool),
        tries_rad=np.zeros((zones, plan.averages, count)),
        left=np.zeros((zones, *window)),
        left_square=np.zeros(zones),
        dark=np.zeros(zones, bool),
        share_before=np.zeros(zones),
        share_fall=np.zeros(zones),
        share_sigma=np.zeros(zones),
    )


def inverse(values: Array) -> Array:
    """Return 1 / values, 0 where they are 0."""
    return np.asarray(np.divide(1.0, values, out=np.zeros_like(values), where=values > 0))
