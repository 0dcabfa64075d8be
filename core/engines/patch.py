"""Engine `patch`: toroidal texture synthesis from a region of any shape, without training.

Claim: a map of source coordinates, quilted from large blocks at a coarse scale and refined towards the fine one, makes
a sharp, seamless tile that keeps the structure of the region and uses all of it. Every pixel p of the texture holds the
coordinate c(p) of an exemplar pixel. Per level, from coarse to fine, a few rounds of

    S(p)  = weighted mean over offsets d of E(c(p + d) - d)                        (vote)
    S    <- S moved so that F_S is distributed as F_E                              (match)
    c(p) <- argmin over candidates q of |F_S(p) - F_E(q)|^2 + lambda o(q)          (search)

F are the principal components of the patch around a pixel, o says how often a source is already used. Candidates are
the continuations of the neighbours' sources (coherence) and random jumps of falling reach. The texture is E(c), its
patches matched once more, at three scales. All indices wrap, so it tiles by construction; c carries any channel of the
exemplar along. Of several samples down to half the resolution the one that looks most like the exemplar is finished.
A region too thin for blocks begins from scattered patches. Where the exemplar repeats with a period, the tile is a
whole number of periods and a source that is out of phase costs more: courses stay straight and close.

Sources: Efros and Freeman 2001 (quilting), Kwatra et al. 2005 (texture optimisation), Lefebvre and Hoppe 2005
(coordinates, coherence, PCA), Barnes et al. 2009 (PatchMatch), Kaspar et al. 2015 (occurrence, guidance by periods),
Pitie et al. 2005 (distributions matched by rotations), Elnekave and Weiss 2022 (patch distributions over scales).
"""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from ..errors import PaletteError
from ..perceptual import Crops
from .lattice import find_periods

Progress = Callable[[float, str], None]

LEARNING_SHARE = 0.05

PATCH = 7
RADIUS = PATCH // 2
COMPONENTS = 24
COARSEST = 48  # px: side of the square with the region's area at the coarsest level, large enough for blocks
ANCHORS = 768  # positions tried for a quilting block
BLOCK = 0.45  # side of a quilting block, in sides of that square
BALANCE = 0.5  # weight of a block's use over the mean use, in variances of the exemplar
MOST_STRETCH = 0.1  # of the exemplar, to fit a whole number of its periods into the tile
IN_PHASE = 4.0  # weight of a block's misfit with the lattice, in variances
OUT_OF_PHASE = 1.0  # the same for a source, in median patch distances
SHORTEST_PERIOD = 3.0  # px; below it a level is too coarse to see the phase
OCCURRENCE = 3.0  # lambda, in median patch distances
COHERENCE = 0.6  # a random source must cost less than this share of one that continues a neighbour
REACHES = (64, 8, 1)  # px of the random jumps
UNKNOWN = -1.0  # a cost that nobody has asked for yet
BAND = 1 << 16  # pixels at most searched at a time by a thread
BANDS = 4  # at least, so that small levels keep more than one thread busy
RANKED = 1 << 16  # patches at most that decide a distribution
QUANTILES = 1024
MATCHED = 3  # scales at which the finished texture's patches are matched
CHOSEN = 1  # level at which one of several samples is kept


@dataclass(frozen=True)
class Preset:
    """rounds per coarse level and at the finest; samples to choose from; times the finished texture is matched."""

    coarse: int
    finest: int
    samples: int
    matches: int


PRESETS = {"draft": Preset(2, 1, 1, 1), "balanced": Preset(4, 1, 1, 2), "best": Preset(6, 2, 3, 4)}


@dataclass
class Level:
    """The exemplar at one scale, flattened: h * w pixels."""

    pixels: torch.Tensor  # (h * w, 3); outside the region its mean colour
    inside: torch.Tensor  # (h * w) bool, the region
    valid: torch.Tensor  # (h * w) bool, the sources: pixels whose patch lies in the region
    basis: torch.Tensor  # (D, 3, PATCH, PATCH)
    features: torch.Tensor  # (h * w, D), the patch around each pixel projected on the basis
    ranked: torch.Tensor  # (D, n), the features of at most RANKED sources, for `_match`
    shape: tuple[int, int]


@dataclass
class Concept:
    """What is learnt of a region: its patches over scales, the finest level first."""

    pixels: np.ndarray  # (h, w, 3), the exemplar
    mask: np.ndarray
    periods: tuple[float | None, float | None]  # px, downwards and to the right
    levels: list[Level]


@dataclass
class Texture:
    """pixels (H, W, 3) float32 in the exemplar's units; coordinates (H, W, 2) int64, row and column in the exemplar."""

    pixels: np.ndarray
    coordinates: np.ndarray


def learn(pixels: np.ndarray, mask: np.ndarray, progress: Progress) -> Concept:
    """The patches of an exemplar at every scale.

    pixels (h, w, 3) float32, perceptually encoded, 0 to 1; mask (h, w) bool, the region.
    Raises PaletteError when too few patches of PATCH x PATCH px lie in the region.
    """
    # as a saved concept holds them, so that it gives the same texture
    pixels = pixels.astype(np.float16).astype(np.float32)
    return Concept(pixels, mask, find_periods(pixels, mask), _levels(pixels, mask, progress))


def to_tensors(concept: Concept) -> tuple[dict[str, np.ndarray], dict]:
    """What `from_tensors` needs to give the same concept again: arrays, and facts that JSON can hold."""
    return {"pixels": concept.pixels.astype(np.float16), "mask": concept.mask}, {"periods": list(concept.periods)}


def from_tensors(tensors: dict[str, np.ndarray], facts: dict, progress: Progress) -> Concept:
    """The concept. Raises KeyError, TypeError or ValueError when something is missing or of another kind."""
    pixels, mask = tensors["pixels"].astype(np.float32), tensors["mask"].astype(bool)
    down, right = (None if period is None else float(period) for period in facts["periods"])
    if pixels.shape != (*mask.shape, 3):
        raise ValueError(f"pixels are {pixels.shape} and the mask {mask.shape}")
    if not np.isfinite(pixels[mask]).all() or not all(period is None or period >= 1 for period in (down, right)):
        raise ValueError("its numbers are out of range")
    return Concept(pixels, mask, (down, right), _levels(pixels, mask, progress))


def _levels(pixels: np.ndarray, mask: np.ndarray, progress: Progress) -> list[Level]:
    side = math.sqrt(mask.sum())
    count = 1 + max(0, round(math.log2(max(1.0, side / COARSEST))))
    step = 2 ** (count - 1)
    pad = (0, -mask.shape[1] % step, 0, -mask.shape[0] % step)
    weight = F.pad(torch.from_numpy(mask.astype(np.float32))[None, None], pad)
    colour = F.pad(torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))[None], pad) * weight
    levels = []
    for i in range(count):
        progress(i / count, "learning patches")
        if i:
            weight, colour = F.avg_pool2d(weight, 2), F.avg_pool2d(colour, 2)
        level = _level(colour, weight)
        if level is None:
            break
        levels.append(level)
    if not levels:
        raise PaletteError(
            f"the region holds too few patches of {PATCH} x {PATCH} px; paint a wider area or use a larger photo"
        )
    return levels


def _level(colour: torch.Tensor, weight: torch.Tensor) -> Level | None:
    inside = weight > 0.5
    outside = F.pad(1 - inside.float(), (RADIUS,) * 4, value=1.0)
    valid = (F.max_pool2d(outside, PATCH, 1) == 0).flatten()
    sources = valid.nonzero()[:, 0]
    if len(sources) < PATCH * PATCH:
        return None
    pixels = colour / weight.clamp_min(1e-6)
    mean = (colour.sum((2, 3)) / weight.sum())[..., None, None]
    pixels = torch.where(inside, pixels, mean)
    window = _window()
    # at most 20,000 patches decide the basis
    some = sources[:: -(-len(sources) // 20_000)]
    columns = pixels.shape[3]
    offsets = (torch.arange(PATCH) - RADIUS)[:, None] * columns + torch.arange(PATCH) - RADIUS
    flat = pixels[0].flatten(1)
    patches = flat[:, some[:, None] + offsets.flatten()].permute(1, 0, 2).flatten(1) * window.repeat(3)
    centred = patches - patches.mean(0)
    _, vectors = torch.linalg.eigh(centred.T @ centred)
    basis = (vectors[:, -COMPONENTS:].T * window.repeat(3)).reshape(-1, 3, PATCH, PATCH)
    features = F.conv2d(pixels, basis, padding=RADIUS)[0].flatten(1).T.contiguous()
    ranked = features[sources[:: -(-len(sources) // RANKED)]].T
    return Level(flat.T.contiguous(), inside.flatten(), valid, basis, features, ranked, tuple(pixels.shape[2:]))


def _window() -> torch.Tensor:
    """Square root of a Gaussian weight over the patch, (PATCH^2): the centre decides, the rim guides."""
    g = torch.exp(-0.5 * ((torch.arange(PATCH) - RADIUS) / (PATCH / 3)) ** 2)
    return (g[:, None] * g).sqrt().flatten()


def sample(
    concept: Concept, size: tuple[int, int], seed: int, progress: Progress, quality: str = "balanced"
) -> Texture:
    """A tileable texture of size (H, W) px, at the exemplar's scale.

    quality is a key of PRESETS. The same concept, size, quality and seed give the same texture, bit for bit,
    on any number of cores.
    """
    preset = PRESETS[quality]
    generator = torch.Generator().manual_seed(seed)
    stretch, counts = _whole_periods(concept.periods, size)
    levels = concept.levels if stretch == (1.0, 1.0) else _stretched(concept, stretch)
    sizes = [size]
    while len(sizes) < len(levels) and min(sizes[-1]) >= 8 * PATCH:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    levels = levels[: len(sizes)]
    phases = [_Phases(counts, level, size) for level, size in zip(levels, sizes, strict=True)]
    coarsest = len(levels) - 1
    chosen = min(CHOSEN, coarsest)
    rounds = [preset.coarse if i else preset.finest for i in range(len(levels))]
    work = [h * w * n for (h, w), n in zip(sizes, rounds, strict=True)]
    total = sum(work[:chosen]) + preset.samples * sum(work[chosen:])
    done = share = 0.0

    def report(fraction: float) -> None:
        progress(min(1.0, 0.9 * (done + fraction * share) / total), "sampling the texture")

    def refine(coordinates: torch.Tensor | None, first: int, last: int) -> torch.Tensor:
        """Coordinates at level `last` of those at level first + 1; of a new quilt where there are none."""
        nonlocal done, share
        share = 0.0
        if coordinates is None:
            coordinates = _quilt(levels[first], sizes[first], phases[first], generator, report)
        for i in range(first, last - 1, -1):
            level = levels[i]
            if i < coarsest:
                coordinates = _upsample(level, levels[i + 1], coordinates, sizes[i], pool, report)
            share = work[i] / rounds[i]
            for _ in range(rounds[i]):
                image = _vote(level, coordinates, pool, lambda fraction: report(0.2 * fraction))
                if i:
                    image = _match(level, image, 1, generator, pool, lambda fraction: report(0.2))
                jumps = int(torch.randint(2**31, (1,), generator=generator))
                # jumps find nothing any more where structure is decided already
                coordinates = _search(
                    level,
                    image,
                    coordinates,
                    phases[i],
                    REACHES if i else (),
                    jumps,
                    pool,
                    lambda fraction: report(0.2 + 0.8 * fraction),
                )
                done += share
        return coordinates

    with ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        samples = [refine(None, coarsest, chosen) for _ in range(preset.samples)]
        coordinates = refine(_most_alike(levels[chosen], samples), chosen - 1, 0)
        image = _gathered(levels[0].pixels, coordinates, pool, lambda fraction: report(0.0))
        scales = min(MATCHED, len(levels), len(concept.levels))
        for i in reversed(range(scales)):
            start = 0.9 + 0.09 * (scales - 1 - i) / scales

            def finish(fraction: float, start=start) -> None:
                progress(start + 0.09 * fraction / scales, "matching the texture's patches")

            small = image if i == 0 else _resized(image, sizes[i])
            # of the exemplar before it was stretched, which blurs
            moved = _match(concept.levels[i], small, preset.matches, generator, pool, finish)
            if i == 0:
                image = moved
            else:
                _add_enlarged(image, moved.sub_(small), pool, finish)
        shift = _calmest(image, lambda: finish(1.0))
        return _finished(image, coordinates, shift, concept.mask.shape, levels[0], stretch, pool, progress)


def _gathered(pixels: torch.Tensor, coordinates: torch.Tensor, pool: ThreadPoolExecutor, report) -> torch.Tensor:
    """The texture (H, W, 3) that the coordinates make of the exemplar's pixels."""
    image = torch.empty(*coordinates.shape, 3)

    def gather(number: int, top: int, end: int) -> None:
        image[top:end] = pixels[coordinates[top:end]]

    _each_band(tuple(coordinates.shape), gather, pool, report)
    return image


def _finished(image, coordinates, shift, shape, level: Level, stretch, pool: ThreadPoolExecutor, progress) -> Texture:
    """The texture rolled by shift, and the coordinates in the exemplar of that shape as it was before stretching."""
    h, w = coordinates.shape
    pixels, places = np.empty((h, w, 3), np.float32), np.empty((h, w, 2), np.int64)

    def finish(number: int, top: int, end: int) -> None:
        rows = (np.arange(top, end) + shift[0]) % h
        pixels[rows] = np.roll(image[top:end].clamp(0, 1).numpy(), shift[1], 1)
        source = coordinates[top:end].numpy()
        for axis, index in enumerate((source // level.shape[1], source % level.shape[1])):
            index = np.minimum((index / stretch[axis]).astype(np.int64), shape[axis] - 1)
            places[rows, :, axis] = np.roll(index, shift[1], 1)

    _each_band((h, w), finish, pool, lambda fraction: progress(0.99 + 0.01 * fraction, "finishing the texture"))
    return Texture(pixels, places)


def _most_alike(level: Level, samples: list[torch.Tensor]) -> torch.Tensor:
    """The sample that looks most like the exemplar; the first one where the region holds no crop to compare with."""
    if len(samples) == 1:
        return samples[0]
    crops = Crops(level.pixels.reshape(*level.shape, 3).numpy(), level.inside.reshape(level.shape).numpy())
    if not crops.found:
        return samples[0]
    return min(samples, key=lambda coordinates: crops.distance(level.pixels[coordinates].numpy()))


def _resized(image: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """The means of the image (H, W, 3) over a coarser grid."""
    return torch.from_numpy(cv2.resize(image.numpy(), size[::-1], interpolation=cv2.INTER_AREA))


def _add_enlarged(image: torch.Tensor, small: torch.Tensor, pool: ThreadPoolExecutor, report) -> None:
    """Adds to the image (H, W, 3), in place, a smaller one, enlarged bilinearly on the torus."""
    h, w = image.shape[:2]

    def neighbours(first: int, last: int, size: int, count: int):
        at = (torch.arange(first, last) + 0.5) * (count / size) - 0.5
        below = at.floor().long()
        return below % count, (below + 1) % count, at - below

    left, right, across = neighbours(0, w, w, small.shape[1])

    def add(number: int, top: int, end: int) -> None:
        above, below, down = neighbours(top, end, h, small.shape[0])
        rows = torch.lerp(small[above], small[below], down[:, None, None])
        image[top:end] += torch.lerp(rows[:, left], rows[:, right], across[:, None])

    _each_band((h, w), add, pool, lambda fraction: report(1.0))


def _calmest(image: torch.Tensor, report: Callable[[], None]) -> tuple[int, int]:
    """The roll that puts the border where the texture changes least: a torus may be cut anywhere."""
    step = max(1, BAND // image.shape[1])
    rows, columns = [], torch.zeros(image.shape[1])
    for top in range(0, len(image), step):
        report()
        wide = _with_halo(image, top, min(len(image), top + step), 1)[:-1]
        rows.append((wide[1:] - wide[:-1]).abs_().mean((1, 2)))
        columns += (wide[1:] - wide[1:].roll(1, 1)).abs_().sum((0, 2))
    return -int(torch.cat(rows).argmin()), -int(columns.argmin())


def _whole_periods(periods, size: tuple[int, int]) -> tuple[tuple[float, float], tuple[int, int]]:
    """How much to stretch the exemplar along each axis so that a whole number of its periods fills the tile, and that
    number; 1 and 0 along an axis without a period, or where too few fit to get there with a small stretch."""
    stretch, counts = [1.0, 1.0], [0, 0]
    for axis, period in enumerate(periods):
        count = round(size[axis] / period) if period else 0
        if count and abs(size[axis] / (count * period) - 1) <= MOST_STRETCH:
            stretch[axis], counts[axis] = size[axis] / (count * period), count
    return tuple(stretch), tuple(counts)


def _stretched(concept: Concept, stretch: tuple[float, float]) -> list[Level]:
    h, w = concept.mask.shape
    size = max(1, round(w * stretch[1])), max(1, round(h * stretch[0]))
    mask = cv2.resize(concept.mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    pixels = cv2.resize(concept.pixels, size, interpolation=cv2.INTER_LANCZOS4)
    # between the pixels it is blurred: the finest detail gets the contrast back that it had
    smooth = cv2.GaussianBlur(pixels, (0, 0), 0.7)
    had = (concept.pixels - cv2.GaussianBlur(concept.pixels, (0, 0), 0.7))[concept.mask].std(0)
    pixels = smooth + (pixels - smooth) * (had / np.maximum((pixels - smooth)[mask].std(0), 1e-6))
    return _levels(np.clip(pixels, 0, 1), mask, lambda fraction, message: None)


class _Phases:
    """How far a source is out of step with the place it would fill, along the axes in which the exemplar repeats."""

    def __init__(self, counts: tuple[int, int], level: Level, size: tuple[int, int]):
        # a level too coarse to tell the phase is left alone
        steps = [(axis, 2 * math.pi * counts[axis] / size[axis]) for axis in (0, 1)]
        self.axes = [(axis, step) for axis, step in steps if 0 < step <= 2 * math.pi / SHORTEST_PERIOD]
        self.stride = level.shape[1]

    def misfit(self, source: torch.Tensor, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor | float:
        """0 in phase to 2 in opposition, per axis; source are flattened coordinates, y and x rows and columns."""
        total = 0.0
        for axis, step in self.axes:
            offset = source % self.stride - x if axis else source // self.stride - y
            total = total + 1 - torch.cos(offset * step)
        return total


def _quilt(level: Level, size: tuple[int, int], phases: _Phases, generator: torch.Generator, report) -> torch.Tensor:
    """Coordinates (H, W) of a toroidal quilt: blocks of the exemplar whose overlaps agree, all sources used alike.

    A pixel belongs to the block whose centre is nearest; finding the best seam is left to `_search`.
    """
    h, w = size
    stride = level.shape[1]
    side, anchors = _block(level, min(h, w))
    if side == PATCH and not phases.axes:
        return _scattered(level, size, generator)
    if len(anchors) > ANCHORS:
        anchors = anchors[torch.randperm(len(anchors), generator=generator)[:ANCHORS]]
    local = torch.arange(side)
    blocks = anchors[:, None] + (local[:, None] * stride + local).flatten()
    colours = level.pixels[blocks]
    squares, colours = colours.square().sum(2), colours.flatten(1)
    spread = level.pixels[level.inside].var(0).sum()
    from_centre = (local - (side - 1) / 2).abs()
    distance = torch.maximum(from_centre[:, None], from_centre).flatten()
    canvas = torch.zeros(h * w, 3)
    nearest = torch.full((h * w,), math.inf)
    coordinates = torch.zeros(h * w, dtype=torch.long)
    used = torch.zeros(len(level.pixels))
    step = max(1, side * 2 // 3)
    rows, columns = -(-h // step), -(-w // step)
    # Blocks are laid in reading order; those on one wavefront do not touch, so they are laid at once.
    for front in range(columns + 2 * rows - 2):
        i = torch.arange(max(0, -(-(front - columns + 1) // 2)), min(rows - 1, front // 2) + 1)
        j = front - 2 * i
        y = ((i * h // rows)[:, None] + local) % h
        x = ((j * w // columns)[:, None] + local) % w
        place = (y[:, :, None] * w + x[:, None]).flatten(1)
        known = torch.isfinite(nearest[place]).float()
        target = canvas[place] * known[..., None]
        error = known @ squares.T - 2 * (target.flatten(1) @ colours.T) + target.square().sum((1, 2))[:, None]
        error = error / known.sum(1, keepdim=True).clamp_min(1)
        error = error + BALANCE * spread * used[blocks[:, ::7]].mean(1) / used[level.inside].mean().clamp_min(1e-6)
        if phases.axes:
            error = error + IN_PHASE * spread * phases.misfit(anchors[None], y[:, :1], x[:, :1])
        best = error.topk(min(4, len(anchors)), largest=False).indices
        pick = torch.randint(best.shape[1], (len(best), 1), generator=generator)
        chosen = blocks[best.gather(1, pick)[:, 0]]
        nearer = distance < nearest[place]
        nearest[place] = torch.where(nearer, distance, nearest[place])
        coordinates[place] = torch.where(nearer, chosen, coordinates[place])
        canvas[place] = torch.where(nearer[..., None], level.pixels[chosen], canvas[place])
        used += torch.bincount(chosen.flatten(), minlength=len(used))
        report(0.0)
    return _to_sources(level, coordinates.reshape(h, w))


def _scattered(level: Level, size: tuple[int, int], generator: torch.Generator) -> torch.Tensor:
    """Coordinates (H, W) of patches of the exemplar drawn at random, side by side: where a region is too thin for
    blocks with a structure, a chain of patches that agree drifts, and its end does not meet its beginning."""
    h, w = size
    sources = level.valid.nonzero()[:, 0]
    drawn = sources[torch.randint(len(sources), (-(-h // PATCH), -(-w // PATCH)), generator=generator)]
    drawn = drawn.repeat_interleave(PATCH, 0).repeat_interleave(PATCH, 1)[:h, :w]
    y, x = (torch.arange(side) % PATCH - RADIUS for side in size)
    return _to_sources(level, drawn + y[:, None] * level.shape[1] + x)


def _block(level: Level, limit: int) -> tuple[int, torch.Tensor]:
    """Side of the quilting blocks, and the top left corners (flattened) of those that lie in the region."""
    eh, ew = level.shape
    outside = 1 - level.inside.reshape(1, 1, eh, ew).float()
    side = max(PATCH, int(min(limit // 2, math.sqrt(level.inside.sum()) * BLOCK, eh, ew)))
    while True:
        fits = F.max_pool2d(outside, side, 1)[0, 0] == 0
        anchors = F.pad(fits, (0, side - 1, 0, side - 1)).flatten().nonzero()[:, 0]
        if side == PATCH or len(anchors) >= 0.2 * level.inside.sum():
            return side, anchors
        side = max(PATCH, int(side * 0.85))


def _upsample(
    level: Level, coarse: Level, coordinates: torch.Tensor, size: tuple[int, int], pool: ThreadPoolExecutor, report
) -> torch.Tensor:
    fine = torch.empty(size, dtype=torch.long)
    columns = torch.arange(size[1])

    def upsample(number: int, top: int, end: int) -> None:
        rows = torch.arange(top, end)[:, None]
        parent = coordinates[rows // 2, columns // 2]
        y = parent // coarse.shape[1] * 2 + rows % 2
        x = parent % coarse.shape[1] * 2 + columns % 2
        fine[top:end] = _to_sources(level, y * level.shape[1] + x)

    _each_band(size, upsample, pool, lambda fraction: report(0.0))
    return fine


def _to_sources(level: Level, coordinates: torch.Tensor) -> torch.Tensor:
    """Moves coordinates that are no source to the next one in reading order."""
    sources = level.valid.nonzero()[:, 0]
    rank = level.valid.cumsum(0)[coordinates].clamp_max(len(sources)) - level.valid[coordinates].long()
    return sources[rank.clamp_max(len(sources) - 1)]


def _each_band(size: tuple[int, int], work: Callable, pool: ThreadPoolExecutor, report) -> None:
    """work(number, top, end) for bands of rows that cover the texture, on all cores. A band bounds the memory and the
    time to cancel; its result may not depend on another band's, so that the order does not matter."""
    h, w = size
    rows = max(1, min(BAND // w, -(-h // BANDS)))
    tops = range(0, h, rows)
    working = [pool.submit(work, number, top, min(h, top + rows)) for number, top in enumerate(tops)]
    try:
        for number, band in enumerate(working):
            band.result()
            report((number + 1) / len(working))
    except BaseException:
        for band in working:
            band.cancel()
        raise


def _with_halo(x: torch.Tensor, top: int, end: int, halo: int) -> torch.Tensor:
    """The rows top to end of x (H, ...) and `halo` more on either side, wrapping."""
    return x[torch.arange(top - halo, end + halo) % len(x)]


def _continued(wide: torch.Tensor, halo: int, dy: int, dx: int, stride: int) -> torch.Tensor:
    """c(p + d) - d for the rows within the halo, flattened: where the neighbour's source goes on. May be no source."""
    return (wide[halo + dy : len(wide) - halo + dy].roll(-dx, 1) - (dy * stride + dx)).flatten()


def _vote(level: Level, coordinates: torch.Tensor, pool: ThreadPoolExecutor, report) -> torch.Tensor:
    """The texture (H, W, 3): for each pixel the weighted mean of what the patches around it say."""
    h, w = coordinates.shape
    image = torch.zeros(h * w, 3)
    offsets = [(dy, dx, math.exp(-(dy * dy + dx * dx) / 8)) for dy in (-2, 0, 2) for dx in (-2, 0, 2)]
    total = sum(g for *_, g in offsets)

    def vote(number: int, top: int, end: int) -> None:
        wide = _with_halo(coordinates, top, end, 2)
        part = image[top * w : end * w]
        for dy, dx, g in offsets:
            source = _continued(wide, 2, dy, dx, level.shape[1])
            part.add_(level.pixels.index_select(0, source), alpha=g / total)

    _each_band((h, w), vote, pool, report)
    return image.reshape(h, w, 3)


def _match(level: Level, image: torch.Tensor, times: int, generator: torch.Generator, pool, report) -> torch.Tensor:
    """The image (H, W, 3) with its patches moved so that they are distributed as the exemplar's.

    Each time the patches' components are turned by a random rotation, along each axis every value goes to the
    exemplar's value of the same rank, and the moves of all patches that hold a pixel are averaged.
    """
    h, w = image.shape[:2]
    average = 1 / _window().square().sum()
    for done in range(times):
        turn, _ = torch.linalg.qr(torch.randn(COMPONENTS, COMPONENTS, generator=generator))
        basis = (turn @ level.basis.flatten(1)).reshape(level.basis.shape)
        low, step, moves = _moves(
            _quantiles(_some_components(image, basis, generator)), _quantiles(turn @ level.ranked)
        )
        moved = torch.empty_like(image)

        # into bins by the convolution itself, and back by its adjoint
        forth, offset = basis / step[..., None], (-low / step).flatten()
        back = (average * basis).flip(2, 3).transpose(0, 1).contiguous(memory_format=torch.channels_last)

        def move(number, top, end, image=image, forth=forth, offset=offset, back=back, moves=moves, moved=moved):
            wide = _with_halo(image, top, end, 2 * RADIUS).permute(2, 0, 1)[None]
            wide = F.pad(wide, (2 * RADIUS, 2 * RADIUS, 0, 0), mode="circular").contiguous()
            bins = F.conv2d(wide, forth, offset)[0].clamp_(0, QUANTILES - 1)
            by = moves.gather(1, bins.flatten(1).long()).reshape(1, *bins.shape)
            by = F.conv2d(by.contiguous(memory_format=torch.channels_last), back)[0].permute(1, 2, 0)
            torch.add(image[top:end], by, out=moved[top:end])

        _each_band((h, w), move, pool, lambda fraction, done=done: report((done + fraction) / times))
        image = moved
    return image


def _some_components(image: torch.Tensor, basis: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """(COMPONENTS, n) of all patches of the image, of RANKED / 2 drawn ones where there are more than RANKED."""
    h, w = image.shape[:2]
    if h * w <= RANKED:
        wide = F.pad(image.permute(2, 0, 1)[None], (RADIUS,) * 4, mode="circular")
        return F.conv2d(wide, basis)[0].flatten(1)
    place = torch.randint(h * w, (RANKED // 2,), generator=generator)
    local = torch.arange(PATCH) - RADIUS
    rows = (place // w)[:, None, None] + local[:, None]
    columns = (place % w)[:, None, None] + local
    patches = image.reshape(-1, 3)[(rows % h * w + columns % w).flatten(1)]
    return basis.permute(0, 2, 3, 1).flatten(1) @ patches.flatten(1).T


def _quantiles(values: torch.Tensor) -> np.ndarray:
    values = np.sort(values.numpy(), 1)
    return values[:, np.linspace(0, values.shape[1] - 1, QUANTILES).round().astype(int)]


def _moves(before: np.ndarray, after: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """How far values go from one set of quantiles to the other, in equal bins from `low` in steps of `step`."""
    low, high = before[:, :1], before[:, -1:]
    step = np.maximum(high - low, 1e-6) / QUANTILES
    at = low + (np.arange(QUANTILES) + 0.5) * step
    moves = np.stack([np.interp(x, b, a) - x for x, b, a in zip(at, before, after, strict=True)])
    return *(torch.from_numpy(x[..., None]) for x in (low, step)), torch.from_numpy(moves.astype(np.float32))


def _search(level: Level, image, before, phases: _Phases, reaches, seed: int, pool, report) -> torch.Tensor:
    """One round of search: better coordinates (H, W) than `before` for the texture `image` (H, W, 3); reaches in px of
    the random jumps."""
    h, w = before.shape
    stride = level.shape[1]
    after = torch.empty_like(before)
    used = torch.bincount(before.flatten(), minlength=len(level.valid)).float().reshape(1, 1, *level.shape)
    used = F.avg_pool2d(used, 5, 1, 2).flatten() * (level.valid.sum() / (h * w))

    def target_of(top: int, end: int) -> torch.Tensor:
        wide = _with_halo(image, top, end, RADIUS).permute(2, 0, 1)[None]
        wide = F.pad(wide, (RADIUS, RADIUS, 0, 0), mode="circular")
        return F.conv2d(wide, level.basis)[0].flatten(1).T.contiguous()

    some = min(h, max(1, BAND // w))
    distance = (target_of(0, some) - level.features[before[:some].flatten()]).square_().sum(1)
    scale = distance.median()

    def search(number: int, top: int, end: int) -> None:
        target = target_of(top, end)
        # a copy: the bands beside this one read the rows of `before`
        current = before[top:end].flatten().clone()
        above, below = before[top - 1], before[end % h]

        def cost_of(where: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
            cost = (target[where] - level.features.index_select(0, source)).square_().sum(1)
            cost += OCCURRENCE * scale * used[source]
            if phases.axes:
                place = top * w + where
                cost += OUT_OF_PHASE * scale * phases.misfit(source, place // w, place % w)
            return cost

        # most pixels are never asked for what they cost: all their neighbours go on from the same source
        cost = torch.full((len(current),), UNKNOWN)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                if dy or dx:
                    # the band's rows in their newest state, so that good sources travel far in one round
                    wide = torch.cat([above[None], current.reshape(-1, w), below[None]])
                    _improve(level, cost_of, current, cost, _continued(wide, 1, dy, dx, stride))
        generator = torch.Generator().manual_seed(seed + number)
        for reach in reaches:
            jump = torch.randint(-reach, reach + 1, (2, len(current)), generator=generator)
            _improve(level, cost_of, current, cost, current + jump[0] * stride + jump[1], COHERENCE)
        after[top:end] = current.reshape(-1, w)

    _each_band((h, w), search, pool, report)
    return after


def _improve(level: Level, cost_of: Callable, current: torch.Tensor, cost: torch.Tensor, candidate, margin=1.0) -> None:
    """Takes the candidate sources that cost less than `margin` of the current ones, in place."""
    ok = (candidate != current) & (candidate >= 0) & (candidate < len(level.valid))
    where = ok.nonzero()[:, 0]
    where = where[level.valid[candidate[where]]]
    unknown = where[cost[where] == UNKNOWN]
    cost[unknown] = cost_of(unknown, current[unknown])
    source = candidate[where]
    found = cost_of(where, source)
    better = found < margin * cost[where]
    where = where[better]
    current[where] = source[better]
    cost[where] = found[better]
