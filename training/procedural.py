"""Endless tileable materials with exact maps, to train on: each seed is another brick wall, weave, rust or gravel.

    .venv/bin/python training/procedural.py SHEET.png [SEED]     # 48 of them, rendered, to look at

A family builds a height, a colour, a roughness and a metalness from noise and cells on the torus; then age goes over it
(dirt in the crevices, worn edges, stains, leaks, puddles, scratches, prints). What a network must not take for granted
is broken on purpose in a share of the materials: relief without a change of colour, pictures and stains on flat ground,
roughness that follows the height, the colour (either way), or nothing. Ranges of slope, roughness and contrast are
those of the training materials in the data folder; about 40 ms at 256 px on one thread.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
if "material_palette" not in sys.modules:
    sys.path.insert(0, str(ROOT))
    import dev

    dev.load_package()
from material_palette.core.image import linear_from_srgb  # noqa: E402
from material_palette.core.material import SVBRDF  # noqa: E402
from material_palette.core.torus import normal_from_height  # noqa: E402

# sRGB, from light to dark within a line as they occur together
PALETTES = {
    "brick": "c98d6d b5654a 9c4f3c 8a4636 7a5140 a8826a d2b08a c9bfae 6b4a42 8f8a80 e0d8cc 5c4038",
    "stone": "b8b0a2 9c948a 857d74 8f8878 6e6a64 a39a86 7b7f80 5c5d5e c4b9a0 939a9c 75695c 4d4a48",
    "rock": "7d746a 665f57 8c7d68 535250 9a8a73 6f7678 474a4a a69a88 805a40 5d5148 34383a b0a9a0",
    "concrete": "a9a7a2 8f8d88 bab7b0 7b7a77 9c978c c7c4bd 6d6d6c 8b8f92",
    "plaster": "e8e2d6 d9cdb8 f0eee9 cfc0a5 d8b79a c9a58c b5c0c2 e3d3a8 bcae9c ddb5a0 9fb0a8 f4f1ea",
    "wood": "8a6240 a77b4f 6b4528 c49a68 5a3a24 9b7a58 b98d5a 7a6a5a 8e8478 d6b285 4a2f20 a35f35 6d6660",
    "soil": "6b5238 57412c 84684a 463525 9a7f5d 3b3028 75604a a38a68 5f4a3a",
    "sand": "d6bf96 c2a67a e3d3b0 b0906a cdb58e b99a78 a58868 e8dcc8",
    "asphalt": "5a5a59 484848 6a6967 3c3c3d 757370 52504e 82807c 2f2f30",
    "leaf": "7a5a2e 94703a 5c4424 a8823f 6b4a2a 8c3f22 b59a58 4b5a26 6a7a34 3d4a22 a0642c",
    "grass": "5f7a2c 4a6424 7a8f3c 8f9a50 3c5220 a09a58 6a6a30 56703a b0a468",
    "steel": "c9cacc b5b6b8 dcdcdb 9c9d9f c4c0b8 8a8b8e",
    "alloy": "d9b36a c98f5c e2c488 b5b6b8 d8d2c6 c57a55 f0dfae",
    "rust": "7a4020 93502a 5c2f1a a8683a 6b4a38 b5783f 4a2c20 8a5a3a",
    "leather": "6b4028 50301e 8a5a38 3a2a22 a07048 2a2422 7a2a20 c09a70 444038",
    "paper": "efece4 e0d8c4 f6f5f2 d2c4a4 c8c0b0 e8e4da",
    "grout": "b8b2a6 9c968a d0cabe 7d7870 605c56 a89c88 e2ddd4",
    "dirt": "4a4034 3a3228 5c5040 2e2a24 6a5c48 50483e",
    "moss": "4a5a26 5c6a30 3c4a20 6e7a44",
    "slate": "5a5f63 4a4e52 6b6c6e 3e4144 746a64 5f5a60 7a7f80",
    "clay": "b5653e a2563a c77f55 8a4a34 9a6a50 d29a70 6f4434",
}


def smooth(x, low, high):
    """Smoothstep from low to high."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a, b, weight):
    """a where weight is 0, b where it is 1; for colours too."""
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    if a.ndim in (1, 3) or b.ndim in (1, 3):
        weight = np.asarray(weight)[..., None]
    return a + (b - a) * weight


@dataclass
class Cells:
    """A division of the torus: number of the cell, offset from its centre and distance to its border in tile widths."""

    id: np.ndarray
    x: np.ndarray
    y: np.ndarray
    edge: np.ndarray
    count: int


class Canvas:
    """Random draws and patterns on the torus of size x size px; u to the right and v downwards in tile widths."""

    def __init__(self, seed: int, size: int):
        self.random = np.random.Generator(np.random.PCG64(seed))
        self.size = size
        # from 1 to 2, so that a joint may lie anywhere and a warped coordinate stays positive
        axis = (np.arange(size) + 0.5) / size
        start = 1 + self.random.random((2, 1))
        self.u, self.v = np.meshgrid(*(axis + start).astype(np.float32))
        self.frequency_v = np.fft.fftfreq(size, 1 / size).astype(np.float32)[:, None]
        self.frequency_u = np.fft.rfftfreq(size, 1 / size).astype(np.float32)[None]

    # ------------------------------------------------------------ draws

    def uniform(self, low, high):
        return float(self.random.uniform(low, high))

    def log_uniform(self, low, high):
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def integer(self, low, high):
        """low to high, both included."""
        return int(self.random.integers(low, high + 1))

    def chance(self, probability):
        return bool(self.random.random() < probability)

    def choice(self, options):
        return options[int(self.random.integers(len(options)))]

    def colours(self, name, count):
        """(count, 3) sRGB of one palette, or of any hue ("paint"), shifted a little together and each for itself."""
        if name == "paint":
            hue = np.full(count, self.random.uniform(0, 1)) + self.random.normal(0, 0.04, count)
            hsv = np.stack(
                [
                    hue % 1 * 360,
                    np.clip(self.random.beta(1.2, 2.6) + self.random.normal(0, 0.08, count), 0, 0.95),
                    np.clip(self.random.uniform(0.12, 0.95) + self.random.normal(0, 0.08, count), 0.06, 0.97),
                ],
                -1,
            )
            return cv2.cvtColor(hsv[None].astype(np.float32), cv2.COLOR_HSV2RGB)[0]
        listed = PALETTES[name].split()
        first = int(self.random.integers(len(listed)))
        near = (first + self.random.permutation(np.arange(len(listed)))[:count]) % len(listed)
        near[0] = first
        rgb = np.array([[int(listed[i][k : k + 2], 16) / 255 for k in (0, 2, 4)] for i in np.resize(near, count)])
        # most materials keep to shades of one colour
        rgb = rgb[0] + (rgb - rgb[0]) * self.random.beta(1.0, 1.6)
        rgb = rgb * np.exp(self.random.normal(0, 0.16)) * np.exp(self.random.normal(0, 0.03, 3))
        rgb = rgb * np.exp(self.random.normal(0, 0.05, (count, 1)))
        grey = rgb.mean(-1, keepdims=True)
        return np.clip(grey + (rgb - grey) * self.random.uniform(0.5, 1.35), 0.02, 0.98).astype(np.float32)

    def ramp(self, t, colours):
        """Colour (H, W, 3) at t in [0, 1] along colours (n, 3)."""
        table = np.stack([np.interp(np.linspace(0, 1, 256), np.linspace(0, 1, len(colours)), c) for c in colours.T], -1)
        return table.astype(np.float32)[(np.clip(t, 0, 1) * 255).astype(np.int32)]

    # ------------------------------------------------------------ noise

    def spectrum(self, weight):
        """Gaussian noise (size, size), mean 0, deviation 1, of a weight per frequency."""
        white = self.random.random((2, self.size, self.size // 2 + 1), np.float32) - 0.5
        shaped = torch.complex(*torch.from_numpy(white * weight))
        shaped[0, 0] = 0
        noise = torch.fft.irfft2(shaped, s=(self.size, self.size)).numpy()
        return noise / max(float(noise.std()), 1e-9)

    def noise(self, low=2.0, high=None, slope=1.0, along=None, stretch=6.0):
        """Fractal noise between low and high cycles per tile, amplitude falling with frequency^(slope + 1/2).

        along "u" or "v" draws it out in that direction by stretch.
        """
        high = high or self.size / 2
        u, v = self.frequency_u, self.frequency_v
        if along == "u":
            u = u * stretch
        elif along == "v":
            v = v * stretch
        f = np.sqrt(u**2 + v**2)
        f[0, 0] = 1.0  # the mean, taken out by `spectrum`
        return self.spectrum((f / low) ** (-slope - 0.5) / (1 + (low / f) ** 6) ** 0.5 / (1 + (f / high) ** 6) ** 0.5)

    def uniform_noise(self, *args, **kwargs):
        """The same, spread evenly over [0, 1]."""
        n = self.noise(*args, **kwargs)
        return (1 / (1 + np.exp(-1.7 * n))).astype(np.float32)

    def blur(self, x, pixels):
        w = np.exp(-2 * (np.pi * pixels / self.size) ** 2 * (self.frequency_u**2 + self.frequency_v**2))
        return torch.fft.irfft2(
            torch.fft.rfft2(torch.from_numpy(np.ascontiguousarray(x))) * torch.from_numpy(w), s=x.shape
        ).numpy()

    def look_up(self, x, u, v):
        """x at (u, v) in tile widths, nearest."""
        columns = (u * self.size).astype(np.int32) % self.size
        return x[(v * self.size).astype(np.int32) % self.size, columns]

    def per_cell(self, cells, spread=1.0):
        """A normal deviate for each cell, as a map."""
        return (self.random.standard_normal(cells.count).astype(np.float32) * spread)[cells.id]

    def shuffled(self, x, cells):
        """x, moved by another offset in each cell: the same grain, but not going through."""
        du, dv = self.random.random((2, cells.count), np.float32)
        return self.look_up(x, self.u + du[cells.id], self.v + dv[cells.id])

    def warp(self, amount, low=2.0, high=8.0):
        """(u, v) displaced by noise of so many tile widths."""
        return self.u + amount * self.noise(low, high, 1.5), self.v + amount * self.noise(low, high, 1.5)

    # ------------------------------------------------------------ cells

    def voronoi(self, columns, rows=None, jitter=0.85, hexagonal=False, at=None):
        """Voronoi cells of one point in each field of a grid, jittered; hexagonal: every second row shifted by half."""
        rows = rows or columns
        x, y = at if at is not None else (self.u, self.v)
        x, y = (x * columns).ravel(), (y * rows).ravel()
        column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
        points = 0.5 + jitter * (self.random.random((2, rows, columns), np.float32) - 0.5)
        if hexagonal:
            points[0, ::2] -= 0.25
            points[0, 1::2] += 0.25
        numbers = np.pad(np.arange(rows * columns).reshape(rows, columns), 1, mode="wrap").ravel()
        px, py = (np.pad(p, 1, mode="wrap").ravel() for p in points)
        # a warped coordinate may leave the tile
        at_cell = (row % rows + 1) * (columns + 2) + column % columns + 1
        fx, fy = (x - column).astype(np.float32), (y - row).astype(np.float32)
        neighbours = [(i, j, j * (columns + 2) + i) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        squared = np.empty((9, x.size), np.float32)
        for d, (i, j, step) in zip(squared, neighbours, strict=True):
            here = at_cell + step
            dx, dy = (px.take(here) + (i - fx)) / columns, (py.take(here) + (j - fy)) / rows
            np.add(dx * dx, dy * dy, out=d)
        best, found = [], []
        for _ in range(2):
            least = squared.min(0)
            k = np.zeros(x.size, np.intp)
            for n in range(1, 9):
                k[squared[n] == least] = n
            best.append(least)
            found.append(k)
            squared[k, np.arange(x.size)] = np.inf
        steps = np.array(neighbours)
        at = [at_cell + steps[k, 2] for k in found]
        first, second = (
            ((px.take(h) + steps[k, 0] - fx) / columns, (py.take(h) + steps[k, 1] - fy) / rows)
            for h, k in zip(at, found, strict=True)
        )
        first, second = (tuple(d.astype(np.float32) for d in pair) for pair in (first, second))
        index = at[0]
        apart = np.sqrt((second[0] - first[0]) ** 2 + (second[1] - first[1]) ** 2)
        edge = (best[1] - best[0]) / (2 * apart + 1e-6)
        shape = (self.size, self.size)
        return Cells(
            numbers[index].reshape(shape).astype(np.int32),
            -first[0].reshape(shape),
            -first[1].reshape(shape),
            edge.reshape(shape),
            rows * columns,
        )

    def courses(self, columns, rows, bond, at=None):
        """Rectangles laid in courses: bond running, third, stack, random, flemish, herringbone or basket."""
        u, v = at if at is not None else (self.u, self.v)
        if bond in ("herringbone", "basket"):
            n = max(4, 4 * round(columns / 4))
            x, y = u * n, v * n
            i, j = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
            k = (i - j) % 4 if bond == "herringbone" else (i % 2 + 2 * ((i // 2 + j // 2) % 2))
            if bond == "herringbone":
                flat = k < 2
                i0, j0 = np.where(k == 1, i - 1, i), np.where(k == 2, j - 1, j)
            else:
                flat = k < 2
                i0, j0 = np.where(flat, i - i % 2, i), np.where(flat, j, j - j % 2)
            w, h = np.where(flat, 2, 1) / n, np.where(flat, 1, 2) / n
            x, y = (x - i0) / n - w / 2, (y - j0) / n - h / 2
            number = (j0 % n) * n + i0 % n
            count = n * n
        else:
            y = v * rows
            row = np.floor(y).astype(np.int32)
            shift = {
                "running": (np.arange(rows) % 2) * 0.5,
                "third": (np.arange(rows) % 3) / 3,
                "flemish": (np.arange(rows) % 2) * 0.5,
                "stack": np.zeros(rows),
            }.get(bond, self.random.random(rows))[row % rows].astype(np.float32)
            x = u * columns + shift
            column = np.floor(x).astype(np.int32)
            x = x - column
            if bond == "flemish":  # a stretcher of two thirds, a header of one
                header = x >= 2 / 3
                w = np.where(header, 1 / 3, 2 / 3) / columns
                x = np.where(header, x - 5 / 6, x - 1 / 3) / columns
                number = ((row % rows) * columns + column % columns) * 2 + header
                count = rows * columns * 2
            else:
                w = 1 / columns
                x = (x - 0.5) / columns
                number = (row % rows) * columns + column % columns
                count = rows * columns
            h = 1 / rows
            y = (y - row - 0.5) / rows
        edge = np.minimum(w / 2 - np.abs(x), h / 2 - np.abs(y))
        x, y, edge = (a.astype(np.float32) for a in (x, y, edge))
        return Cells(number.astype(np.int32), x, y, edge, count)

    # ------------------------------------------------------------ strokes

    def strokes(self, count, length, width, direction=None, spread=0.3, bend=0.3, layers=1):
        """Bent lines drawn over each other: (level 0 to 1 with 0 the ground, cross-section 0 to 1, number in [0, 1)).

        length and width in tile widths; direction in radians, None for any.
        """
        size, r = self.size, self.random
        canvas = np.zeros((size, size, 3), np.float32)
        angle = r.uniform(0, 2 * np.pi, count) if direction is None else direction + r.normal(0, spread, count)
        lengths, start = length * r.uniform(0.5, 1.3, count), r.uniform(0, 1, (count, 2))
        bends, values = r.normal(0, bend, count), r.random(count)
        t = np.linspace(-0.5, 0.5, 6)
        for k in range(count):
            along = angle[k] + bends[k] * t
            step = np.stack([np.cos(along), np.sin(along)], -1) * (lengths[k] / 5)
            line = ((start[k] + np.cumsum(step, 0)) * size * 16).astype(np.int32)
            low, high = line.min(0) // 16, line.max(0) // 16
            margin = int(width * size) + 2
            for sx in (-1, 0, 1):
                if high[0] + sx * size < -margin or low[0] + sx * size > size + margin:
                    continue
                for sy in (-1, 0, 1):
                    if high[1] + sy * size < -margin or low[1] + sy * size > size + margin:
                        continue
                    shifted = line + np.array([sx, sy], np.int32) * size * 16
                    for share in np.linspace(1, 0.3, layers):
                        thickness = max(1, round(width * share * size))
                        colour = ((k + 1) / count, 1 - share + 1 / layers, float(values[k]))
                        cv2.polylines(canvas, [shifted], False, colour, thickness, cv2.LINE_8, 4)
        return np.moveaxis(canvas, -1, 0)


@dataclass
class Surface:
    """What a family builds. Height in any unit: `material` scales it to the rms slope drawn from `slope`."""

    height: np.ndarray
    colour: np.ndarray  # (H, W, 3) sRGB
    roughness: np.ndarray | float
    metallic: np.ndarray | float = 0.0
    slope: tuple[float, float] = (0.05, 0.5)
    dirt: tuple[str, ...] = field(default=("dirt",))


# ---------------------------------------------------------------- families: laid


def _laid(c, cells, joint, bevel, colours, joint_name, palette_roughness, rough_joint=(0.7, 0.95)):
    """Stones of any division: bevelled, tilted, set at different depth, in a bed of mortar."""
    edge = cells.edge + c.choice([0.02, 0.1, 0.3]) * joint * c.noise(8, 64, 1.0)
    top = smooth(edge, joint / 2, joint / 2 + bevel)
    tilt = c.per_cell(cells, 1.0) * cells.x + c.per_cell(cells, 1.0) * cells.y
    level = c.per_cell(cells, c.uniform(0, 0.25)) + c.uniform(0, 1) / max(bevel, 0.01) * 0.15 * tilt
    grain = c.shuffled(c.noise(c.uniform(4, 12), None, c.uniform(0.6, 1.3)), cells)
    pits = c.shuffled(smooth(c.noise(c.uniform(10, 30), None, 0.7), 1.2, 2.2), cells)
    rough_top = c.log_uniform(0.01, 0.25)
    height = top * (1 + level + rough_top * grain - c.uniform(0, 0.5) * pits)
    height = height + (1 - top) * c.log_uniform(0.01, 0.12) * c.noise(12, None, 0.8)
    t = 0.5 + c.per_cell(cells, c.uniform(0.05, 0.4)) + c.uniform(0, 0.18) * grain
    tint = c.per_cell(cells, c.uniform(0, 0.06))[..., None] * np.array([1, 0.3, -0.6], np.float32)
    colour = c.ramp(t, colours) * (1 + c.per_cell(cells, c.uniform(0, 0.12)))[..., None] + tint
    colour = colour * (1 - c.uniform(0, 0.4) * pits)[..., None]
    mortar = c.colours(joint_name, 2)
    colour = mix(c.ramp(0.5 + 0.2 * c.noise(6, None, 0.7), mortar), colour, smooth(edge, joint / 2, joint / 2 + 0.008))
    roughness = c.uniform(*palette_roughness) + c.per_cell(cells, c.uniform(0, 0.06)) + c.uniform(0, 0.06) * grain
    roughness = mix(np.full_like(height, c.uniform(*rough_joint)), roughness, smooth(edge, 0, joint / 2 + 0.01))
    return height, colour, roughness, grain


def bricks(c):
    rows = c.choice([3, 4, 6, 8, 9, 12])
    bond = c.choice(["running", "running", "flemish", "third", "stack", "random", "herringbone", "basket"])
    columns = max(1, round(rows / c.uniform(2.2, 3.4)))
    rows = {"running": rows + rows % 2, "flemish": rows + rows % 2, "third": 3 * max(1, round(rows / 3))}.get(
        bond, rows
    )
    cells = c.courses(
        rows if bond in ("herringbone", "basket") else columns, rows, bond, c.warp(c.log_uniform(0.0005, 0.006), 3, 12)
    )
    joint = c.uniform(0.06, 0.2) / rows
    parts = _laid(c, cells, joint, c.uniform(0.02, 0.15) / rows, c.colours("brick", 4), "grout", (0.55, 0.9))
    return Surface(*parts[:3], slope=(0.08, 0.6), dirt=("dirt", "moss", "grout"))


def tiles(c):
    n = c.choice([1, 2, 3, 4, 5, 6, 8, 10])
    hexagonal = c.chance(0.25) and n > 2
    bond = c.choice(["stack", "stack", "running", "herringbone"])
    if hexagonal:
        rows = 2 * round(n / 1.73 * 0.87 * 1.15) or 2
        cells = c.voronoi(n, max(2, rows + rows % 2), 0.0, True)
    else:
        cells = c.courses(n, max(2, n + n % 2) if bond == "running" else n * c.choice([1, 1, 2]), bond)
    joint = c.uniform(0.015, 0.07) / n
    family = c.choice(["paint", "plaster", "stone", "clay", "slate", "paint"])
    glazed = c.chance(0.6)
    height, colour, roughness, _ = _laid(
        c,
        cells,
        joint,
        c.uniform(0.005, 0.04) / n + 0.004,
        c.colours(family, 3),
        "grout",
        (0.08, 0.4) if glazed else (0.35, 0.75),
    )
    if glazed:  # smooth tops
        top = smooth(cells.edge, joint / 2, joint / 2 + 0.01)
        height = mix(height, top * (1 + 0.3 * c.per_cell(cells, 0.1) + 0.02 * c.noise(2, 6, 2.0)), 0.9)
    if c.chance(0.35):
        colour = printed(c, colour, cells)
    return Surface(height, colour, roughness, slope=(0.02, 0.3), dirt=("dirt", "grout"))


def paving(c):
    n = c.choice([3, 4, 6, 8])
    cells = (
        c.courses(n, n if c.chance(0.5) else 2 * n, c.choice(["running", "random", "herringbone", "basket", "stack"]))
        if n % 2 == 0
        else c.courses(n, 2 * n, "random")
    )
    joint = c.uniform(0.03, 0.12) / n
    parts = _laid(
        c,
        cells,
        joint,
        c.uniform(0.05, 0.2) / n,
        c.colours(c.choice(["stone", "concrete", "brick"]), 3),
        c.choice(["dirt", "sand", "moss", "grout"]),
        (0.45, 0.85),
    )
    return Surface(*parts[:3], slope=(0.05, 0.45), dirt=("dirt", "moss"))


def cobbles(c):
    n = c.integer(4, 14)
    cells = c.voronoi(
        n,
        max(2, round(n * c.uniform(0.8, 1.5))),
        c.uniform(0.3, 0.85),
        c.chance(0.4) and n % 2 == 0,
        c.warp(0.004, 4, 16),
    )
    joint, bevel = c.uniform(0.06, 0.2) / n, c.uniform(0.15, 0.45) / n
    parts = _laid(c, cells, joint, bevel, c.colours("stone", 4), c.choice(["dirt", "soil", "sand", "moss"]), (0.4, 0.8))
    return Surface(*parts[:3], slope=(0.12, 0.8), dirt=("dirt", "moss"))


def rubble(c):
    n = c.integer(3, 8)
    cells = c.voronoi(n, max(2, round(n * c.uniform(1.0, 2.2))), 0.95, at=c.warp(c.uniform(0.004, 0.02), 4, 24))
    parts = _laid(
        c,
        cells,
        c.uniform(0.04, 0.2) / n,
        c.uniform(0.03, 0.15) / n,
        c.colours(c.choice(["stone", "rock"]), 4),
        "grout",
        (0.55, 0.9),
    )
    return Surface(*parts[:3], slope=(0.12, 0.7), dirt=("dirt", "moss"))


def roof_tiles(c):
    n, rows = c.integer(4, 9), c.choice([4, 6, 8, 10])
    kind = c.choice(["slates", "shingles", "pantiles", "scallops"])
    shift = (np.floor(c.v * rows) % 2) * 0.5 if kind != "pantiles" else 0.0
    x, y = c.u * n + shift, c.v * rows
    x, y = x - np.floor(x), y - np.floor(y)
    number = ((np.floor(c.v * rows) % rows) * n + np.floor(c.u * n + shift) % n).astype(np.int32)
    cells = Cells(number, (x - 0.5) / n, (y - 0.5) / rows, np.minimum(x, 1 - x) / n, n * rows)
    height = y * c.uniform(0.6, 1.2)  # each course lies on the one below: thick at the lower edge
    if kind == "pantiles":
        height = 0.6 * height + c.uniform(0.5, 1.5) * np.sin(np.pi * x) ** c.uniform(0.6, 2.0)
        seam = smooth(cells.edge, 0.0, 0.02)
    elif kind == "scallops":
        curve = np.sqrt(np.clip(1 - (2 * x - 1) ** 2, 0, 1)) * 0.45 + 0.5
        below = y > curve
        height = np.where(below, y - 0.55, height)
        seam = smooth(np.abs(y - curve), 0.0, 0.05)
    else:
        seam = smooth(cells.edge, 0.001, c.uniform(0.004, 0.01))
        height = height * seam
    grain = c.shuffled(c.noise(5, None, 0.9, "v", c.uniform(1, 5)), cells)
    height = height + c.per_cell(cells, c.uniform(0, 0.2)) + c.log_uniform(0.01, 0.12) * grain
    colours = c.colours(c.choice(["slate", "clay", "wood", "clay"]), 4)
    t = 0.5 + c.per_cell(cells, c.uniform(0.05, 0.35)) + c.uniform(0, 0.2) * grain
    colour = c.ramp(t, colours) * (0.75 + 0.25 * seam)[..., None]
    roughness = c.uniform(0.4, 0.85) + c.per_cell(cells, 0.04) + c.uniform(0, 0.05) * grain
    return Surface(c.blur(height.astype(np.float32), 0.7), colour, roughness, slope=(0.15, 0.9), dirt=("dirt", "moss"))


def planks(c):
    n = c.integer(2, 9)
    cells = c.courses(c.choice([1, 1, 2]), n, "random", (c.u, c.v + 0.001 * c.noise(2, 6, 1.5)))
    grain, figure, pores = _grain(c)
    grain, figure, pores = (c.shuffled(x, cells) for x in (grain, figure, pores))
    joint = c.uniform(0.006, 0.05) / n
    top = smooth(cells.edge, joint / 2, joint / 2 + c.uniform(0.004, 0.06) / n + 0.004)
    cup = c.per_cell(cells, 1.0) * (cells.y * n) ** 2 + c.per_cell(cells, 0.5) * cells.y * n
    height = top * (1 + c.uniform(0, 0.3) * cup + c.log_uniform(0.01, 0.15) * grain - c.uniform(0, 0.15) * pores)
    colours = c.colours(c.choice(["wood", "wood", "wood", "paint", "plaster"]), 4)
    t = 0.5 + c.per_cell(cells, c.uniform(0.05, 0.3)) + c.uniform(0.03, 0.22) * figure + c.uniform(0, 0.1) * grain
    colour = c.ramp(t, colours) * (1 - c.uniform(0.1, 0.5) * pores)[..., None]
    colour = colour * (c.uniform(0.15, 0.7) + (1 - c.uniform(0.15, 0.7)) * top)[..., None].clip(0, 1)
    roughness = c.uniform(0.25, 0.8) + c.per_cell(cells, 0.04) + c.uniform(0, 0.06) * grain + c.uniform(0, 0.1) * pores
    return _turned(c, Surface(height, colour, roughness, slope=(0.02, 0.35)))


def _grain(c):
    """Wood along u: fine grain, figure (rings) and open pores in [0, 1]."""
    wave = c.noise(1.5, 5, 1.8, "u", 3)
    rings = np.sin(2 * np.pi * (c.integer(3, 14) * c.v + c.uniform(0.3, 1.5) * wave)) * c.uniform(0.3, 1)
    grain = c.noise(c.uniform(10, 30), None, 0.5, "u", c.uniform(10, 40))
    figure = rings + 0.6 * c.noise(4, 40, 1.0, "u", 12)
    return grain, figure, smooth(c.noise(30, None, 0.1, "u", 14), 1.3, 2.2)


def wood(c):
    grain, figure, pores = _grain(c)
    knots = np.zeros_like(grain)
    for _ in range(c.integer(0, 3)):
        x, y = (c.u + c.uniform(0, 1)) % 1 - 0.5, (c.v + c.uniform(0, 1)) % 1 - 0.5
        r = np.sqrt((x / c.uniform(1, 2.5)) ** 2 + y**2) / c.uniform(0.01, 0.05)
        knots = np.maximum(knots, np.exp(-(r**2)))
        figure = figure + 2 * np.sin(3 * r) * np.exp(-r / 2)
    t = 0.5 + c.uniform(0.08, 0.25) * figure + c.uniform(0, 0.12) * grain
    colour = (
        c.ramp(t, c.colours("wood", 4)) * (1 - c.uniform(0.1, 0.5) * pores)[..., None] * (1 - 0.5 * knots)[..., None]
    )
    height = c.uniform(0, 0.6) * figure + c.uniform(0.1, 1) * grain - c.uniform(0, 2) * pores
    roughness = c.uniform(0.2, 0.8) + c.uniform(-0.05, 0.05) * figure + c.uniform(0, 0.1) * pores
    return _turned(c, Surface(height, colour, roughness, slope=(0.005, 0.2)))


def bark(c):
    u, v = c.warp(0.03, 2, 8)
    n = c.integer(3, 8)
    cells = c.voronoi(n, max(1, n // c.integer(2, 4)), 1.0, at=(u, v))
    ridge = smooth(cells.edge, 0.0, c.uniform(0.15, 0.5) / n)
    strands = c.noise(4, None, 0.9, "v", c.uniform(3, 8))
    height = ridge * (1 + 0.2 * c.per_cell(cells)) + c.uniform(0.1, 0.5) * strands
    colours = c.colours("wood", 3)
    t = 0.35 + 0.4 * ridge * c.uniform(0, 1) + c.uniform(0, 0.2) * strands + 0.1 * c.noise(3, None, 1.0)
    colour = c.ramp(t, colours) * (c.uniform(0.4, 1) + 0.3 * ridge).clip(0, 1)[..., None]
    return Surface(
        height, colour, c.uniform(0.6, 0.95) - c.uniform(-0.15, 0.15) * ridge, slope=(0.1, 0.8), dirt=("moss", "dirt")
    )


# ---------------------------------------------------------------- families: woven and grown


def weave(c):
    n = c.choice([6, 8, 12, 16, 24, 32, 40])
    period, over = c.choice([(2, 1), (2, 1), (4, 2), (4, 3), (4, 1), (8, 1)])
    n = period * max(1, round(n / period))
    step = 3 if period == 8 else 1
    u, v = c.warp(c.uniform(0.0, 0.12) / n, 3, 16)
    x, y = u * n, v * n
    i, j = np.floor(x).astype(np.int32) % n, np.floor(y).astype(np.int32) % n
    x, y = x - np.floor(x) - 0.5, y - np.floor(y) - 0.5
    warp_above = (i + step * j) % period < over
    width = c.uniform(0.8, 1.0)
    across, along = np.where(warp_above, x, y), np.where(warp_above, y, x)
    body = np.sqrt(np.clip(1 - (2 * across / width) ** 2, 0, 1))
    height = body * (0.6 + 0.4 * np.cos(np.pi * along)) + 0.02
    twist = np.sin(2 * np.pi * (3 * along + c.uniform(1, 3) * across)) * c.uniform(0, 0.15)
    slub = c.noise(8, None, 0.6)
    height = height + twist * body + c.uniform(0, 0.12) * slub
    first, second = c.colours(c.choice(["paint", "paper", "leather", "paint"]), 2)
    if c.chance(0.4):
        second = c.colours(c.choice(["paint", "paper"]), 1)[0]
    colour = np.where(warp_above[..., None], first, second)
    if c.chance(0.25):  # coloured threads: checks and stripes
        bands = c.random.random(n) < 0.4
        stripes, crossing = bands[i], np.roll(bands, 3)[j] & c.chance(0.6)
        colour = np.where((np.where(warp_above, stripes, crossing))[..., None], c.colours("paint", 1)[0], colour)
    thread = c.random.normal(0, c.uniform(0.01, 0.08), (2, n)).astype(np.float32)
    colour = colour * (1 + np.where(warp_above, thread[0][i], thread[1][j]) + 0.04 * slub)[..., None]
    colour = colour * (1 - c.uniform(0, 0.6) * (1 - body))[..., None]
    roughness = c.uniform(0.5, 0.95) + c.uniform(-0.1, 0.1) * body
    return Surface(height.astype(np.float32), colour, roughness, slope=(0.03, 0.6))


def knit(c):
    n = c.choice([8, 12, 16, 24])
    rows = round(n * 1.3)
    x, y = c.u * n, c.v * rows
    x = x - np.floor(x) - 0.5
    y = y + 2 * np.abs(x) * c.uniform(0.6, 1.1)
    y = y - np.floor(y) - 0.5
    body = np.sqrt(np.clip(1 - (2 * y) ** 2, 0, 1)) * np.sqrt(np.clip(1 - (4 * (np.abs(x) - 0.25)) ** 2, 0, 1))
    fuzz = c.noise(20, None, 0.4)
    colours = c.colours(c.choice(["paint", "paper"]), 2)
    colour = c.ramp(0.5 + 0.2 * fuzz, colours) * (1 - c.uniform(0.2, 0.6) * (1 - body))[..., None]
    return Surface(
        (body + 0.1 * fuzz).astype(np.float32), colour, c.uniform(0.75, 0.95) + 0.02 * fuzz, slope=(0.1, 0.6)
    )


def leather(c):
    n = c.integer(10, 40)
    cells = c.voronoi(n, None, 0.9, at=c.warp(0.3 / n, n / 3, n))
    grain = smooth(cells.edge, 0, c.uniform(0.15, 0.5) / n)
    folds = smooth(np.abs(c.noise(2, 12, 1.2)), 0, c.uniform(0.05, 0.4))
    height = grain + c.uniform(0, 0.6) * folds + c.per_cell(cells, 0.15) * grain
    colours = c.colours(c.choice(["leather", "leather", "paint"]), 3)
    colour = (
        c.ramp(0.5 + 0.25 * c.noise(2, 12, 1.2) * c.uniform(0, 1), colours)
        * (1 - c.uniform(0, 0.4) * (1 - grain))[..., None]
    )
    return Surface(height, colour, c.uniform(0.25, 0.65) + c.uniform(0, 0.2) * (1 - grain), slope=(0.03, 0.35))


def grass(c):
    ground = c.noise(6, None, 0.9)
    direction = None if c.chance(0.7) else c.uniform(0, 2 * np.pi)
    level, body, value = c.strokes(
        c.integer(180, 320), c.uniform(0.1, 0.3), c.uniform(0.008, 0.02), direction, 0.5, 1.0, 2
    )
    kind = c.choice(["grass", "grass", "grass", "sand", "wood"])  # living, dry, straw and needles
    colours = c.colours(kind, 4)
    blade = level > 0
    colour = np.where(
        blade[..., None], c.ramp(0.8 * value + 0.1 * body, colours), c.ramp(0.5 + 0.2 * ground, c.colours("soil", 3))
    )
    colour = colour * (c.uniform(0.5, 1.0) + 0.5 * level).clip(0, 1)[..., None]
    height = np.where(blade, 0.3 + level + 0.3 * body, 0.15 * ground)
    roughness = np.where(blade, c.uniform(0.45, 0.85) + 0.1 * (value - 0.5), c.uniform(0.75, 0.95))
    return Surface(c.blur(height.astype(np.float32), 0.6), colour, roughness, slope=(0.15, 0.8))


def leaves(c):
    size = c.size
    ground = c.noise(5, None, 0.9)
    height = 0.1 * ground
    colour = c.ramp(0.5 + 0.25 * ground, c.colours("soil", 3))
    roughness = np.full_like(height, c.uniform(0.75, 0.95))
    count, length = c.integer(40, 80), c.uniform(0.12, 0.26)
    palette = c.colours("leaf", 5)
    base, gloss = c.uniform(0.45, 0.8), c.uniform(0, 0.1)
    half = int(length * 0.62 * size) + 2
    axis = np.arange(-half, half + 1, dtype=np.float32) / size
    x, y = np.meshgrid(axis, axis)
    patch = c.noise(6, None, 0.8)
    for k in range(count):
        angle, long = c.uniform(0, 2 * np.pi), length * c.uniform(0.6, 1.1)
        s = (x * np.cos(angle) + y * np.sin(angle)) / long + 0.5
        t = (y * np.cos(angle) - x * np.sin(angle)) / long
        wide = c.uniform(0.15, 0.32) * np.sqrt(np.clip(4 * s * (1 - s), 0, 1)) * (1.2 - 0.5 * s)
        r = np.abs(t) / np.maximum(wide, 1e-4)
        inside = (r < 1) & (s > 0) & (s < 1)
        if not inside.any():
            continue
        cy, cx = c.integer(0, size - 1), c.integer(0, size - 1)
        at = np.ix_((np.arange(-half, half + 1) + cy) % size, (np.arange(-half, half + 1) + cx) % size)
        veins = np.exp(-((t / 0.012) ** 2)) + 0.5 * np.exp(-(((s * 9 - np.abs(t) * 14) % 1 - 0.5) ** 2) / 0.01)
        rise = 0.25 * np.cos(3 * s + angle) + 0.5 * c.uniform(-1, 1) * r**2 + 0.05 * veins
        leaf = 0.5 + 1.2 * k / count + rise * 0.4
        tone = (
            palette[k % 5]
            * (1 + 0.25 * (c.random.random() - 0.5))
            * (1 - 0.15 * np.clip(veins, 0, 1) + 0.06 * patch[at])[..., None]
        )
        height[at] = np.where(inside, leaf, height[at])
        colour[at] = np.where(inside[..., None], tone, colour[at])
        roughness[at] = np.where(inside, base + gloss * (k % 3 - 1), roughness[at])
    return Surface(c.blur(height.astype(np.float32), 0.6), colour, roughness, slope=(0.1, 0.6))


# ---------------------------------------------------------------- families: loose and cast


def gravel(c):
    height = np.full((c.size, c.size), -1.0, np.float32)
    colour = np.zeros((c.size, c.size, 3), np.float32)
    n = c.integer(7, 22)
    colours = c.colours(c.choice(["stone", "rock", "sand"]), 5)
    for scale in (2.0, 1.3, 1.0):
        m = round(n * scale)
        cells = c.voronoi(m, None, 0.95, at=c.warp(0.08 / m, m, 3 * m))
        r = smooth(cells.edge, 0.0, c.uniform(0.2, 0.35) / m)
        dome = (
            r * (1 + 0.4 * c.per_cell(cells)) / scale + 0.4 / m * c.per_cell(cells) * m * m * (cells.x + cells.y) * 0.3
        )
        kept = (c.random.random(cells.count) < (1.0 if scale == 2.0 else 0.6))[cells.id] & (r > 0.05)
        above = kept & (dome > height)
        tone = (
            c.ramp((c.random.random(cells.count).astype(np.float32))[cells.id], colours)
            * (1 + c.per_cell(cells, 0.1))[..., None]
        )
        height, colour = np.where(above, dome, height), np.where(above[..., None], tone, colour)
    grit = c.noise(20, None, 0.5)
    gap = height < -0.5
    ground = c.colours(c.choice(["soil", "sand", "dirt"]), 2)
    colour = np.where(
        gap[..., None], c.ramp(0.5 + 0.3 * grit, ground), colour * (1 + c.uniform(0, 0.12) * grit)[..., None]
    )
    height = np.where(gap, -0.1, height) + c.uniform(0.01, 0.08) * grit
    return Surface(
        c.blur(height, 0.7), colour, np.where(gap, 0.9, c.uniform(0.5, 0.85) + 0.03 * grit), slope=(0.15, 0.8)
    )


def asphalt(c):
    n = c.integer(24, 50)
    cells = c.voronoi(n, None, 1.0)
    stone = (c.random.random(cells.count) < c.uniform(0.3, 0.9))[cells.id] * smooth(cells.edge, 0.1 / n, 0.3 / n)
    grit = c.noise(30, None, 0.2)
    height = stone * (0.6 + c.per_cell(cells, 0.2)) + 0.25 * grit
    binder, chips = c.colours("asphalt", 2), c.colours(c.choice(["asphalt", "stone"]), 4)
    show = stone * c.uniform(0, 0.9)
    colour = mix(
        c.ramp(0.5 + 0.15 * grit, binder),
        c.ramp(c.random.random(cells.count).astype(np.float32)[cells.id], chips),
        show,
    )
    if c.chance(0.3):
        height, colour = cracks(c, height, colour)
    if c.chance(0.25):  # a road marking
        wide = c.uniform(0.1, 0.3)
        line = smooth(np.abs(c.u % 1 - 0.5), wide + 0.01, wide) * smooth(
            c.noise(6, None, 0.6) + 0.8 * stone, -1.8, -0.6
        )
        colour = mix(colour, c.choice([np.array([0.82, 0.82, 0.8]), np.array([0.8, 0.62, 0.15])]), line * 0.9)
    return Surface(height, colour, c.uniform(0.5, 0.95) + 0.04 * grit - c.uniform(0, 0.2) * show, slope=(0.03, 0.6))


def concrete(c):
    broad, fine = c.noise(1.5, 10, 1.2), c.noise(20, None, 0.4)
    pores = smooth(c.noise(c.uniform(20, 50), None, 0.6), c.uniform(1.6, 2.4), 2.8)
    height = c.uniform(0, 0.4) * broad + c.uniform(0.02, 0.3) * fine - c.uniform(0, 2) * pores
    t = 0.5 + c.uniform(0.05, 0.3) * broad + c.uniform(0, 0.1) * fine + c.uniform(0, 0.15) * c.noise(4, None, 0.8)
    colour = c.ramp(t, c.colours("concrete", 3)) * (1 - c.uniform(0, 0.5) * pores)[..., None]
    roughness = c.uniform(0.45, 0.95) + c.uniform(-0.08, 0.08) * broad + c.uniform(0, 0.03) * fine
    if c.chance(0.3):  # boards of the formwork, or cast plates
        cells = c.courses(c.choice([1, 2]), c.choice([1, 2, 4, 6]), "running" if c.chance(0.5) else "stack")
        joint = c.uniform(0.003, 0.012)
        line = smooth(cells.edge, joint, 0)
        height = height - c.uniform(0.5, 4) * line + c.per_cell(cells, 0.3)
        colour = colour * (1 + c.per_cell(cells, 0.05) - c.uniform(0, 0.4) * line)[..., None]
    if c.chance(0.3):
        height, colour = cracks(c, height, colour)
    return Surface(height, colour, roughness, slope=(0.01, 0.25), dirt=("dirt", "moss", "rust"))


def plaster(c):
    kind = c.choice(["trowel", "spray", "smooth", "combed"])
    fine = c.noise(25, None, 0.4)
    if kind == "trowel":
        u, v = c.warp(0.04, 2, 6)
        strokes = c.look_up(c.noise(4, None, 1.0, "u", 4), u, v)
        relief = np.maximum(strokes, np.roll(c.noise(4, None, 1.0, "v", 4), 9, 0)) + 0.1 * fine
    elif kind == "spray":
        relief = smooth(c.noise(c.uniform(12, 40), None, 0.7), -0.5, 1.5) * 2 + 0.15 * fine
    elif kind == "combed":
        u, v = c.warp(0.02, 2, 8)
        relief = np.sin(2 * np.pi * (c.integer(8, 40) * v + 0.0 * u)) * smooth(c.noise(3, 10, 1), -1.5, 0) + 0.3 * fine
    else:
        relief = c.uniform(0.2, 1) * c.noise(1.5, 10, 1.5) + 0.3 * fine
    colours = c.colours(c.choice(["plaster", "plaster", "paint", "concrete"]), 3)
    t = 0.5 + c.uniform(0, 0.25) * c.noise(1.5, 12, 1.2) + c.uniform(0, 0.08) * relief
    height, colour = relief, c.ramp(t, colours)
    roughness = c.uniform(0.5, 0.95) + c.uniform(-0.03, 0.03) * relief
    if c.chance(0.35):  # flaked off, the wall below shows
        gone = smooth(c.noise(2, None, 1.2), c.uniform(0.6, 1.4), c.uniform(0.6, 1.4) + 0.15)
        below = c.ramp(0.5 + 0.2 * c.noise(5, None, 0.8), c.colours(c.choice(["brick", "concrete", "grout"]), 3))
        height = mix(height, c.noise(6, None, 0.8) * 0.5 - c.uniform(1, 4), gone)
        colour, roughness = mix(colour, below, gone), mix(roughness, c.uniform(0.7, 0.95), gone)
    return Surface(height, colour, roughness, slope=(0.01, 0.35), dirt=("dirt", "moss", "rust"))


def rock(c):
    u, v = c.warp(c.uniform(0.01, 0.06), 2, 6)
    ridged = 1 - np.abs(c.noise(2, None, 1.1))
    strata = np.zeros_like(ridged)
    if c.chance(0.5):
        k = c.integer(3, 14)
        strata = c.uniform(0.3, 1.5) * np.interp(
            (v * k) % 1, np.linspace(0, 1, 9), np.r_[s := c.random.random(8), s[0]]
        ).astype(np.float32)
    facets = np.zeros_like(ridged)
    if c.chance(0.6):
        cells = c.voronoi(c.integer(3, 9), None, 1.0, at=(u, v))
        facets = c.per_cell(cells, 0.5) + (c.per_cell(cells, 4.0) * cells.x + c.per_cell(cells, 4.0) * cells.y)
        facets = facets * smooth(cells.edge, 0.0, 0.02)
    fine = c.noise(8, None, 0.9)
    height = ridged + strata + facets + c.uniform(0.05, 0.4) * fine
    t = 0.5 + c.uniform(0, 0.25) * strata + c.uniform(0, 0.15) * fine + c.uniform(0, 0.25) * c.noise(2, 20, 1.1)
    colour = c.ramp(t, c.colours(c.choice(["rock", "rock", "stone", "slate"]), 4))
    if c.chance(0.3):
        lichen = smooth(c.noise(5, None, 0.9), 0.9, 1.3)
        colour = mix(colour, c.colours(c.choice(["moss", "paper", "sand"]), 1)[0], 0.7 * lichen)
    return Surface(
        height,
        colour,
        c.uniform(0.5, 0.9) + c.uniform(-0.1, 0.1) * fine,
        slope=(0.15, 1.0),
        dirt=("dirt", "moss", "sand"),
    )


def sand(c):
    ripples = c.integer(0, 12)
    wave = c.noise(1.5, 6, 1.6)
    phase = ripples * (c.v if c.chance(0.5) else c.u) + c.uniform(0.2, 1.2) * wave
    crest = (
        np.abs(((phase + 0.15 * np.sin(2 * np.pi * phase)) % 1) * 2 - 1) ** c.uniform(1, 2) if ripples else wave * 0.3
    )
    grains = c.noise(50, None, 0.0)
    height = crest + c.uniform(0.02, 0.2) * grains + c.uniform(0, 0.4) * wave
    t = (
        0.5
        + c.uniform(-0.2, 0.3) * (crest - 0.5)
        + c.uniform(0.03, 0.2) * grains
        + c.uniform(0, 0.2) * c.noise(2, 12, 1.2)
    )
    kind = c.choice(["sand", "sand", "soil", "paper"])
    return Surface(height, c.ramp(t, c.colours(kind, 4)), c.uniform(0.6, 0.95) + 0.02 * grains, slope=(0.03, 0.35))


def soil(c):
    clods, fine = c.noise(4, None, 0.9), c.noise(20, None, 0.4)
    height = np.maximum(clods, c.noise(6, None, 0.8)) + 0.15 * fine
    t = 0.5 + c.uniform(0, 0.3) * clods + c.uniform(0, 0.15) * fine
    colour = c.ramp(t, c.colours("soil", 4))
    if c.chance(0.4):  # dried, in plates
        cells = c.voronoi(c.integer(4, 12), None, 0.95, at=c.warp(0.008, 6, 30))
        gap = smooth(cells.edge, c.uniform(0.003, 0.008), 0.0)
        height = 0.3 * height + 1.5 * smooth(cells.edge, 0, 0.03) * (1 + c.per_cell(cells, 0.15)) - gap
        colour = colour * (1 - c.uniform(0.3, 0.7) * gap)[..., None]
    surface = Surface(height, colour, c.uniform(0.7, 0.97) + 0.02 * fine, slope=(0.08, 0.6))
    if c.chance(0.5):  # pebbles on it
        cells = c.voronoi(c.integer(8, 24), None, 1.0)
        n = np.sqrt(cells.count)
        stone = (c.random.random(cells.count) < 0.35)[cells.id] * smooth(cells.edge, 0.12 / n, 0.3 / n)
        surface.height = mix(surface.height, 2.0 + c.per_cell(cells, 0.4) + 0.05 * fine, stone)
        surface.colour = mix(surface.colour, c.ramp(0.5 + c.per_cell(cells, 0.3), c.colours("stone", 4)), stone > 0.2)
        surface.roughness = mix(surface.roughness, c.uniform(0.4, 0.8), stone)
    return surface


def snow(c):
    broad, fine = c.noise(2, 16, 1.4), c.noise(16, None, 0.6)
    white = np.array([0.88, 0.91, 0.95], np.float32) * c.uniform(0.85, 1.05)
    colour = white * (1 + c.uniform(0, 0.04) * fine + c.uniform(0, 0.04) * broad)[..., None]
    return Surface(broad + 0.2 * fine, colour, c.uniform(0.4, 0.75) + 0.03 * fine, slope=(0.03, 0.3), dirt=("soil",))


# ---------------------------------------------------------------- families: metal, paint, polished


def brushed_metal(c):
    fine = c.noise(c.uniform(20, 60), None, 0.1, "u", c.uniform(20, 60))
    broad = c.noise(1.5, 10, 1.2)
    colour = (
        c.colours(c.choice(["steel", "alloy"]), 1)[0]
        * (1 + c.uniform(0, 0.05) * fine + c.uniform(0, 0.05) * broad)[..., None]
    )
    roughness = c.uniform(0.12, 0.5) + c.uniform(0, 0.06) * fine + c.uniform(0, 0.08) * broad
    return _turned(c, Surface(fine + 0.5 * broad, colour, roughness, 1.0, slope=(0.003, 0.05)))


def metal_plate(c):
    cells = c.courses(
        c.choice([1, 2, 3]), c.choice([1, 2, 4]), c.choice(["stack", "running"]) if c.chance(0.7) else "stack"
    )
    seam = smooth(cells.edge, 0.002, c.uniform(0.006, 0.015))
    height = seam * (1 + c.per_cell(cells, 0.1)) + 0.02 * c.noise(2, 12, 1.5)
    kind = c.choice(["rivets", "diamonds", "corrugated", "plain"])
    if kind == "rivets":
        n = c.choice([8, 12, 16])
        x, y = (c.u * n) % 1 - 0.5, (c.v * n) % 1 - 0.5
        height = height + 0.7 * smooth(np.sqrt(x**2 + y**2), 0.22, 0.12) * (cells.edge < 1.0 / n)
    elif kind == "diamonds":
        n = c.choice([6, 8, 10, 12])
        i, j = np.floor(c.u * n), np.floor(c.v * n)
        x, y = c.u * n - i - 0.5, c.v * n - j - 0.5
        turn = np.where((i + j) % 2 == 0, 1.0, -1.0)
        a, b = (x + turn * y) * 0.7, (x - turn * y) * 0.7
        height = 0.2 * height + smooth(np.sqrt((a / 0.42) ** 2 + (b / 0.13) ** 2), 1.0, 0.4)
    elif kind == "corrugated":
        height = 0.1 * height + 1.5 * np.sin(2 * np.pi * c.u * c.integer(4, 16))
    broad, fine = c.noise(2, 20, 1.1), c.noise(20, None, 0.5)
    metallic = 1.0
    colour = c.colours("steel", 1)[0] * (1 + 0.05 * broad + 0.02 * fine)[..., None]
    roughness = c.uniform(0.2, 0.6) + c.uniform(0, 0.08) * broad + 0.02 * fine
    if c.chance(0.6):  # painted
        metallic, roughness = 0.0, roughness + 0.1
        colour = c.ramp(0.5 + 0.1 * broad, c.colours("paint", 2))
    height = (height + 0.01 * fine).astype(np.float32)
    return Surface(c.blur(height, 0.6), colour, roughness, metallic, (0.02, 0.4), ("dirt", "rust"))


def painted_metal(c):
    broad, fine = c.noise(2, 12, 1.2), c.noise(16, None, 0.7)
    flake = c.noise(c.uniform(1.5, 6), None, 1.1)
    gone = smooth(flake, t := c.uniform(0.2, 1.6), t + 0.08)
    edge = smooth(np.abs(flake - t), 0.35, 0.0) * (1 - gone)
    paint = c.ramp(0.5 + c.uniform(0, 0.2) * broad, c.colours("paint", 2))
    rusted = c.chance(0.7)
    below = c.ramp(0.5 + 0.25 * fine, c.colours("rust" if rusted else "steel", 3))
    colour = mix(mix(paint, c.colours("rust", 1)[0], edge * c.uniform(0, 0.7) * rusted), below, gone)
    roughness = mix(
        c.uniform(0.2, 0.6) + 0.03 * broad,
        (c.uniform(0.65, 0.95) if rusted else c.uniform(0.2, 0.5)) + 0.06 * fine,
        gone,
    )
    height = (1 - gone) * c.uniform(0.4, 2) + c.uniform(0, 0.5) * edge + c.uniform(0.05, 0.3) * fine * (0.2 + gone)
    return Surface(
        c.blur(height, 0.6), colour, roughness, gone * (0.15 if rusted else 1.0), (0.01, 0.25), ("rust", "dirt")
    )


def rust(c):
    broad, mid, fine = c.noise(2, 12, 1.2), c.noise(6, None, 0.9), c.noise(20, None, 0.4)
    bare = smooth(broad + 0.5 * mid, t := c.uniform(-0.2, 2.5), t + 0.5)
    t = 0.5 + c.uniform(0.1, 0.3) * mid + c.uniform(0.05, 0.2) * fine + 0.1 * broad
    colour = mix(c.ramp(t, c.colours("rust", 5)), c.colours("steel", 1)[0] * 0.8, bare)
    height = (mid + c.uniform(0.1, 0.6) * fine) * (1 - bare) - 0.3 * bare
    roughness = mix(c.uniform(0.65, 0.95) + 0.05 * mid, c.uniform(0.25, 0.55) + 0.05 * fine, bare)
    return Surface(height, colour, roughness, bare, (0.01, 0.35))


def polished(c):
    """Marble, onyx, lacquer, plastic: the picture lies in the material, the surface is flat or nearly so."""
    u, v = c.warp(c.uniform(0.02, 0.1), 1.5, 8)
    veins = smooth(np.abs(c.look_up(c.noise(1.5, None, 1.1), u, v)), c.uniform(0.02, 0.25), 0)
    broad = c.noise(1.5, None, 1.2)
    colours = c.colours(c.choice(["stone", "paper", "rock", "paint", "leather"]), 3)
    colour = c.ramp(0.5 + c.uniform(0, 0.3) * broad, colours)
    colour = mix(colour, c.colours(c.choice(["paper", "rock", "stone"]), 1)[0], c.uniform(0, 0.9) * veins)
    if c.chance(0.25):  # terrazzo
        cells = c.voronoi(c.integer(8, 30), None, 1.0)
        chip = (c.random.random(cells.count) < 0.6)[cells.id] & (cells.edge > 0.1 / np.sqrt(cells.count))
        colour = np.where(chip[..., None], c.ramp(0.5 + c.per_cell(cells, 0.4), c.colours("stone", 5)), colour)
    height = c.uniform(0, 1) * c.noise(1.5, 6, 1.8) + c.uniform(0, 0.2) * c.noise(20, None, 0.4)
    roughness = c.log_uniform(0.05, 0.45) + c.uniform(-0.08, 0.12) * veins + c.uniform(0, 0.03) * broad
    return Surface(height, colour, roughness, slope=(0.002, 0.05))


def paper(c):
    fibre = c.noise(12, None, 0.5)
    crumple = np.zeros_like(fibre)
    if c.chance(0.4):
        cells = c.voronoi(c.integer(3, 8), None, 1.0, at=c.warp(0.01, 3, 12))
        crumple = c.per_cell(cells, 3.0) * cells.x + c.per_cell(cells, 3.0) * cells.y + 0.3 * cells.edge
    colour = c.ramp(0.5 + c.uniform(0, 0.2) * fibre, c.colours(c.choice(["paper", "paper", "paint"]), 2))
    return Surface(
        c.uniform(0.1, 1) * fibre * 0.1 + crumple, colour, c.uniform(0.5, 0.9) + 0.02 * fibre, slope=(0.005, 0.15)
    )


def wallpaper(c):
    """A print: all change of colour, no relief."""
    base = c.ramp(
        0.5 + c.uniform(0, 0.1) * c.noise(4, None, 0.8), c.colours(c.choice(["paint", "plaster", "paper"]), 2)
    )
    n = c.choice([2, 3, 4, 6])
    colour = printed(c, base, c.courses(n, n, "stack"))
    return Surface(
        c.noise(10, None, 0.6), colour, c.uniform(0.2, 0.85) + 0.02 * c.noise(4, None, 0.8), slope=(0.003, 0.05)
    )


def scales(c):
    """Embossed: relief of one colour (foam, studs, quilting, hammered sheet, ribbed rubber)."""
    n = c.integer(4, 24)
    kind = c.choice(["quilt", "studs", "hammered", "ribs", "foam"])
    if kind in ("quilt", "ribs"):
        a = np.sin(np.pi * n * (c.u + c.v)) if kind == "quilt" else np.sin(2 * np.pi * n * c.u)
        height = (
            np.abs(a * np.sin(np.pi * n * (c.u - c.v))) ** 0.5 if kind == "quilt" else np.abs(a) ** c.uniform(0.4, 2)
        )
        if n % 2 and kind == "quilt":  # an odd half period would not wrap
            height = np.abs(np.sin(np.pi * n * c.u) * np.sin(np.pi * n * c.v)) ** 0.5
    else:
        cells = c.voronoi(n, None, 0.0 if kind == "studs" else 0.9, kind == "studs" and n % 2 == 0)
        r = np.sqrt(cells.x**2 + cells.y**2) * n
        height = {
            "studs": smooth(r, 0.4, 0.25),
            "hammered": r**2,
            "foam": -smooth(r, 0.45, 0.2) * (1 + c.per_cell(cells, 0.3)),
        }[kind]
    colour = np.broadcast_to(
        c.colours(c.choice(["paint", "paint", "asphalt", "steel", "leather"]), 1)[0], (c.size, c.size, 3)
    )
    metallic = 1.0 if kind == "hammered" and c.chance(0.6) else 0.0
    fine = c.noise(20, None, 0.5)
    return Surface(
        (height + 0.01 * fine).astype(np.float32),
        colour.copy(),
        c.uniform(0.2, 0.9) + 0.02 * fine,
        metallic,
        (0.03, 0.6),
    )


def _turned(c, surface):
    """By 90 degrees, every second time."""
    if c.chance(0.5):
        for name in ("height", "colour", "roughness", "metallic"):
            value = getattr(surface, name)
            if np.ndim(value) > 1:
                setattr(surface, name, np.swapaxes(value, 0, 1))
    return surface


# ---------------------------------------------------------------- age


def printed(c, colour, cells):
    """Ornaments of another colour in each cell; no relief."""
    n = np.sqrt(cells.count)
    x, y = cells.x * n, cells.y * n
    r, a = np.sqrt(x**2 + y**2), np.arctan2(y, x)
    k = c.integer(2, 8)
    field_ = c.choice(
        [
            lambda: np.cos(k * a) * 0.2 + c.uniform(0.2, 0.4) - r,
            lambda: np.sin(2 * np.pi * k * x) * np.sin(2 * np.pi * k * y),
            lambda: np.sin(2 * np.pi * k * (x + y)),
            lambda: np.cos(2 * np.pi * k * r + c.integer(1, 6) * a),
            lambda: np.abs(x) + np.abs(y) - c.uniform(0.2, 0.6) + 0.1 * np.cos(4 * a),
        ]
    )()
    ink = smooth(field_, -0.03, 0.03) * c.uniform(0.4, 1)
    return mix(colour, c.colours(c.choice(["paint", "paper", "leather"]), 1)[0], ink)


def cracks(c, height, colour):
    cells = c.voronoi(c.integer(2, 5), None, 1.0, at=c.warp(0.02, 3, 40))
    line = smooth(cells.edge, c.uniform(0.002, 0.006), 0.0) * smooth(c.noise(2, 8, 1.0), -0.6, 0.4)
    return height - c.uniform(1, 5) * line, colour * (1 - c.uniform(0.2, 0.8) * line)[..., None]


def _age(c, s):
    """Dirt, wear, stains, leaks, puddles, scratches: each in some materials, with and without its trace in the maps."""
    deviation = max(float(s.height.std()), 1e-6)
    relief = (s.height - s.height.mean()) / deviation
    cavity = c.blur(relief.astype(np.float32), c.uniform(0.01, 0.06) * c.size) - relief
    if c.chance(0.4):
        dirt = c.colours(c.choice(list(s.dirt)), 1)[0]
        amount = smooth(cavity + 0.4 * c.noise(3, None, 0.9), 0.0, c.uniform(0.6, 2)) * c.uniform(0.2, 0.9)
        s.colour, s.roughness = mix(s.colour, dirt, amount), mix(s.roughness, c.uniform(0.7, 0.95), amount)
        s.metallic = s.metallic * (1 - amount)
    if c.chance(0.25):
        worn = smooth(-cavity + 0.3 * c.noise(4, None, 0.9), 0.6, 1.6) * c.uniform(0.1, 0.7)
        s.colour = s.colour * (1 + c.uniform(-0.2, 0.5) * worn)[..., None]
        s.roughness = s.roughness + c.uniform(-0.35, 0.15) * worn
    if c.chance(0.35):  # stains: no height
        t = c.uniform(0.0, 1.3)
        stain = smooth(c.noise(c.uniform(1.5, 5), None, 1.2), t, t + c.choice([0.1, 0.5, 1.5])) * c.uniform(0.1, 0.7)
        s.colour = mix(
            s.colour,
            s.colour * c.colours(c.choice(["dirt", "rust", "paper", "paint"]), 1)[0] * c.uniform(0.7, 1.6),
            stain,
        )
        if c.chance(0.5):
            s.roughness = s.roughness + c.uniform(-0.35, 0.3) * stain
    if c.chance(0.15):  # leaks run down from where they start
        seeds = smooth(c.noise(12, 60, 0.4), 1.8, 2.4)
        decay = np.exp(-np.arange(c.size) / (c.uniform(0.1, 0.5) * c.size)).astype(np.float32)[:, None]
        run = np.fft.irfft(np.fft.rfft(seeds, axis=0) * np.fft.rfft(decay, axis=0), c.size, 0).astype(np.float32)
        leak = np.clip(run * c.uniform(0.1, 0.4), 0, 1) * c.uniform(0.3, 0.9)
        s.colour = mix(s.colour, c.colours(c.choice(["dirt", "rust", "paper"]), 1)[0], leak)
        s.roughness = s.roughness + c.uniform(-0.3, 0.2) * leak
    if c.chance(0.07):  # wet: fills what is low, smooth, darkens the rest
        level = np.quantile(relief, c.uniform(0.1, 0.5))
        pool = smooth(relief + 0.2 * c.noise(2, 8, 1.5), level + 0.15, level)
        s.height = mix(s.height, s.height.mean() + level * deviation, pool)
        s.colour = s.colour * (1 - c.uniform(0.2, 0.5) * smooth(c.blur(pool.astype(np.float32), 3), 0, 0.5))[..., None]
        s.roughness = mix(s.roughness, c.uniform(0.05, 0.15), pool)
    if c.chance(0.12):
        _, line, value = c.strokes(c.integer(10, 60), c.uniform(0.1, 0.6), 1 / c.size, spread=0.8, bend=0.2)
        line = (line > 0) * value
        s.height = s.height - deviation * c.uniform(0, 0.5) * line
        s.colour = s.colour * (1 + c.uniform(-0.3, 0.5) * line)[..., None]
        s.roughness = s.roughness + c.uniform(-0.3, 0.2) * line
    if c.chance(0.04):
        n = c.choice([1, 2, 3])
        s.colour = printed(c, s.colour, c.courses(n, n, "stack"))


# fmt: off
FAMILIES = {
    f.__name__: f
    for f in (
        bricks, tiles, paving, cobbles, rubble, roof_tiles, planks, wood, bark, weave, knit, leather, grass, leaves,
        gravel, asphalt, concrete, plaster, rock, sand, soil, snow, brushed_metal, metal_plate, painted_metal, rust,
        polished, paper, wallpaper, scales,
    )
}
# fmt: on
# how often, where not once: closer to what a photographed palette holds
OFTEN = {
    **dict.fromkeys(("rock", "plaster", "concrete", "bricks"), 2.0),
    **dict.fromkeys(("soil", "planks", "gravel"), 1.5),
    **dict.fromkeys(("scales", "knit", "wallpaper", "brushed_metal", "metal_plate", "snow"), 0.6),
}


def material(seed: int, size: int = 256, family: str | None = None) -> SVBRDF:
    """The material of a seed, every map an array of (size, size), float32; height in tile widths; it tiles.

    family is one of FAMILIES; None draws it.
    """
    c = Canvas(seed, size)
    names = list(FAMILIES)
    weights = np.array([OFTEN.get(name, 1.0) for name in names])
    drawn = names[int(c.random.choice(len(names), p=weights / weights.sum()))]
    s = FAMILIES[family or drawn](c)
    full = np.ones((size, size), np.float32)
    s.height, s.roughness, s.metallic = (np.asarray(x, np.float32) * full for x in (s.height, s.roughness, s.metallic))
    # fine relief that no family lacks, and change of colour without any relief
    s.height = s.height + s.height.std() * c.log_uniform(0.002, 0.04) * c.noise(size / 6, None, 0.3)
    _age(c, s)
    if c.chance(0.7):
        grain = c.noise(c.log_uniform(1.5, size / 6), None, c.uniform(0.1, 1.1))
        s.colour = s.colour * np.exp(c.log_uniform(0.01, 0.15) * grain)[..., None]
    if c.chance(0.3):  # greyer
        s.colour = mix(s.colour, s.colour.mean(-1, keepdims=True), np.full((size, size), c.uniform(0.3, 1.0)))

    # what must not be taken for granted
    if c.chance(0.1):
        s.colour = np.broadcast_to(s.colour.mean((0, 1)), s.colour.shape)
    elif c.chance(0.5):
        mean = s.colour.mean((0, 1))
        s.colour = mean + (s.colour - mean) * c.uniform(0.2, 0.9)
    albedo = np.clip(linear_from_srgb(np.clip(s.colour, 0.02, 0.985).astype(np.float32)), 0, 1)
    low, high = s.slope
    slope = c.log_uniform(low, high)
    if c.chance(0.1):
        slope = slope * c.uniform(0, 0.2)
    height = _sloped(c, s.height, slope)
    roughness = s.roughness
    if c.chance(0.3):  # as many artists make it: from the picture
        luminance = np.log(albedo.mean(-1) + 0.02)
        follow = (luminance - luminance.mean()) * c.uniform(-0.25, 0.25)
        roughness = roughness.mean() + follow + c.uniform(0, 1) * (roughness - roughness.mean())
    elif c.chance(0.15):
        roughness = np.full_like(roughness, roughness.mean())
    roughness = np.clip(roughness, 0.03, 1.0).astype(np.float32)
    normal = normal_from_height(torch.from_numpy(height)).numpy()
    return SVBRDF(albedo, normal, roughness, height, np.clip(s.metallic, 0, 1).astype(np.float32))


def _sloped(c, height, slope):
    """The height in tile widths, mean 0, whose rms slope at this resolution is as given; none steeper than 4."""
    for _ in range(2):
        dx, dy = (np.roll(height, -1, k) - np.roll(height, 1, k) for k in (1, 0))
        steepness = np.sqrt(dx * dx + dy * dy) * (c.size / 2)
        height = height * (slope / max(float(np.sqrt(np.mean(steepness**2))), 1e-9))
        limit = 4.0 / max(
            float(np.quantile(steepness[::4, ::4], 0.999)) * slope / max(float(steepness.std()), 1e-9), 1e-9
        )
        if limit >= 1:
            break
        height = c.blur(height.astype(np.float32), 0.8)
    return (height - height.mean()).astype(np.float32)


def main() -> None:
    from material_palette.core import brdf

    torch.set_num_threads(1)
    first, size, columns = int(sys.argv[2]) if len(sys.argv) > 2 else 0, 256, 8
    light = torch.nn.functional.normalize(torch.tensor([-0.45, 0.45, 0.75]), dim=0)
    up = torch.tensor([0.0, 0.0, 1.0])
    pictures = []
    for seed in range(first, first + 48):
        m = material(seed, size)
        maps = [torch.from_numpy(x) for x in (m.albedo, m.normal, m.roughness)]
        pixels = 0.9 * brdf.shade(*maps, light.expand_as(maps[1]), up.expand_as(maps[1]), torch.from_numpy(m.metallic))
        pixels = (pixels + 0.25 * maps[0]).clamp(0, 1).numpy()
        pictures.append(np.where(pixels <= 0.0031308, pixels * 12.92, 1.055 * pixels ** (1 / 2.4) - 0.055))
    rows = [np.concatenate(pictures[i : i + columns], 1) for i in range(0, 48, columns)]
    cv2.imwrite(sys.argv[1], (np.concatenate(rows)[..., ::-1] * 255).round().astype(np.uint8))


if __name__ == "__main__":
    main()
