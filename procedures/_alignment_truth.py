"""How far the bench that was found is from a simulated bench's own: displacements, phase and places by exact paths."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.bench_pose import DISPLACEMENTS, bench_at
from holocal.loop.procedure import Conclusion
from holocal.optics.bench import Bench, Panel
from procedures._aberration_spots import zone_directions
from procedures._aberration_truth import residuals_rad, true_bench
from procedures._distortion_truth import seen_tangents_of

Array = NDArray[np.float64]

ZONES = 5  # each way, where the exact phase is compared


def against_truth(done: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return the true displacements, how many standard errors off each combination is, and what the bench leaves.

    Residuals are those of holograms for the bench found: the median over the field and the worst.
    """
    facts = done.extra["rig_facts"]
    diameter = (truth.get("camera") or {}).get("pupil_mm")
    nominal = Bench.nominal(
        pupil_diameter_m=facts["pupil_diameter_m"] if diameter is None else 1e-3 * diameter,
        eye_relief_m=facts["eye_relief_m"],
    )
    panel = Panel(int(facts["panel_width"]), int(facts["panel_height"]), facts["pitch_m"])
    wavelength_m = 1e-9 * float(facts["wavelength_nm"])
    found = np.array([done.after[name]["mean"] for name in DISPLACEMENTS])
    bench, true = bench_at(nominal, found), true_bench(nominal, truth)
    tangents = zone_directions(ZONES, (facts["field_rad"][0], facts["field_rad"][1]))
    left = residuals_rad(
        bench, panel, truth, tangents, wavelength_m=wavelength_m, noll=[4], coefficients_rad=np.zeros((1, ZONES**2, 1))
    )[0]
    wanted = np.array(done.extra["checked_tan"]).reshape(-1, 2)
    seen = seen_tangents_of(bench, true, panel, truth, wanted, 1e-9 * float(done.extra["verified_nm"]))
    off_px = np.linalg.norm(seen - wanted, axis=1) / facts["pixel_tan"]
    misalignment = truth["misalignment"]
    own = np.concatenate(
        [misalignment[f"{part}_{kind}"] for part in ("mirror", "slm") for kind in ("rotation_deg", "shift_mm")]
    )
    return {
        **dict(zip(DISPLACEMENTS, own.tolist(), strict=True)),
        "predicted_residual_rms_rad": _known(np.median, left),
        "predicted_residual_worst_rad": _known(np.max, left),
        "position_rms_px": _known(lambda off: np.sqrt(np.mean(off**2)), off_px),
        "position_max_px": _known(np.max, off_px),
        "directions_off_sigma": [
            (one["value"] - float(np.array(one["vector"]) @ own)) / one["sigma"]
            for one in done.extra["directions"]
            if one["determined"]
        ],
    }


def _known(summary: Callable[[Array], Any], values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(summary(known)) if len(known) else None
