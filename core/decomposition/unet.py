"""Decomposer `unet`: the network of `models/svbrdf_net.py` on a torus of any size, in bounded memory.

A network with strides sees a texture differently after it is rolled by a pixel. So the texture is first rolled to an
origin that its content decides, and the maps are rolled back: then rolling the texture rolls the maps, bit for bit.

The network tells the material's mean roughness: what it says of its variation is no better than none on materials it
was not trained on (`models/svbrdf_net.md`), so that follows `analytic.vary`.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch

from ...models.svbrdf_net import STRIDE, SvbrdfNet
from ..errors import PaletteError
from ..image import srgb_from_linear
from ..material import SVBRDF
from ..tensors import read_tensors
from ..torus import integrate, normal_from_height
from . import analytic
from .analytic import LEAST_ROUGHNESS, vary

WEIGHTS = Path(__file__).resolve().parents[2] / "models" / "svbrdf_net.safetensors"
TILE = 512, 1024  # px, rows and columns
HALO = 96  # px: what is farther away changes a pixel by less than a grey level of 255
OVERVIEW = 256  # px: longer side of what the material is recognised in
SAMPLE = 192  # px: side of each of at most four samples of which the light is read
STEEPEST = 4.0
# times the relief of `analytic`, which is added: the network says what is likely on average, nearly flat where unsure,
# the formula that dark is deep. On materials left out of training their sum is nearer by ST-LPIPS (0.21) than the
# network's relief (0.24), the formula's (0.31) or a flat surface (0.34), at a squared error a tenth above a flat one's
GUESS = 1.0
# of what it takes for light, this share is taken out of the albedo: on materials left out of training as near to the
# truth as all of it (CIEDE2000 3.3; as photographed 4.1), and half the harm to what had no shading (1.5 to 2.8)
GAIN = 0.5
DARKEST = 1e-3  # linear, as in training
FAINT = 0.03  # deviation of the encoded pixels below which there is ever less to see, and the network is believed less


def decompose(
    texture: np.ndarray,
    progress: Callable[[float, str], None],
    weights: Path = WEIGHTS,
    relief: float = 1.0,
    share: float = GAIN,
    guess: float = GUESS,
) -> SVBRDF:
    """See `core.decomposition.decompose`. Peak memory beyond the maps: about 0.3 GB a thread.

    relief: factor on the slopes that are found; share: of what is taken for light, what is taken out of the albedo;
    guess: factor on the relief of `analytic` that is added.
    """
    net = load(weights)
    progress(0.0, "recognising the material")
    origin = _origin(texture)
    texture = np.roll(texture, (-origin[0], -origin[1]), (0, 1))
    encoded = srgb_from_linear(np.clip(texture, 0, 1)).astype(np.float32)
    with torch.no_grad():
        material, kind = net.recognise(overview(encoded))
        whole = net.describe(_samples(encoded), material)
        out = _tiled(net, encoded, whole, progress)
        mean = net.mean_roughness(kind).clamp(LEAST_ROUGHNESS, 1).item()
    progress(0.8, "integrating the height")
    seen = min(1.0, float(encoded.std((0, 1)).max()) / FAINT)
    out *= seen
    gain, slope = share * out[..., :3], (relief * out[..., 3:]).clamp(-STEEPEST, STEEPEST)
    albedo = (torch.from_numpy(texture).clamp_min(DARKEST) * torch.exp(gain)).clamp(0, 1)
    height = integrate(slope[..., 0], slope[..., 1]) / texture.shape[1]
    height += guess * seen * analytic.relief(torch.from_numpy(texture))
    progress(0.9, "computing normals")
    maps = (albedo, normal_from_height(height), vary(mean, albedo), height)
    maps = (x.roll(origin, (0, 1)).numpy() for x in maps)
    progress(1.0, "computing normals")
    return SVBRDF(*maps)


@cache
def load(path: Path) -> SvbrdfNet:
    """The network with the weights of a safetensors file; PaletteError where they are not this network's."""
    tensors, _ = read_tensors(path)
    net = SvbrdfNet()
    try:
        net.load_state_dict({name: torch.from_numpy(x.astype(np.float32)) for name, x in tensors.items()})
    except RuntimeError as error:
        raise PaletteError(f"'{path}' does not hold this network's weights; install the extension again") from error
    return net.eval().to(memory_format=torch.channels_last)


def _origin(texture: np.ndarray) -> tuple[int, int]:
    """A pixel that depends on the content only: the one with the brightest neighbourhood, in whole numbers."""
    total = np.round(np.clip(texture, 0, 1).sum(-1) * 4096).astype(np.int64)
    for axis in (0, 1):
        # box sums of whole numbers have no rounding, hence the same maximum however the texture is rolled
        total = sum(np.roll(total, shift, axis) * (7 + shift) for shift in range(-5, 6))
    return tuple(int(i) for i in np.unravel_index(total.argmax(), total.shape))


def overview(encoded: np.ndarray) -> torch.Tensor:
    """(1, 3, H, W), sides multiples of STRIDE, at most OVERVIEW."""
    share = min(1.0, OVERVIEW / max(encoded.shape[:2]))
    h, w = (max(STRIDE, round(side * share / STRIDE) * STRIDE) for side in encoded.shape[:2])
    small = cv2.resize(encoded, (w, h), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small).permute(2, 0, 1)[None].contiguous(memory_format=torch.channels_last)


def _samples(encoded: np.ndarray) -> torch.Tensor:
    """(N, 3, SAMPLE, SAMPLE) at the texture's own resolution: as much of the torus as four samples cover."""
    starts = ((0, side // 2) if side > SAMPLE else (0,) for side in encoded.shape[:2])
    lines = [[np.arange(start, start + SAMPLE) for start in both] for both in starts]
    parts = [encoded.take(r, 0, mode="wrap").take(c, 1, mode="wrap") for r in lines[0] for c in lines[1]]
    return torch.from_numpy(np.stack(parts)).permute(0, 3, 1, 2).contiguous(memory_format=torch.channels_last)


def _tiled(net: SvbrdfNet, encoded: np.ndarray, whole: torch.Tensor, progress) -> torch.Tensor:
    """Gain and slope of every pixel, (H, W, 5); tiles with a halo of what surrounds them on the torus."""
    height, width = encoded.shape[:2]
    out = torch.empty(height, width, 5)
    corners = [(top, left) for top in range(0, height, TILE[0]) for left in range(0, width, TILE[1])]

    def tile(corner: tuple[int, int]) -> None:
        top, left = corner
        h, w = min(TILE[0], height - top), min(TILE[1], width - left)
        # both sides grow to whole strides
        rows = np.arange(top - HALO, top + -(-h // STRIDE) * STRIDE + HALO) % height
        columns = np.arange(left - HALO, left + -(-w // STRIDE) * STRIDE + HALO) % width
        pixels = torch.from_numpy(encoded[rows[:, None], columns[None]]).permute(2, 0, 1)[None]
        with torch.no_grad():
            found = net(pixels.contiguous(memory_format=torch.channels_last), whole)
        inner = torch.cat([found["gain"], found["slope"]], 1)[0, :, HALO : HALO + h, HALO : HALO + w]
        out[top : top + h, left : left + w] = inner.permute(1, 2, 0)

    with ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        tiles = [pool.submit(tile, corner) for corner in corners]
        try:
            for i, done in enumerate(tiles):
                done.result()
                progress(0.05 + 0.7 * (i + 1) / len(corners), "separating albedo and relief")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return out
