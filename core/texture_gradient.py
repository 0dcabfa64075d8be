"""How well a plane explains the gradient of a region's texture: the change of the local spectrum with the distance.

Claim: of all planes, the surface's is the one under which the spectra of all windows, brought to the plane's scale and
foreshortening, agree best. A window around the image point x sees the texture through the linear map A(x) from the
plane to the image, so its power at the image frequency f is P_x(f) = P(A(x)^T f) |det A(x)|, P being the texture's.
For a plane with the normal n the score is

    -log of the variance of log P_x(f) - log |det A_n(x)| that no common function of A_n(x)^T f explains.

The texture has to be homogeneous; it need not be isotropic. Scores with a part of the region left out (jackknife) tell
how much one part decides.

Sources: Malik and Rosenholtz 1997 (affine change of the local spectrum), Super and Bovik 1995 (shape from spectra).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

AXIS = np.array([0.0, 0.0, 1.0])  # of the camera: the normal of what is seen from the front
WINDOW = 64  # px
HOP = 32
LEAST_COVER = 0.85  # of a window by the region, weighted
LEAST_WINDOWS = 10
RADII, ANGLES = 8, 12  # of the frequencies that are read in a window
LOWEST, HIGHEST = 2.5 / WINDOW, 0.3  # cycles per px
OFFSETS = 4  # places of these frequencies, so that no plane is favoured because they fall on the bins' centres
BIN = 0.35  # octaves
BLOCKS = 9  # parts of the region, left out one at a time
NEAREST_HORIZON = 0.04  # least inverse depth of a window, relative to the mean


@dataclass
class Spectra:
    """Local power spectra of a region, n windows with m frequencies each.

    at (n, 2): centres in normalised image coordinates (px from the principal point over the focal length; x right, y
    down); power (n, m): logarithms; frequency (n, m, 2): cycles per px; block (n,): which part of the region.
    """

    at: np.ndarray
    power: np.ndarray
    frequency: np.ndarray
    block: np.ndarray


def local_spectra(grey: np.ndarray, mask: np.ndarray, focal: float, centre: tuple[float, float]) -> Spectra | None:
    """Spectra of a picture's windows that lie in the region; None with fewer than LEAST_WINDOWS.

    grey (h, w) float32, the logarithm of luminance, so that shading does not change the contrast; mask (h, w) bool;
    focal length and principal point (x, y) in px of this picture.
    """
    h, w = grey.shape
    if min(h, w) < WINDOW:
        return None
    taper = np.hanning(WINDOW + 2)[1:-1].astype(np.float32)
    taper = taper[:, None] * taper
    windows = np.lib.stride_tricks.sliding_window_view
    covers = windows(mask.astype(np.float32), (WINDOW, WINDOW))[::HOP, ::HOP]
    i, j = np.nonzero((covers * taper).sum((2, 3)) >= LEAST_COVER * taper.sum())
    if len(i) < LEAST_WINDOWS:
        return None
    weight = covers[i, j] * taper
    pixels = windows(grey, (WINDOW, WINDOW))[::HOP, ::HOP][i, j]
    mean = (pixels * weight).sum((1, 2), keepdims=True) / weight.sum((1, 2), keepdims=True)
    power = np.abs(np.fft.rfft2((pixels - mean) * weight)) ** 2 / (weight**2).sum((1, 2), keepdims=True)
    power = power.reshape(len(i), -1).astype(np.float32)
    matrices, frequencies = _places()
    which = (i % 2) * 2 + j % 2
    read = np.empty((len(i), RADII * ANGLES))
    for offset in range(OFFSETS):
        read[which == offset] = power[which == offset] @ matrices[offset].T
    middle = np.stack([j, i], -1) * HOP + (WINDOW - 1) / 2
    at = (middle - centre) / focal
    return Spectra(at, np.log(read + 1e-9), frequencies[which], _blocks(at))


@cache
def _places() -> tuple[np.ndarray, np.ndarray]:
    """Weights (OFFSETS, m, bins of a half spectrum) that read power at log-polar places, and the places (.., m, 2)."""
    v, u = np.meshgrid(np.fft.fftfreq(WINDOW), np.fft.rfftfreq(WINDOW), indexing="ij")
    weights, places = [], []
    for offset in range(OFFSETS):
        step = np.log(HIGHEST / LOWEST) / (RADII - 0.5)
        radius = LOWEST * np.exp((np.arange(RADII) + 0.5 * (offset // 2)) * step)
        angle = (np.arange(ANGLES) + 0.5 * (offset % 2)) * np.pi / ANGLES
        place = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)).reshape(-1, 2)
        x, y = place[:, 0, None, None], place[:, 1, None, None]
        # the spectrum of a real picture is symmetric
        distance = np.minimum((u - x) ** 2 + (v - y) ** 2, (u + x) ** 2 + (v + y) ** 2)
        sigma = np.maximum(0.6 / WINDOW, 0.13 * np.hypot(x, y))
        weight = np.exp(-0.5 * distance / sigma**2).reshape(len(place), -1)
        weights.append(weight / weight.sum(1, keepdims=True))
        places.append(place)
    return np.array(weights, np.float32), np.array(places)


def _blocks(at: np.ndarray) -> np.ndarray:
    """(n,) 0 to BLOCKS - 1: three strips of equally many windows, each cut into three."""
    count = int(BLOCKS**0.5)

    def rank(x):
        return np.argsort(np.argsort(x, kind="stable"), kind="stable") * count // len(x)

    row = rank(at[:, 1])
    block = np.empty(len(at), int)
    for r in range(count):
        block[row == r] = r * count + rank(at[row == r, 0])
    return block


def plane_axes(normal: np.ndarray) -> np.ndarray:
    """(2, 3) unit vectors in a plane, right and down, camera coordinates (x right, y down, z forward).

    normal (3,): unit, away from the camera. The least rotation that takes the optical axis to it brings the image's
    axes to them.
    """
    a, b, c = normal
    return np.array([[1 - a * a / (1 + c), -a * b / (1 + c), -a], [-a * b / (1 + c), 1 - b * b / (1 + c), -b]])


def local_maps(normal: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n, 2, 2) derivatives of the image point by the plane's coordinates, one row per axis of `plane_axes`.

    In units of the focal length over the plane's distance: unity for a plane seen from the front.
    """
    axes = plane_axes(normal)
    return (axes[:, :2] - at[:, None, :] * axes[:, 2:]) * (at @ normal[:2] + normal[2])[:, None, None]


def gradient_scores(spectra: Spectra, normal: np.ndarray) -> np.ndarray | None:
    """(1 + BLOCKS,) the score of a plane, then with each block left out; None where its horizon crosses the region.

    normal (3,): unit, away from the camera, camera coordinates.
    """
    inverse_depth = spectra.at @ normal[:2] + normal[2]
    if inverse_depth.min() <= NEAREST_HORIZON * abs(inverse_depth.mean()):
        return None
    return spectra_scores(spectra, local_maps(normal, spectra.at))


def spectra_scores(spectra: Spectra, a: np.ndarray) -> np.ndarray:
    """(1 + BLOCKS,) the score of a surface given by its local maps (n, 2, 2), then with each block left out."""
    density = np.log(np.abs(np.linalg.det(a)))
    f, scale = spectra.frequency, np.exp(-density.mean() / 2)
    # written out: a third of the time that einsum takes
    kx, ky = ((f[..., 0] * a[:, i, :1] + f[..., 1] * a[:, i, 1:]) * scale for i in (0, 1))
    power = spectra.power - (density - density.mean())[:, None]
    radius = np.log2(np.hypot(kx, ky)) / BIN
    radius -= np.floor(radius.min())
    angle = np.arctan2(ky, kx) * (ANGLES / np.pi)
    r, t = radius.astype(int), np.floor(angle).astype(int)
    dr, dt = radius - r, angle - t
    bins = (int(r.max()) + 2) * ANGLES
    start = spectra.block[:, None] * bins
    count, total = np.zeros(BLOCKS * bins), np.zeros(BLOCKS * bins)
    for i in (0, 1):
        for j in (0, 1):
            share = ((dr if i else 1 - dr) * (dt if j else 1 - dt)).ravel()
            index = (start + (r + i) * ANGLES + (t + j) % ANGLES).ravel()
            count += np.bincount(index, share, BLOCKS * bins)
            total += np.bincount(index, share * power.ravel(), BLOCKS * bins)
    count, total = count.reshape(BLOCKS, bins), total.reshape(BLOCKS, bins)
    square = np.bincount(spectra.block, (power**2).sum(1), BLOCKS)
    kept = np.concatenate([np.ones((1, BLOCKS)), 1 - np.eye(BLOCKS)])
    explained = ((kept @ total) ** 2 / np.maximum(kept @ count, 1e-9)).sum(1)
    return -np.log(np.maximum(kept @ square - explained, 1e-12) / (kept @ count.sum(1)))
