"""Benchmarks as a page: a Markdown table per kind, two plots, and the machine by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from holocal.records.files import write_bytes

Row = dict[str, Any]

TITLES = {
    "synthesis": "Synthesis: run time against error",
    "density": "Synthesis: run time against what the scene contains",
    "frame": "Scene to frame",
    "encoders": "Encoders on the panel",
    "camera": "Image quality on the bench",
    "quality": "Image quality in the plain Fourier geometry",
    "propagation": "Free space",
}
NOTES = {
    "synthesis": "750 x 750 points over 25 x 25 degrees, 515 nm, thesis bench, plans warm (`cold`: from nothing). "
    "`wavefront`: phase against the traced path, rms over points and footprints, and the 95th percentile over the "
    "field (zones: after the best tilt and piston, warped: after the best piston only). `L2`: complex field at 2000 "
    "random pixels of 200 random points against the direct float64 sum, same footprints (zones keep the "
    "thesis's wider ones).",
    "density": "The default method, 0.1 rad. `new points`: positions never seen before, so they are sorted first.",
    "frame": "Plans warm. Stages are seconds, medians. `peak`: of the process so far; its own where this stage ran "
    "alone.",
    "encoders": "`error`: rms of the window's spectrum against the scaled wanted one. `efficiency`: share of the "
    "panel's light that is wanted signal in the pupil.",
    "camera": "A photograph over 12 x 8 degrees through the simulated bench and its camera, which averages over its "
    "pixels; PSNR of amplitudes, peak 1, after a smooth scale (what the panel's edges leave of the pupil).",
    "quality": "512 x 512 photographs in the far field of 1024 x 1024 pixels, free outside the image. PSNR of "
    "amplitudes, peak 1, fitted scale. `camera`: 4 x 4 samples averaged over each image pixel; `half off`: the same "
    "camera moved by half an image pixel both ways. Error on the grid says little about what a camera sees.",
    "propagation": "Float32; a disc of 0.5 mm with an edge of 2 pixels against the Rayleigh-Sommerfeld sum at 48 "
    "random pixels; times with the kernel prepared, padded to twice the size.",
}
COLUMNS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "synthesis": (
        ("size", "size", ""),
        ("method", "method", ""),
        ("seconds", "s", ".3g"),
        ("ratio_p", "P", ".3g"),
        ("cold_seconds", "cold s", ".2g"),
        ("wavefront_rms_rad", "wavefront rad", ".3f"),
        ("wavefront_p95_rad", "p95 rad", ".3f"),
        ("relative_l2", "L2", ".2g"),
        ("note", "", ""),
    ),
    "density": (
        ("size", "size", ""),
        ("scene", "scene", ""),
        ("seconds", "s", ".3g"),
        ("ratio_p", "P", ".3g"),
        ("new_points_ratio_p", "new points, P", ".3g"),
    ),
    "frame": (
        ("size", "size", ""),
        ("work", "work", ""),
        ("seconds", "s", ".3g"),
        ("ratio_p", "P", ".3g"),
        ("peak_memory_mib", "peak MiB", ".0f"),
        ("stages_seconds", "stages", ""),
    ),
    "encoders": (
        ("size", "size", ""),
        ("encoder", "encoder", ""),
        ("seconds", "s", ".3g"),
        ("ratio_p", "P", ".3g"),
        ("signal_error", "error", ".3f"),
        ("efficiency", "efficiency", ".2f"),
    ),
    "camera": (
        ("rig", "rig", ""),
        ("encoder", "encoder", ""),
        ("start", "initial phase", ""),
        ("iterations", "iterations", ""),
        ("camera_db", "camera dB", ".1f"),
        ("efficiency", "efficiency", ".2f"),
    ),
    "quality": (
        ("image", "image", ""),
        ("start", "start", ""),
        ("grid", "grid", ""),
        ("encoder", "encoder", ""),
        ("iterations", "iterations", ""),
        ("ratio_p", "P", ".3g"),
        ("grid_db", "grid dB", ".1f"),
        ("camera_db", "camera dB", ".1f"),
        ("half_pixel_off_db", "half off dB", ".1f"),
        ("efficiency", "light", ".2f"),
    ),
    "propagation": (
        ("size", "size", ""),
        ("distance_m", "distance m", ".4g"),
        ("relative_l2", "L2", ".1e"),
        ("seconds", "s", ".3g"),
        ("ratio_p", "P", ".3g"),
    ),
}


def as_markdown(rows: Sequence[Row], machine: Row, *, plots: Sequence[str] = ()) -> str:
    """Return the page."""
    lines = [
        "# Benchmarks",
        "",
        "Made by `holocal bench`. P is a bare complex64 FFT and its inverse of the same size, two threads, "
        "the faster of scipy and torch, measured next to each run in the same process; times are medians. Machines are "
        "shared and noisy: compare ratios, and those to one digit.",
        "",
        "Machine: " + ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in machine.items()) + ".",
    ]
    lines += [f"\n![{name}](images/{name})" for name in plots]
    for table, title in TITLES.items():
        chosen = [row for row in rows if row["table"] == table]
        if chosen:
            lines += ["", f"## {title}", "", NOTES[table], "", *_table(chosen, COLUMNS[table])]
    return "\n".join(lines) + "\n"


def _table(rows: Sequence[Row], columns: Sequence[tuple[str, str, str]]) -> list[str]:
    used = [column for column in columns if any(row.get(column[0]) is not None for row in rows)]
    lines = ["| " + " | ".join(name for _, name, _ in used) + " |", "|" + " --- |" * len(used)]
    lines += ["| " + " | ".join(_cell(row.get(key), form) for key, _, form in used) + " |" for row in rows]
    return lines


def _cell(value: Any, form: str) -> str:
    if value is None:
        return ""
    if isinstance(value, dict):
        return ", ".join(f"{name} {spent:.2g}" for name, spent in value.items() if spent >= 5e-3)
    return format(value, form) if form else str(value)


def write_page(directory: Path, rows: Sequence[Row], machine: Row) -> list[Path]:
    """Write ``benchmarks.md`` and its plots under ``images/`` into a directory; return the files."""
    images = directory / "images"
    images.mkdir(parents=True, exist_ok=True)
    drawings = (("benchmarks_synthesis.png", _draw_synthesis), ("benchmarks_quality.png", _draw_quality))
    plots = [name for name, draw in drawings if draw(rows, images / name)]
    page = directory / "benchmarks.md"
    write_bytes(page, as_markdown(rows, machine, plots=plots).encode())
    return [page, *(images / name for name in plots)]


def _draw_synthesis(rows: Sequence[Row], path: Path) -> bool:
    """Draw run time against relative L2 error; return whether there was anything to draw."""
    chosen = [row for row in rows if row["table"] == "synthesis" and row.get("relative_l2") is not None]
    if not chosen:
        return False
    figure, axes = _axes("run time, FFT pairs of the same size", "relative L2 error against the direct sum")
    methods = list(dict.fromkeys(row["method"] for row in chosen))
    sizes = sorted({row["size"] for row in chosen})
    for row in chosen:
        colour, marker = f"C{methods.index(row['method']) % 10}", "os^v"[sizes.index(row["size"]) % 4]
        axes.loglog(row["ratio_p"], row["relative_l2"], marker, color=colour, label=f"{row['method']}, {row['size']}")
    axes.legend(fontsize=7)
    axes.set_title("Synthesis of 750 x 750 points")
    figure.savefig(path, dpi=110)
    return True


def _draw_quality(rows: Sequence[Row], path: Path) -> bool:
    """Draw camera PSNR against iterations for every encoder; return whether there was anything to draw."""
    chosen = [row for row in rows if row["table"] == "quality" and row["image"] == _first_image(rows)]
    if not chosen:
        return False
    figure, axes = _axes("iterations (one pass: 1)", "PSNR as a camera sees it, dB")
    names = sorted({(row["encoder"], row["grid"]) for row in chosen})
    for i, (name, grid) in enumerate(names):
        for start, marker in (("random", "o"), ("quadratic", "s")):
            of = [row for row in chosen if (row["encoder"], row["grid"], row["start"]) == (name, grid, start)]
            x, y = [max(row["iterations"], 1) for row in of], [row["camera_db"] for row in of]
            label = f"{name}, {grid}, {start}"
            axes.semilogx(x, y, f"{marker}-", color=f"C{i % 10}", label=label, ms=4, lw=0.8)
    axes.legend(fontsize=5, ncols=2)
    axes.set_title("Encoders: 512 x 512 photograph, 1024 x 1024 pixels")
    figure.savefig(path, dpi=110)
    return True


def _first_image(rows: Sequence[Row]) -> str | None:
    """Return the first image that the quality rows name."""
    return next((row["image"] for row in rows if row["table"] == "quality"), None)


def _axes(x_label: str, y_label: str) -> tuple[Any, Any]:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.5, 5), layout="constrained")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(visible=True, which="both", lw=0.3)
    return figure, axes
