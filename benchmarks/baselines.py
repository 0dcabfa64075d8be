"""What the engine `patch` is compared with, each from its paper: a texture (H, W, 3) and coordinates, or None.

Arguments: pixels (h, w, 3) float32, sRGB-encoded, 0 to 1; mask (h, w) bool; size px of a square texture; seed.
All textures are meant to wrap. Methods that need a rectangle take the largest square within the mask.
"""

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from .measures import Vgg


def largest_square(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the largest square (odd sides only, but for a full mask) that lies in the mask."""
    if mask.all():
        side = min(mask.shape)
        top, left = (mask.shape[0] - side) // 2, (mask.shape[1] - side) // 2
        return slice(top, top + side), slice(left, left + side)
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_C, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(distance.argmax(), mask.shape)
    reach = int(distance[y, x]) - 1
    return slice(y - reach, y + reach + 1), slice(x - reach, x + reach + 1)


# ---------------------------------------------------------------- what artists do


def cross_fade(pixels, mask, size, seed):
    """The square's last quarter is faded into its first, so the tile is a quarter smaller than the square."""
    tile = pixels[largest_square(mask)]
    for axis in (0, 1):
        lines = np.moveaxis(tile, axis, 0)
        overlap = len(lines) // 4
        weight = ((np.arange(overlap) + 0.5) / overlap)[:, None, None].astype(np.float32)
        first = weight * lines[:overlap] + (1 - weight) * lines[-overlap:]
        tile = np.moveaxis(np.concatenate([first, lines[overlap:-overlap]]), 0, axis)
    return np.ascontiguousarray(tile), None


def offset_poisson(pixels, mask, size, seed):
    """The square is rolled by half; the seam, now in the middle, is covered by the square's own middle strip.

    One axis after the other, so that the strip wraps along the seam. Blended after Perez et al. 2003: the strip plus
    the harmonic function that makes its sides meet what they border on, in closed form by a Fourier series along it.
    """
    tile = pixels[largest_square(mask)]
    for axis in (1, 0):
        lines = np.moveaxis(tile, axis, 0)  # (across, along, 3)
        n, along = lines.shape[:2]
        rolled = np.roll(lines, n // 2, 0)
        first, last = n // 2 - n // 8, n // 2 + n // 8
        sides = np.fft.rfft(rolled[[first, last]] - lines[[first, last]], axis=1)
        frequency = (2 * np.pi * np.fft.rfftfreq(along))[:, None]
        length = last - first
        correction = []
        for t in range(length + 1):
            a, b = _decay(frequency, length - t, length), _decay(frequency, t, length)
            correction.append(np.fft.irfft(a * sides[0] + b * sides[1], along, 0))
        rolled[first : last + 1] = lines[first : last + 1] + np.array(correction)
        tile = np.moveaxis(rolled, 0, axis)
    return np.clip(tile, 0, 1).astype(np.float32), None


def _decay(frequency, t: int, length: int):
    """sinh(f t) / sinh(f length), without overflow, t / length for f = 0."""
    f = np.maximum(frequency, 1e-9)
    ratio = np.exp(-f * (length - t)) * np.expm1(-2 * f * t) / np.expm1(-2 * f * length)
    return np.where(frequency == 0, t / length, ratio)


# ---------------------------------------------------------------- quilting

STEP, OVERLAP = 32, 8  # px
TOLERANCE = 1.1  # blocks with at most so many times the least error are drawn from


def quilting(pixels, mask, size, seed):
    """Image quilting (Efros and Freeman 2001) on a torus: the last block of a row also has to meet the first one."""
    random = np.random.default_rng(seed)
    count = next(n for n in range(max(1, size // STEP), 0, -1) if size % n == 0)
    step = size // count
    side = step + OVERLAP
    fits = cv2.erode(np.pad(mask, 1).astype(np.uint8), np.ones((side, side), np.uint8), anchor=(0, 0))[1:-1, 1:-1]
    fits = fits[: len(mask) - side + 1, : len(mask[0]) - side + 1] > 0
    if not fits.any():
        raise ValueError(f"no block of {side} x {side} px fits into the region")
    canvas = np.zeros((size, size, 3), np.float32)
    coordinates = np.zeros((size, size, 2), np.int64)
    known = np.zeros((size, size), np.float32)
    local = np.arange(side)
    for i in range(count):
        for j in range(count):
            place = np.ix_((i * step + local) % size, (j * step + local) % size)
            if known[place].any():
                weight = np.repeat(known[place][..., None], 3, 2)
                error = cv2.matchTemplate(pixels, canvas[place] * weight, cv2.TM_SQDIFF, mask=weight)
                error = np.where(fits, np.maximum(error, 0), np.inf)
                candidates = np.argwhere(error <= error.min() * TOLERANCE)
            else:
                candidates = np.argwhere(fits)
            y, x = candidates[random.integers(len(candidates))]
            block = pixels[y : y + side, x : x + side]
            difference = ((block - canvas[place]) ** 2).sum(2)
            keep = np.ones((side, side), bool)
            if j:
                keep[:, :OVERLAP] &= _after_seam(difference[:, :OVERLAP])
            if j == count - 1 and j:
                keep[:, ::-1][:, :OVERLAP] &= _after_seam(difference[:, ::-1][:, :OVERLAP])
            if i:
                keep[:OVERLAP] &= _after_seam(difference[:OVERLAP].T).T
            if i == count - 1 and i:
                keep[::-1][:OVERLAP] &= _after_seam(difference[::-1][:OVERLAP].T).T
            keep |= known[place] == 0
            source = np.stack(np.broadcast_arrays((y + local)[:, None], x + local), -1)
            canvas[place] = np.where(keep[..., None], block, canvas[place])
            coordinates[place] = np.where(keep[..., None], source, coordinates[place])
            known[place] = 1
    return canvas, coordinates


def _after_seam(error: np.ndarray) -> np.ndarray:
    """True from the cheapest downward path through error (rows, columns) to the right."""
    rows, columns = error.shape
    cost = error.astype(np.float64).copy()
    for y in range(1, rows):
        above = np.pad(cost[y - 1], 1, constant_values=np.inf)
        cost[y] += np.minimum(np.minimum(above[:-2], above[1:-1]), above[2:])
    keep = np.zeros(error.shape, bool)
    x = int(cost[-1].argmin())
    for y in reversed(range(rows)):
        keep[y, x:] = True
        if y:
            low = max(0, x - 1)
            x = low + int(cost[y - 1, low : x + 2].argmin())
    return keep


# ---------------------------------------------------------------- GPNN

PATCH = 7
RATIO = 0.75  # between scales
COARSEST = 14  # px
ITERATIONS = 10  # per scale
ALPHA = 0.005  # completeness
NOISE = 0.75  # standard deviation of what the coarsest scale begins with, colours in -1 to 1
CHUNK = 512  # queries at a time


def gpnn_exact(pixels, mask, size, seed):
    """GPNN (Granot et al. 2022), all distances: score d(i, j) / (alpha + min_i d(i, j))."""
    return _gpnn(pixels, mask, size, seed, _nearest_normalised)


def gpnn_faiss(pixels, mask, size, seed):
    """GPNN with an IVF index of FAISS (sqrt(n) lists, one probed): nearest by distance, without completeness."""
    return _gpnn(pixels, mask, size, seed, _ivf)


def _gpnn(pixels, mask, size, seed, search):
    """From noise, coarse to fine; queries wrap. search(keys) gives a function from queries to indices of keys."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.from_numpy(pixels.transpose(2, 0, 1) * 2 - 1)[None]
    inside = torch.from_numpy(mask.astype(np.float32))[None, None]
    colour = (image * inside).sum((2, 3)) / inside.sum()
    image = torch.where(inside > 0, image, colour[..., None, None])
    pyramid = []
    while True:
        scale = RATIO ** len(pyramid)
        shape = [round(n * scale) for n in image.shape[2:]]
        side = round(size * scale)
        within = F.interpolate(inside, shape, mode="area") > 0.99
        valid = (-F.max_pool2d(-within.float(), PATCH, 1) > 0).flatten()
        if min(*shape, side) < COARSEST or valid.sum() < PATCH * PATCH:
            break
        small = F.interpolate(image, shape, mode="bicubic", antialias=True) if pyramid else image
        pyramid.append((small, valid.nonzero()[:, 0], side))
    texture = None
    for level in reversed(range(len(pyramid))):
        exemplar, valid, side = pyramid[level]
        if texture is None:
            texture = colour[..., None, None] + NOISE * torch.randn(1, 3, side, side, generator=generator)
            blurred = exemplar
        else:
            texture = _resize_torus(texture, side)
            blurred = F.interpolate(pyramid[level + 1][0], exemplar.shape[2:], mode="bicubic")
        nearest = search(_patches(blurred)[valid])
        for i in range(ITERATIONS):
            if i == 1:  # the first round looks for what is as blurred as the texture is
                nearest = search(_patches(exemplar)[valid])
            wide = F.pad(texture, (PATCH // 2,) * 4, mode="circular")
            texture = _fold(exemplar, valid[nearest(_patches(wide))], side)
    return ((texture[0].permute(1, 2, 0) + 1) / 2).clamp(0, 1).numpy(), None


def _resize_torus(texture: torch.Tensor, side: int) -> torch.Tensor:
    """Bicubic to (side, side) with three repeats each way, cut from the middle."""
    wide = F.interpolate(texture.repeat(1, 1, 3, 3), (3 * side, 3 * side), mode="bicubic")
    return wide[..., side : 2 * side, side : 2 * side]


def _patches(image: torch.Tensor) -> torch.Tensor:
    """All patches (n, 3 PATCH^2), scaled so that distances are mean squares: ALPHA is meant for those."""
    return F.unfold(image, PATCH)[0].T.contiguous() / (3 * PATCH**2) ** 0.5


def _fold(exemplar: torch.Tensor, chosen: torch.Tensor, side: int) -> torch.Tensor:
    """Mean of the overlapping patches with the top left corners chosen (side * side,) in patches of the exemplar."""
    columns = exemplar.shape[3]
    across = columns - PATCH + 1
    corner = (chosen // across * columns + chosen % across).reshape(side, side)
    flat = exemplar[0].flatten(1).T
    total = torch.zeros(side, side, 3)
    for dy in range(PATCH):
        for dx in range(PATCH):
            colours = flat[(corner + dy * columns + dx).flatten()].reshape(side, side, 3)
            total += colours.roll((dy - PATCH // 2, dx - PATCH // 2), (0, 1))
    return (total / PATCH**2).permute(2, 0, 1)[None]


def _nearest_normalised(keys: torch.Tensor):
    squares = keys.square().sum(1, keepdim=True)
    # |q - k|^2 = [q, |q|^2, 1] . [-2 k, 1, |k|^2]
    extended = torch.cat([-2 * keys, torch.ones_like(squares), squares], 1).T.contiguous()
    buffer = torch.empty(CHUNK, len(keys))

    def distances(queries, weight):
        for start in range(0, len(queries), CHUNK):
            q = queries[start : start + CHUNK]
            q = torch.cat([q, q.square().sum(1, keepdim=True), torch.ones(len(q), 1)], 1)
            # numpy reduces a row several times faster than torch
            yield torch.mm(q, weight, out=buffer[: len(q)]).numpy()

    def nearest(queries):
        least = np.full(len(keys), np.inf, np.float32)
        for block in distances(queries, extended):
            np.minimum(least, block.min(0), out=least)
        scores = distances(queries, extended / (ALPHA + torch.from_numpy(least).clamp_min(0)))
        return torch.from_numpy(np.concatenate([block.argmin(1) for block in scores]))

    return nearest


def _ivf(keys: torch.Tensor):
    import faiss

    faiss.omp_set_num_threads(torch.get_num_threads())
    lists = max(1, int(len(keys) ** 0.5))
    index = faiss.IndexIVFFlat(faiss.IndexFlatL2(keys.shape[1]), keys.shape[1], lists)
    index.cp.min_points_per_centroid = 1  # only silences a warning
    index.train(keys.numpy())
    index.add(keys.numpy())
    return lambda queries: torch.from_numpy(index.search(queries.numpy(), 1)[1][:, 0])


# ---------------------------------------------------------------- Gatys

LAYERS = ("1.1", "2.1", "3.1", "4.1")
STEPS = ((4, 100), (2, 100), (1, 60))  # (reduction, evaluations), coarse to fine
BORDER = 32  # px, repeated around the texture, so that it wraps


def gatys(pixels, mask, size, seed):
    """Texture synthesis by Gram matrices (Gatys et al. 2015) of VGG16, by L-BFGS from noise, coarse to fine."""
    vgg = Vgg()
    generator = torch.Generator().manual_seed(seed)
    exemplar = torch.from_numpy(np.ascontiguousarray(pixels[largest_square(mask)].transpose(2, 0, 1)))[None]
    texture = None
    for reduction, evaluations in STEPS:
        small = F.avg_pool2d(exemplar, reduction)
        side = size // reduction
        with torch.no_grad():
            targets = [_gram(f, 0) for f in vgg(small, LAYERS)]
        if texture is None:
            texture = small.mean((2, 3), keepdim=True) + 0.2 * torch.randn(1, 3, side, side, generator=generator)
        else:
            texture = _resize_torus(texture, side)
        texture = texture.clone().requires_grad_()
        optimiser = torch.optim.LBFGS(
            [texture], max_iter=evaluations, max_eval=evaluations, history_size=20, tolerance_change=0,
            tolerance_grad=0, line_search_fn="strong_wolfe",
        )  # fmt: skip

        def loss(texture=texture, optimiser=optimiser, targets=targets):
            optimiser.zero_grad()
            grams = [_gram(f, BORDER) for f in vgg(F.pad(texture, (BORDER,) * 4, mode="circular"), LAYERS)]
            error = sum(((g - t) ** 2).sum() / (t**2).sum() for g, t in zip(grams, targets, strict=True))
            error = error + 10 * (F.relu(texture - 1) + F.relu(-texture)).square().mean()
            error.backward()
            return error

        optimiser.step(loss)
        texture = texture.detach()
    return texture[0].permute(1, 2, 0).clamp(0, 1).numpy(), None


def _gram(features: torch.Tensor, border: int) -> torch.Tensor:
    """Gram matrix per position of (1, C, h, w), without the repeated border (px of the image)."""
    reduction = {64: 1, 128: 2, 256: 4, 512: 8}[features.shape[1]]
    cut = border // reduction
    flat = features[0, :, cut : features.shape[2] - cut, cut : features.shape[3] - cut].flatten(1)
    return flat @ flat.T / flat.shape[1]


ENGINES = {
    "quilting": quilting,
    "offset-poisson": offset_poisson,
    "cross-fade": cross_fade,
    "gpnn-faiss": gpnn_faiss,
    "gpnn-exact": gpnn_exact,
    "gatys": gatys,
}
