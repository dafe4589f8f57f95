"""Make the synthetic captures, their truth and their manifest: ``python data_synthetic/make.py [--check]``.

Everything comes from PCG64(20260); `--check` makes all of it anew in a temporary directory and compares.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
SEED, SIZE, FULL_SCALE = 20260, 300, 4095
OFFSET, READ_NOISE, ELECTRONS_PER_COUNT = 64, 2.0, 4.0
BRIGHTEST = 800.0  # mean counts: five speckle contrasts of 0.45 below full scale and more
CONTRAST_FIELDS, GRAIN_SIGMA_PX = 5, 0.4  # the mean of five exponential intensities has contrast 1 / sqrt(5) = 0.45
SHIFT = (12.0, 0.0)  # columns, rows
BLOBS, BLOB_SIGMA_PX = 9, 2.4
UNLISTED = ("make.py", "README.md", "manifest.json")

Array = NDArray[np.float64]


def field() -> Array:
    """Return the truth: a smooth brightness of 4:1, 1 at its brightest, right of the middle and above it."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))
    log = -((x - 0.3) ** 2) - 0.7 * (y + 0.2) ** 2 + 0.25 * x * y
    log -= log.max()
    return np.asarray(np.exp(log * np.log(4.0) / -log.min()))


def blobs(places: Array) -> Array:
    """Return round blobs at places (n, 2), (column, row) in pixels, 1 at each centre."""
    image = np.zeros((SIZE, SIZE))
    at = np.arange(SIZE)
    for column, row in places:
        across, down = (np.exp(-0.5 * ((at - centre) / BLOB_SIGMA_PX) ** 2) for centre in (column, row))
        image += np.outer(down, across)
    return np.minimum(image, 1.0)


def speckle(rng: np.random.Generator) -> Array:
    """Return correlated speckle of mean 1 and gamma-like distribution."""
    waves = rng.standard_normal((2 * CONTRAST_FIELDS, SIZE, SIZE))
    soft = np.stack([cv2.GaussianBlur(wave, (7, 7), GRAIN_SIGMA_PX) for wave in waves])
    intensity = np.sum(soft**2, axis=0)
    return np.asarray(intensity / intensity.mean())


def capture(rng: np.random.Generator, brightness: Array) -> NDArray[np.uint16]:
    """Return the camera's counts of a brightness in counts: shot noise, read noise, offset, 12 bits."""
    electrons = rng.poisson(ELECTRONS_PER_COUNT * brightness)
    counts = electrons / ELECTRONS_PER_COUNT + OFFSET + rng.normal(0, READ_NOISE, brightness.shape)
    return np.clip(np.rint(counts), 0, FULL_SCALE).astype(np.uint16)


def make(directory: Path) -> None:
    """Write captures, truth and manifest into a directory."""
    rng = np.random.Generator(np.random.PCG64(SEED))
    truth = field()
    grid = np.stack(np.meshgrid(np.arange(BLOBS), np.arange(BLOBS)), axis=-1).reshape(-1, 2) + 0.5
    places = (grid + rng.uniform(-0.3, 0.3, grid.shape)) * SIZE / BLOBS - 0.5
    shown = {
        "white-0.png": truth,
        "white-1.png": truth,
        "blobs-shifted.png": truth * blobs(places + SHIFT),
        "dark.png": np.zeros_like(truth),
    }
    for name, brightness in shown.items():
        counts = capture(rng, BRIGHTEST * brightness * speckle(rng))
        if not cv2.imwrite(str(directory / name), counts, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
            raise OSError(f"{directory / name} could not be written")
    np.save(directory / "truth.npy", truth.astype(np.float32))
    known: dict[str, Any] = {
        "seed": SEED,
        "full_scale": FULL_SCALE,
        "offset_counts": OFFSET,
        "read_noise_counts": READ_NOISE,
        "electrons_per_count": ELECTRONS_PER_COUNT,
        "brightest_mean_counts": BRIGHTEST,
        "shift_px": list(SHIFT),
        "blob_places_px": [[round(float(v), 4) for v in place] for place in places],
        "brightness_map": "truth.npy",
        "captures": list(shown),
    }
    _write_json(directory / "truth.json", known)
    files = sorted(path for path in directory.iterdir() if path.is_file() and path.name not in UNLISTED)
    _write_json(directory / "manifest.json", {path.name: described(path) for path in files})


def described(path: Path) -> dict[str, Any]:
    """Return a file's manifest entry."""
    data = path.read_bytes()
    return {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}


def differences(one: Path, other: Path) -> list[str]:
    """Return the names of what differs in pixels or truth; another PNG encoder's bytes may differ, pixels not."""
    found = []
    for name in json.loads((one / "manifest.json").read_text()):
        here, there = one / name, other / name
        if not there.is_file():
            found.append(name)
        elif name.endswith(".png"):
            pixels = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (here, there)]
            same = all(picture is not None for picture in pixels) and np.array_equal(*pixels)
            found += [] if same else [name]
        elif name.endswith(".npy"):  # exp and log may differ by a bit from one C library to the next
            found += [] if np.allclose(np.load(here), np.load(there), rtol=1e-6, atol=0) else [name]
        elif json.loads(here.read_text()) != json.loads(there.read_text()):
            found.append(name)
    return found


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Make the files here, or with ``--check`` compare them with a fresh make; 1 when they differ."""
    if arguments not in ([], ["--check"]):
        sys.stderr.write("usage: make.py [--check]\n")
        return 2
    if not arguments:
        make(HERE)
        return 0
    with tempfile.TemporaryDirectory() as fresh:
        make(Path(fresh))
        wrong = differences(HERE, Path(fresh))
    listed = json.loads((HERE / "manifest.json").read_text())
    wrong += [name for name, entry in listed.items() if described(HERE / name) != entry]
    sys.stdout.write("as made\n" if not wrong else f"different: {', '.join(sorted(set(wrong)))}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
