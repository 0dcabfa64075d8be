"""Arithmetic of tileable maps: everything here wraps in both axes."""

import cv2
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


def close_seam(pixels: torch.Tensor, reach: float = 8.0) -> torch.Tensor:
    """Pixels (H, W, C) with the steps across the border made as large as the steps beside them.

    Screened Poisson equation on the torus, solved by Fourier transform: the picture whose gradient is nearest to the
    given one, but for the steps across the border, which become the mean of the two beside them; with a pull towards
    the given values, so that the change falls by e every `reach` px (Perez et al. 2003, Bhat et al. 2008).
    """
    x = pixels.permute(2, 0, 1)
    screen = reach**-2
    v, u = frequencies(*x.shape[1:])
    # forward differences on the torus, and the negative of their own divergence
    steps = [x.roll(-1, axis) - x for axis in (1, 2)]
    steps[0][:, -1] = (steps[0][:, -2] + steps[0][:, 0]) / 2
    steps[1][:, :, -1] = (steps[1][:, :, -2] + steps[1][:, :, 0]) / 2
    divergence = sum(step - step.roll(1, axis) for step, axis in zip(steps, (1, 2), strict=True))
    power = (2 - 2 * torch.cos(u)) + (2 - 2 * torch.cos(v))
    spectrum = torch.fft.rfft2(screen * x - divergence) / (screen + power)
    return torch.fft.irfft2(spectrum, s=x.shape[1:]).permute(1, 2, 0)


def resize(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixels (h, w, C) float32 at another size (H, W), wrapping: bicubic, after a blur where they get fewer."""
    h, w = pixels.shape[:2]
    if size == (h, w):
        return pixels
    shrink = max(h / size[0], w / size[1])
    if shrink > 1:
        blurred = blur(torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))), 0.5 * (shrink**2 - 1) ** 0.5)
        pixels = np.ascontiguousarray(blurred.permute(1, 2, 0).numpy())
    rows, columns = (((np.arange(n) + 0.5) * m / n - 0.5).astype(np.float32) for n, m in zip(size, (h, w), strict=True))
    x, y = np.meshgrid(columns, rows)
    return cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
