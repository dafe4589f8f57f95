"""Gates: what makes a camera frame unfit for a measurement. Each gives a verdict with the number and its limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from holocal.loop.devices import Frame
from holocal.loop.reference import Reference
from holocal.loop.sameness import sameness
from holocal.records.facts import CameraFacts

# Two low bits that are zero in every one of 500,000 noisy pixels do not happen by chance (4**-500000).
ZERO_BITS_LIMIT = 1
# A frame that is mostly white is constant and the same again because it clips: the gate for clipping speaks.
MOSTLY_SATURATED = 0.5
# Two pictures of one pattern differ by 0.95 to 1.05 times their noise on the simulated bench; 2 leaves room for a panel
# that flickers or a mount that moves more from step to step than during the pre-flight.
UNCHANGED_LIMIT = 2.0
# Independent speckle differs by 1 + its structure: where that is below 1 + 4, the two cannot be told apart for certain.
LEAST_STRUCTURE = 4.0
# Of the light that a random pattern, which scatters it everywhere, sends into the picture; holograms send more.
UNLIT_LIMIT = 0.05
LEAST_EXPECTED_COUNTS = 4.0  # mean of the picture: with less, the drift of a black level would pass for light


@dataclass(frozen=True)
class Verdict:
    """What a gate found: `ok`, the number, the limit it was held against, and what to do when it is not ok."""

    gate: str
    ok: bool
    measured: float
    limit: float
    sentence: str = ""
    fix: str = ""


def clipped(frame: Frame, *, limit: float) -> Verdict:
    """Return whether at most `limit` of the pixels are at full scale."""
    share = frame.saturated_fraction
    return Verdict(
        "clipped",
        share <= limit,
        share,
        limit,
        f"{share:.2%} of the pixels are at full scale at {1e3 * frame.exposure_s:.4g} ms; at most {limit:.2%} may be.",
        "Use a shorter exposure.",
    )


def misshapen(frame: Frame, camera: CameraFacts) -> Verdict:
    """Return whether the frame has the camera's shape and holds finite counts."""
    pixels, expected = frame.counts.size, camera.width * camera.height
    fits = frame.counts.shape == (camera.height, camera.width)
    finite = fits and (frame.counts.dtype.kind == "u" or bool(np.isfinite(frame.counts).all()))
    return Verdict(
        "misshapen",
        fits and finite,
        float(pixels),
        float(expected),
        f"the frame has shape {frame.counts.shape} and type {frame.counts.dtype}; {camera.height} x {camera.width} "
        "finite counts were expected.",
        "Check the camera's region of interest and pixel format.",
    )


def beyond_full_scale(frame: Frame, camera: CameraFacts) -> Verdict:
    """Return whether no count is above what the camera calls its full scale."""
    highest = int(frame.counts.max()) if frame.counts.size else 0
    return Verdict(
        "beyond-full-scale",
        highest <= camera.full_scale,
        float(highest),
        float(camera.full_scale),
        f"the highest count is {highest}; the camera's full scale is {camera.full_scale}.",
        "Set the camera's full scale or pixel format: clipping would go unseen.",
    )


def constant(frame: Frame) -> Verdict:
    """Return whether a lit frame has any structure at all."""
    spread = int(frame.counts.max()) - int(frame.counts.min()) if frame.counts.size else 0
    return Verdict(
        "constant",
        spread > 0,
        float(spread),
        1.0,
        "every pixel of the frame has the same count.",
        "Check the camera's cable, its lens cap and its test-pattern setting.",
    )


def stale(frame: Frame, last_id: int | None) -> Verdict:
    """Return whether the frame's number is above the last one's."""
    return Verdict(
        "stale",
        last_id is None or frame.frame_id > last_id,
        float(frame.frame_id),
        float(last_id if last_id is not None else -1),
        f"the frame has number {frame.frame_id}, not above the last one, {last_id}: it was taken before the pattern.",
        "Check the camera's trigger and its buffers.",
    )


def identical(frame: Frame, last: Frame | None) -> Verdict:
    """Return whether the frame differs from the last one; ask where the camera has noise or something was changed."""
    same = last is not None and bool(np.array_equal(frame.counts, last.counts))
    return Verdict(
        "identical",
        not same,
        float(same),
        0.0,
        "the frame is the last one again, bit by bit; noise alone makes two frames differ.",
        "Check that the camera delivers fresh frames.",
    )


def lost_packets(frame: Frame) -> Verdict:
    """Return whether all of the frame arrived."""
    return Verdict(
        "lost-packets",
        frame.lost_packets == 0,
        float(frame.lost_packets),
        0.0,
        f"{frame.lost_packets} packets of the frame were lost.",
        "Check the network card's packet size and the cable.",
    )


def low_bits_zero(frame: Frame) -> Verdict:
    """Return whether the low bits are used; a left-justified format leaves them zero and hides clipping."""
    used = int(np.bitwise_or.reduce(frame.counts, axis=None)) if frame.counts.size else 0
    zeros = (used & -used).bit_length() - 1 if used else 0
    return Verdict(
        "low-bits-zero",
        zeros <= ZERO_BITS_LIMIT,
        float(zeros),
        float(ZERO_BITS_LIMIT),
        f"the {zeros} low bits of all {frame.counts.size} pixels are 0: the counts are left-justified.",
        "Set the camera's pixel format or shift; full scale is read wrongly and clipping goes unseen.",
    )


def unlit(frame: Frame, reference: Reference) -> Verdict:
    """Return whether light is seen at all, where an exposure is long enough to see it."""
    expected = reference.rate * frame.exposure_s
    seen = float(np.mean(reference.signal(frame)[reference.usable]))
    share = seen / expected if expected > 0 else 1.0
    return Verdict(
        "unlit",
        expected < LEAST_EXPECTED_COUNTS or share >= UNLIT_LIMIT,
        share,
        UNLIT_LIMIT,
        f"the frame has {share:.1%} of the light that the pre-flight's random pattern gave; at least "
        f"{UNLIT_LIMIT:.0%} is expected of any pattern.",
        "Check the light, its shutter and interlock, and that nothing is in the beam.",
    )


def unchanged(frame: Frame, before: Frame | None, reference: Reference, camera: CameraFacts) -> Verdict:
    """Return whether the picture differs from the one `before`, of another pattern, by more than noise.

    Brightness apart, so that neither an exposure nor the light's drift hides that the panel kept its pattern. Pictures
    without structure, or with less than their noise, are given the benefit of the doubt.
    """
    found = None if before is None else sameness(before, frame, reference, camera.full_scale)
    difference = np.inf if found is None else found.difference
    seen = found is not None and found.structure >= LEAST_STRUCTURE
    return Verdict(
        "unchanged",
        not (seen and difference <= UNCHANGED_LIMIT),
        difference,
        UNCHANGED_LIMIT,
        f"the picture is the former pattern's: it differs from it by {difference:.2f} times the noise, another "
        f"pattern's would by more than {UNCHANGED_LIMIT:g}.",
        "Check that the panel takes what it is sent: its cable, its output, its settle time (`holocal doctor`).",
    )


@dataclass(frozen=True)
class Surroundings:
    """What a frame is held against.

    Attributes
    ----------
    last_id
        The number of the last frame that came.
    last
        The last good frame, of any kind.
    lit
        Whether light was on: a dark frame may be constant.
    changed
        Whether the pattern, the light, the wavelength or the exposure changed since `last`.
    other
        The last good picture of another pattern, under the same light.
    fresh
        Whether the pattern is meant to give light, and another picture than `other`.
    reference
        What the pre-flight learnt; None where there was none.
    """

    last_id: int | None = None
    last: Frame | None = None
    lit: bool = True
    changed: bool = True
    other: Frame | None = None
    fresh: bool = True
    reference: Reference | None = None


def first_failure(frame: Frame, camera: CameraFacts, around: Surroundings) -> Verdict | None:
    """Return the first gate that a frame trips, clipping apart, or None."""
    shape = misshapen(frame, camera)
    if not shape.ok:
        return shape
    reference = around.reference
    verdicts = [lost_packets(frame), stale(frame, around.last_id), beyond_full_scale(frame, camera)]
    if frame.saturated_fraction >= MOSTLY_SATURATED:
        return next((verdict for verdict in verdicts if not verdict.ok), None)
    noisy = reference is not None and reference.noisy  # then not even frames of one pattern are alike bit by bit
    flat = constant(frame)
    if flat.ok and (noisy or (around.lit and around.changed)):
        verdicts.append(identical(frame, around.last))
    if around.lit:
        verdicts.append(low_bits_zero(frame))
        if around.fresh:
            verdicts.append(flat)
            if reference is not None:
                verdicts += [unlit(frame, reference), unchanged(frame, around.other, reference, camera)]
    return next((verdict for verdict in verdicts if not verdict.ok), None)
