"""Make the synthetic captures and scenes, their truth and their manifest: ``python data_synthetic/make.py [--check]``.

The captures come from PCG64(20260), the scenes from formulas; `--check` makes all of it anew in a temporary directory
and compares.
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
SCENE_FOV_DEG, SCENE_SIZE = 25.0, 160
VIEW_PLACES_MM, NEAR_CARD_M = (-1.0, 0.0, 1.0), 0.25
OVERSAMPLING = 4

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
    make_scenes(directory)
    write_text(directory / "tolerances.toml", TOLERANCES)
    files = sorted(path for path in directory.iterdir() if path.is_file() and path.name not in UNLISTED)
    _write_json(directory / "manifest.json", {path.name: described(path) for path in files})


def make_scenes(directory: Path) -> None:
    """Write an example of each kind of scene file."""
    write_text(directory / "points.csv", spiral())
    write_text(directory / "mesh.obj", ball_before_box())
    x, y = scene_tangents()
    ring = np.abs(np.hypot(x + 0.04, y - 0.03) - 0.09) < 0.03
    bars = (np.floor((x + 0.5 * y) / 0.03) % 2 == 0) & (y > -0.15)
    write_image(directory / "layer-ring.png", averaged(ring * 1.0))
    write_image(directory / "layer-bars.png", averaged(bars * 0.6))
    write_text(directory / "layers.toml", LAYERS)
    views = ["# 3 x 3 parallel views of a bright card 0.25 m away before bars far away.", "schema = 1"]
    for row, y_mm in enumerate(reversed(VIEW_PLACES_MM)):
        for column, x_mm in enumerate(VIEW_PLACES_MM):
            name = f"view-{row}-{column}.png"
            write_image(directory / name, two_planes(x, y, (x_mm * 1e-3, y_mm * 1e-3)))
            views += ["", "[[view]]", f'image = "{name}"', f"pupil_mm = [{x_mm}, {y_mm}]"]
    write_text(directory / "light_field.toml", "\n".join(views) + "\n")


TOLERANCES = """\
# Tolerances of a bench on an optical table, for `holocal tolerance data_synthetic/tolerances.toml`.
schema = 1
distribution = "normal"                # or "uniform": the numbers are then limits, not standard deviations
wanted_yield = 0.95

[mirror]                               # about and along x, y, z of the eye's frame
rotation_deg = [0.1, 0.1, 0.2]
shift_mm = [0.1, 0.1, 0.2]

[slm]                                  # about and along x, y, z of the panel's own frame
rotation_deg = [0.15, 0.15, 0.3]
shift_mm = [0.2, 0.2, 0.5]
distribution = "uniform"

[spec]                                 # what an image must meet; left out: the defaults of docs/tolerance.md
wavefront_worst_rad = 0.45             # the diffraction limit, a fourteenth of a wave
distortion_max_px = 1.0                # camera pixels
nonuniformity_rms = 0.1
light_fraction = 0.5                   # of the nominal bench's, before it is evened out
field_coverage = 0.75                  # of the nominal bench's
"""

LAYERS = """\
# A ring 0.3 m away before bars at 2 m; the ring is its own mask.
schema = 1

[[layer]]
image = "layer-ring.png"
mask = "layer-ring.png"
depth_m = 0.3

[[layer]]
image = "layer-bars.png"
depth_m = 2.0
intensity = 0.8
"""


def spiral() -> str:
    """Return a CSV file: a spiral that winds away from 0.25 m to 4 m, and one star at infinity."""
    turn = np.linspace(0.0, 3.0, 120)
    x, y = (2 + 2.5 * turn) * np.cos(2 * np.pi * turn), (2 + 2.5 * turn) * np.sin(2 * np.pi * turn)
    rows = zip(x, y, 1 / np.linspace(4.0, 0.25, 120), np.linspace(0.3, 1.0, 120), strict=True)
    lines = [
        "# A spiral that winds away from 0.25 m to 4 m, and a star.",
        "theta_x_deg, theta_y_deg, distance_m, intensity",
    ]
    lines += [", ".join(decimals(*row)) for row in rows]
    return "\n".join([*lines, "-9.0, 10.5, inf, 5.0"]) + "\n"


def ball_before_box() -> str:
    """Return an OBJ file: a ball of triangles, brighter on one side, before a box of squares; +z to the viewer."""
    vertices: list[tuple[float, float, float, float]] = []  # x, y, z, grey
    faces: list[tuple[int, ...]] = []
    rings, sectors = 10, 16
    for i in range(rings + 1):
        for j in range(sectors):
            polar, around = np.pi * i / rings, 2 * np.pi * j / sectors
            x, y, z = np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)
            vertices.append((0.5 * x + 0.4, 0.5 * y + 0.2, 0.5 * z + 1.1, 0.75 + 0.25 * y))
    for i in range(rings):
        for j in range(sectors):
            a, b = i * sectors + j + 1, i * sectors + (j + 1) % sectors + 1
            faces += [(a, b, b + sectors), (a, b + sectors, a + sectors)]
    corner = len(vertices) + 1
    vertices += [(x, y, z, 0.4) for z in (-0.8, 0.4) for y in (-0.7, 0.7) for x in (-0.9, 0.9)]
    squares = ((4, 5, 7, 6), (1, 0, 2, 3), (0, 4, 6, 2), (5, 1, 3, 7), (6, 7, 3, 2), (0, 1, 5, 4))
    faces += [tuple(corner + k for k in square) for square in squares]
    lines = ["# A ball before a box; +z points to the viewer. v: x y z red green blue"]
    lines += [" ".join(("v", *decimals(x, y, z, g, g, g))) for x, y, z, g in vertices]
    lines += ["f " + " ".join(map(str, face)) for face in faces]
    return "\n".join(lines) + "\n"


def scene_tangents() -> tuple[Array, Array]:
    """Return tangents (x to the right, y up) of an image's pixels, each divided for averaging."""
    count = SCENE_SIZE * OVERSAMPLING
    line = (2 * np.arange(count) + 1 - count) / count * np.tan(np.radians(SCENE_FOV_DEG / 2))
    x, y = np.meshgrid(line, -line)
    return x, y


def two_planes(x: Array, y: Array, q: tuple[float, float]) -> Array:
    """Return what a camera at q (metres) sees that looks along the gaze: P = (X, Y, Z) is at ((X, Y) - q) / Z."""
    far = 0.35 * (np.floor((x - 0.4 * y) / 0.035) % 2 == 0)
    on_card_x, on_card_y = x + q[0] / NEAR_CARD_M, y + q[1] / NEAR_CARD_M
    card = (np.abs(on_card_x - 0.03) < 0.06) & (np.abs(on_card_y + 0.02) < 0.08)
    hole = np.hypot(on_card_x - 0.04, on_card_y - 0.01) < 0.025
    return averaged(np.where(card & ~hole, 1.0, far))


def averaged(fine: Array) -> Array:
    """Return an image whose pixels are the means of their parts."""
    n = SCENE_SIZE
    return np.asarray(fine.reshape(n, OVERSAMPLING, n, OVERSAMPLING).mean(axis=(1, 3)))


def write_image(path: Path, image: Array) -> None:
    """Write an image of 0..1 as an 8-bit grey PNG."""
    if not cv2.imwrite(str(path), np.rint(image * 255).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise OSError(f"{path} could not be written")


def decimals(*values: float) -> list[str]:
    """Return numbers with four decimals, never -0: its sign may differ from one C library to the next."""
    return [f"{round(float(value), 4) + 0.0:.4f}" for value in values]


def write_text(path: Path, text: str) -> None:
    """Write a text file with the same line ends everywhere."""
    path.write_text(text, encoding="utf-8", newline="\n")


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
        elif name.endswith(".json"):
            found += [] if json.loads(here.read_text()) == json.loads(there.read_text()) else [name]
        elif here.read_text() != there.read_text():
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
