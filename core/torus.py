"""Arithmetic of tileable maps: everything here wraps in both axes."""

import numpy as np
import torch

WRAP_GATE = 1.6


def wrap_ratio(pixels: np.ndarray) -> float:
    """How much the step across the border stands out from the steps inside, worst of both axes.

    pixels (H, W) or (H, W, C), any range. A line's step is the mean absolute difference to the next line; the ratio is
    the step from the last line to the first over the 98th percentile of the interior ones. At most `WRAP_GATE` tiles
    without a seam. A percentile, not a mean: in bricks the border may well fall on a joint. 0 for a constant map.
    """
    ratios = []
    for axis in (0, 1):
        lines = np.moveaxis(np.asarray(pixels, np.float32), axis, 0)
        steps = np.array([np.abs(lines[i] - lines[i - 1]).mean() for i in range(len(lines))])
        interior = np.percentile(steps[1:], 98) if len(steps) > 1 else 0.0
        ratios.append(0.0 if steps[0] == 0 else float(steps[0] / max(interior, 1e-9)))
    return max(ratios)


def frequencies(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Angular frequencies (radians per pixel) of the rows (H, 1) and columns (1, W//2+1) of `torch.fft.rfft2`."""
    v = torch.fft.fftfreq(height)[:, None] * (2 * torch.pi)
    u = torch.fft.rfftfreq(width)[None, :] * (2 * torch.pi)
    return v, u


def blur(x: torch.Tensor, sigma: float) -> torch.Tensor:
    """Gaussian blur of (..., H, W) float32 by sigma pixels on the torus."""
    v, u = frequencies(*x.shape[-2:])
    return torch.fft.irfft2(torch.fft.rfft2(x) * torch.exp(-0.5 * sigma**2 * (u**2 + v**2)), s=x.shape[-2:])


def gradient(height: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Central differences (d/dx, d/drow) of (H, W) per pixel, wrapping."""
    dx = (height.roll(-1, 1) - height.roll(1, 1)) / 2
    dy = (height.roll(-1, 0) - height.roll(1, 0)) / 2
    return dx, dy


def integrate(dx: torch.Tensor, dy: torch.Tensor) -> torch.Tensor:
    """The height (H, W), mean 0, whose central differences are nearest to (dx, dy) in least squares.

    Frankot and Chellappa 1988 on the torus, with the transfer function of `gradient`, so that
    `gradient(integrate(*gradient(h)))` gives `gradient(h)` back.
    """
    v, u = frequencies(*dx.shape)
    su, sv = torch.sin(u), torch.sin(v)
    power = su**2 + sv**2
    # the frequencies that central differences cannot see (mean and Nyquist) stay zero
    seen = power > 1e-6
    spectrum = -1j * (su * torch.fft.rfft2(dx) + sv * torch.fft.rfft2(dy)) / torch.where(seen, power, 1.0)
    return torch.fft.irfft2(torch.where(seen, spectrum, 0), s=dx.shape)


def normal_from_height(height: torch.Tensor) -> torch.Tensor:
    """Unit normals (H, W, 3), +Y up, of a height (H, W) in units of the tile's width."""
    dx, dy = gradient(height * height.shape[1])
    # rows count downwards, +Y points up
    normal = torch.stack([-dx, dy, torch.ones_like(dx)], -1)
    return normal / normal.norm(dim=-1, keepdim=True)
