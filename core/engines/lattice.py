"""Regular structure of an exemplar: the periods of courses, tiles and weaves along the rows and the columns.

Claim: where the masked autocorrelation, sampled at the multiples of a period, stands out from halfway between them, the
texture repeats with that period. Kaspar et al. 2015 guide synthesis by such peaks; Padfield 2012 gives the masked form.
"""

import cv2
import numpy as np

LONGEST_SIDE = 512  # px: the exemplar is looked at no larger
LEAST_PERIOD = 6.0  # px of that picture
LEAST_MULTIPLES = 3  # seen, to call it a period
MULTIPLES = 6
LEAST_CONTRAST = 0.12  # of the correlation, between the multiples and halfway
LEAST_PEAK = 0.15  # correlation at the period itself
DETAIL = 0.15  # sigma of what is no detail, in sides of the picture


def find_periods(pixels: np.ndarray, mask: np.ndarray) -> tuple[float | None, float | None]:
    """Period along the rows' axis (downwards) and along the columns' (to the right) in px, None where there is none.

    pixels (h, w, 3) float32, perceptually encoded; mask (h, w) bool.
    """
    scale = min(1.0, LONGEST_SIDE / max(mask.shape))
    size = max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale))
    weight = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    grey = cv2.resize(np.where(mask, pixels.mean(-1), 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    sigma = max(2.0, DETAIL * np.sqrt(weight.sum()))
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    share = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    detail = grey - weight * smooth / np.maximum(share, 1e-6)
    correlation = _autocorrelation(detail - weight * detail.sum() / max(weight.sum(), 1e-6), weight)
    return tuple(p / scale if p else None for p in (_period(correlation[:, 0]), _period(correlation[0])))


def _autocorrelation(detail: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(h, w) correlation at shifts down and to the right, 1 at none; 0 where too little of the mask overlaps."""
    h, w = weight.shape
    shape = 2 * h, 2 * w

    def correlate(x):
        spectrum = np.fft.rfft2(x, shape)
        return np.fft.irfft2(np.abs(spectrum) ** 2, shape)[:h, :w]

    overlap = correlate(weight)
    variance = (detail**2).sum() / max(weight.sum(), 1e-6)
    mean = correlate(detail) / np.maximum(overlap, 1.0)
    return np.where(overlap > 0.15 * weight.sum(), mean / max(variance, 1e-12), 0.0)


def _period(correlation: np.ndarray) -> float | None:
    """The period whose multiples stand out most in the correlation at shifts 0, 1, 2 .. px, or None."""
    reach = int(np.argmin(correlation != 0)) or len(correlation)
    shifts = np.arange(reach)

    def at(shift):
        return np.interp(shift, shifts, correlation[:reach])

    def contrast(period):
        multiples = np.arange(1, min(MULTIPLES, int((reach - 1) / period)) + 1)
        return (at(multiples * period) - at((multiples - 0.5) * period)).mean()

    candidates = np.arange(LEAST_PERIOD, (reach - 1) / LEAST_MULTIPLES, 0.125)
    if not len(candidates):
        return None
    contrasts = np.array([contrast(period) for period in candidates])
    best = contrasts.max()
    if best < LEAST_CONTRAST:
        return None
    # multiples of a period repeat too: the shortest that is nearly as good is the period
    # a peak at the end of the range is the slope of one further out
    for period in candidates[(contrasts > 0.8 * best) & (candidates < candidates[-1] - 2)]:
        near = candidates[np.abs(candidates - period) < 2]
        period = near[[contrast(p) for p in near].index(max(contrast(p) for p in near))]
        if at(period) < LEAST_PEAK:
            continue
        # a running bond: every second course agrees better
        doubled = 2 * period < reach and at(2 * period) > at(period) + 0.15 and contrast(2 * period) >= LEAST_CONTRAST
        return float(2 * period if doubled else period)
    return None
