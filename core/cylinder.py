"""A region of a round surface, a column, a pipe, a trunk: found by its texture, and unrolled.

Claim: seen from afar, a cylinder of radius r about an axis in the image compresses its texture across the axis by
sqrt(1 - t^2), t being the distance from the axis over r, and not along it. Of all axes and radii the surface's are
those under which the texture's local spectra agree best, as `texture_gradient` scores planes; unrolled, s = r asin t,
every part has one scale.

Source: Super and Bovik 1995 (shape of curved surfaces from local spectra).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from .texture_gradient import AXIS, BLOCKS, Spectra, gradient_scores, spectra_scores

DIRECTIONS = 8  # of the axis that are tried first
MIDDLES, REACHES = (-0.5, 0.0, 0.5), (0.6, 0.9)  # in halves of the region; of the farthest window's middle
MOST_REACH = 0.985
NARROWEST = 1e-6  # of the focal length: radius
LEAST_GAIN = 0.025  # of the score over the best plane's, whatever part of the region is left out; flat ones reach 0.011
LEAST_SEEN = 0.5  # of the radius, on each side of the axis
SAMPLES = 2  # per texel and axis


@dataclass
class Cylinder:
    """across (2,): unit, image direction at right angles to the axis; middle: the axis' place along it; radius.

    In px of the photo from the photo's px (0, 0), or in any other unit of the image.
    """

    across: np.ndarray
    middle: float
    radius: float

    def unrolled(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 2) of the image on the surface laid flat, at the image's scale and orientation at the axis."""
        t = np.clip((points @ self.across - self.middle) / self.radius, -1, 1)
        return points + np.outer(self.middle + self.radius * np.arcsin(t) - points @ self.across, self.across)

    def rolled(self, points: np.ndarray) -> np.ndarray:
        """The inverse of `unrolled`."""
        angle = np.clip((points @ self.across - self.middle) / self.radius, -np.pi / 2, np.pi / 2)
        return points + np.outer(self.middle + self.radius * np.sin(angle) - points @ self.across, self.across)

    def density(self, points: np.ndarray) -> np.ndarray:
        """(n,) px of the image per px of the surface across the axis, 0 beyond the outline."""
        t = (points @ self.across - self.middle) / self.radius
        return np.sqrt(np.maximum(1 - t * t, 0))


def cylinder_maps(cylinder: Cylinder, at: np.ndarray) -> np.ndarray:
    """(n, 2, 2) derivatives of the image point by the surface's coordinates, one row per coordinate."""
    across = cylinder.density(at)[:, None] * cylinder.across
    along = np.broadcast_to([-cylinder.across[1], cylinder.across[0]], across.shape)
    return np.stack([across, along], 1)


def find_cylinder(spectra: Spectra, plane: np.ndarray) -> tuple[Cylinder | None, float]:
    """The cylinder under which the spectra agree clearly better than under any plane, in units of `spectra.at`; None
    where there is none. And the least gain of its score with a part left out. plane (1 + BLOCKS,): the best plane's."""

    def score(p: tuple) -> np.ndarray:
        cylinder = placed(*p)
        if cylinder.radius < NARROWEST:  # all windows lie in one line along the axis
            return np.full(1 + BLOCKS, -np.inf)
        return spectra_scores(spectra, cylinder_maps(cylinder, spectra.at))

    def placed(angle: float, offset: float, reach: float) -> Cylinder:
        across = np.array([np.cos(angle), np.sin(angle)])
        along = spectra.at @ across
        half = np.ptp(along) / 2
        return Cylinder(across, along.min() + half * (1 + offset), half * (1 + abs(offset)) / reach)

    starts = [(i * np.pi / DIRECTIONS, m, r) for i in range(DIRECTIONS) for m in MIDDLES for r in REACHES]
    values = [score(p)[0] for p in starts]
    best, value = starts[int(np.argmax(values))], max(values)
    for step in (1.0, 0.5, 0.25):
        for k, width in enumerate((np.pi / DIRECTIONS / 2, 0.25, 0.15)):
            for sign in (-1, 1):
                p = list(best)
                p[k] += sign * step * width
                p[2] = min(p[2], MOST_REACH)
                found = score(tuple(p))[0]
                if found > value:
                    best, value = tuple(p), found
    gain, cylinder = float((score(best) - plane).min()), placed(*best)
    return (cylinder if gain > LEAST_GAIN and _round_on_both_sides(spectra, cylinder) else None), gain


def _round_on_both_sides(spectra: Spectra, cylinder: Cylinder) -> bool:
    """Whether the texture of each side of the axis tells the cylinder by itself: a flat region whose texture changes
    towards one edge is best explained by an axis along the other."""
    t = (spectra.at @ cylinder.across - cylinder.middle) / cylinder.radius
    for side in (t < 0, t >= 0):
        if np.abs(t[side]).max(initial=0) < LEAST_SEEN:
            return False
        at, power, frequency = spectra.at[side], spectra.power[side], spectra.frequency[side]
        part = Spectra(at, power, frequency, np.arange(len(at)) % BLOCKS)
        if spectra_scores(part, cylinder_maps(cylinder, at))[0] <= gradient_scores(part, AXIS)[0]:
            return False
    return True


def unroll(pixels: np.ndarray, mask: np.ndarray, cylinder: Cylinder, share: float, largest: int):
    """Pixels, mask and the affine map (2, 3) from their px to the surface, of a region that is laid flat.

    As for planes, of all texel sizes the one at which the photo has the most texels of its own; what is seen more
    obliquely than `share` of that is left out. largest: px of a side at most, of which the middle is kept.
    """
    y, x = np.nonzero(mask)
    points = np.stack([x, y], -1)[:: max(1, len(x) // 50_000)].astype(float)
    density = np.sort(cylinder.density(points))[::-1]
    density = density[density > 0.05]
    scale = float(density[(np.cumsum(1 / density) * density**2).argmax()])
    kept = cylinder.unrolled(points[cylinder.density(points) >= share * scale])
    low, high = kept.min(0), kept.max(0)
    side = np.minimum(np.ceil((high - low) * scale).astype(int) + 1, largest)
    low = (low + high - (side - 1) / scale) / 2
    w, h = side

    def photo_px(step: int) -> np.ndarray:
        u, v = np.meshgrid(np.arange(w * step), np.arange(h * step))
        flat = (np.stack([u.ravel(), v.ravel()], -1) + 0.5) / step - 0.5
        return cylinder.rolled(flat / scale + low).astype(np.float32)

    at = photo_px(SAMPLES).reshape(h * SAMPLES, w * SAMPLES, 2)
    fine = cv2.remap(pixels, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    at = photo_px(1)
    column, row = np.rint(at).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    within = inside & (cylinder.density(at) >= share * scale)
    within[within] = mask[row[within], column[within]]
    # cubic interpolation oversteps: beyond white no camera sees
    flat = np.clip(cv2.resize(fine, (int(w), int(h)), interpolation=cv2.INTER_AREA), 0, pixels.max())
    return flat, within.reshape(h, w), np.column_stack([np.eye(2) / scale, low])
