"""The plane of a region from straight lines: courses, joints, boards and edges that run in two orthogonal directions.

Claim: three segments fix a candidate. Two give a vanishing point v1, the third the v2 orthogonal to it; the plane's
normal is v1 x v2. The candidate that explains most of the region's line length (RANSAC) is refined by least squares,
whose covariance says how well the lines fix it. The photo's focal length is found in the same way from all its lines,
with the third direction v1 x v2 taking part: only with the right focal length are the three orthogonal.

Sources: Coughlan and Yuille 1999 (orthogonal scenes), Bazin and Pollefeys 2012 (three lines fix the frame),
Grompone von Gioi et al. 2010 (LSD, the detector of segments).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from .texture_gradient import local_maps

LARGEST_SIDE = 1200  # px: the photo is looked at no larger
MOST_LINES = 600
BINS = 90  # of directions, over 180 degrees
LEAST_LENGTH = 0.012  # of the photo's diagonal
ENDPOINT = 0.7  # px: error of a segment's ends
DRIFT = np.radians(0.6)  # what a straight course or board deviates by
CANDIDATES = 1500
LEAST_FACING = 0.08  # cosine between a plane's normal and the ray to any of its segments, about
FOCALS = np.geomspace(0.55, 2.4, 13)  # in longer sides of the photo: 85 to 24 degrees


@dataclass
class Segments:
    """Straight segments: ends (n, 2, 2) in photo px, x and y. Longest first."""

    ends: np.ndarray

    def within(self, mask: np.ndarray) -> "Segments":
        """Those of which five points in a row lie in the mask (H, W) bool."""
        if not len(self.ends):
            return self
        t = np.linspace(0, 1, 5)[:, None, None]
        points = np.rint(self.ends[:, 0] * (1 - t) + self.ends[:, 1] * t).astype(int)
        x, y = (points[..., i].clip(0, mask.shape[1 - i] - 1) for i in (0, 1))
        return Segments(self.ends[mask[y, x].all(0)])


@dataclass
class Frame:
    """Directions that lines follow: axes (3, 3) rows orthonormal, camera coordinates (x right, y down, z forward).

    share: of the line length that rows 0 and 1 explain (and row 2 where all_three); balance: the second largest
    share of one row; error: standard deviation of the plane's normal in degrees, from the least squares; focal in px.
    """

    axes: np.ndarray
    share: float
    balance: float
    error: float
    count: int
    focal: float


def find_segments(grey: np.ndarray) -> Segments:
    """Segments of a picture (H, W) float32, perceptually encoded, 0 to 1."""
    scale = min(1.0, LARGEST_SIDE / max(grey.shape))
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    lines = cv2.createLineSegmentDetector().detect(np.rint(small.clip(0, 1) * 255).astype(np.uint8))[0]
    if lines is None:
        return Segments(np.zeros((0, 2, 2)))
    ends = (lines.reshape(-1, 2, 2).astype(float) + 0.5) / scale - 0.5
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    keep = length >= LEAST_LENGTH * np.hypot(*grey.shape)
    ends, length = ends[keep], length[keep]
    return Segments(ends[np.argsort(-length, kind="stable")[:MOST_LINES]])


def _rays(ends: np.ndarray, focal: float, centre: tuple[float, float]):
    """Of segments: middles (n, 2) and unit directions (n, 2), interpretation planes (n, 3), tolerances (n,) rad."""
    p = (ends - np.asarray(centre)) / focal
    step = p[:, 1] - p[:, 0]
    length = np.linalg.norm(step, axis=1)
    h = np.concatenate([p, np.ones(p.shape[:2] + (1,))], -1)
    planes = np.cross(h[:, 0], h[:, 1])
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    tolerance = np.hypot(DRIFT, ENDPOINT * 2 / (length * focal))
    return p.mean(1), step / length[:, None], planes, tolerance, length


def _misfit(directions: np.ndarray, middle: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """(k, n) sine of the angle between segments and the lines from their middles to the vanishing points (k, 3)."""
    to = directions[:, None, :2] - directions[:, None, 2:] * middle
    across = to[..., 0] * unit[:, 1] - to[..., 1] * unit[:, 0]
    return across / np.maximum(np.linalg.norm(to, axis=-1), 1e-9)


def find_frame(
    segments: Segments, focal: float, centre: tuple[float, float], all_three: bool = False, seed: int = 0
) -> Frame | None:
    """The two (or three) orthogonal directions that explain most of the segments, None with too few of them."""
    ends = segments.ends
    if len(ends) < 12:
        return None
    middle, unit, planes, tolerance, length = _rays(ends, focal, centre)
    # many short pieces of one joint count as much as the joint found whole
    weight = length / length.sum()
    random = np.random.default_rng(seed)
    pick = random.choice(len(ends), (CANDIDATES, 3), p=np.sqrt(weight) / np.sqrt(weight).sum())
    v1 = np.cross(planes[pick[:, 0]], planes[pick[:, 1]])
    v2 = np.cross(v1, planes[pick[:, 2]])
    n1, n2 = np.linalg.norm(v1, axis=1), np.linalg.norm(v2, axis=1)
    good = (n1 > 0.02) & (n2 > 0.3 * n1)
    v1, v2 = v1[good] / n1[good, None], v2[good] / n2[good, None]
    if not all_three:
        good = _in_front(np.cross(v1, v2), middle)
        v1, v2 = v1[good], v2[good]
    if not len(v1):
        return None
    fits = np.stack([_fit(v, middle, unit, tolerance) for v in (v1, v2)])  # (2, k, n)
    if all_three:
        third = np.cross(v1, v2)
        fits = np.concatenate([fits, _fit(third, middle, unit, tolerance)[None]])
    shares = fits @ weight
    score = fits.max(0) @ weight - 0.3 * np.maximum(0, 0.15 - shares[:2].min(0))
    best = int(score.argmax())
    axes = np.stack([v1[best], v2[best], np.cross(v1[best], v2[best])])
    axes, error = _refine(axes, middle, unit, tolerance, weight, 3 if all_three else 2)
    fits = np.stack([_fit(v[None], middle, unit, tolerance)[0] for v in axes[: 3 if all_three else 2]])
    shares = fits @ weight
    belongs = fits.argmax(0)
    balance = sorted(float((fit * (belongs == i)) @ weight) for i, fit in enumerate(fits))[-2]
    return Frame(axes, float(fits.max(0) @ weight), balance, error, int((fits.max(0) > 0.5).sum()), focal)


def _in_front(normals: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """(k,) bool: the planes (k, 3) whose horizon lies well outside of all middles."""
    depth = normals[:, :2] @ middle.T + normals[:, 2:]
    return (np.abs(depth.sum(1)) / np.abs(depth).sum(1) > 0.999) & (np.abs(depth).min(1) > LEAST_FACING)


def _fit(directions, middle, unit, tolerance):
    return np.exp(-0.5 * (_misfit(directions, middle, unit) / tolerance) ** 2)


def _refine(axes, middle, unit, tolerance, weight, count):
    """Gauss-Newton over the rotation of the axes on the segments that fit; the error of axis 2 in degrees."""
    error = 90.0
    for _ in range(6):
        residual = _misfit(axes[:count], middle, unit) / tolerance
        belongs = np.abs(residual).argmin(0)
        mine = np.arange(len(belongs))
        r = residual[belongs, mine]
        w = np.where(np.abs(r) < 3, 1 / (1 + r * r), 0)
        columns = []
        for i in range(3):
            turned = axes @ _rotation(1e-5 * np.eye(3)[i]).T
            columns.append(((_misfit(turned[:count], middle, unit) / tolerance)[belongs, mine] - r) / 1e-5)
        jacobian = np.stack(columns, 1)
        normal = jacobian.T @ (jacobian * w[:, None]) + 1e-6 * np.eye(3)
        step = -np.linalg.solve(normal, jacobian.T @ (w * r))
        size = np.linalg.norm(step)
        axes = axes @ _rotation(step * min(1, 0.1 / max(size, 1e-12))).T
        spread = max(1.0, float((w * r * r).sum() / max(w.sum(), 1e-9)))
        covariance = np.linalg.inv(normal) * spread
        across = axes[:2]  # turning about these moves axis 2
        error = float(np.degrees(np.sqrt(np.trace(across @ covariance @ across.T))))
    return axes, error


def _rotation(vector: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(np.asarray(vector, float))[0]


def find_focal(segments: Segments, shape: tuple[int, int], seed: int = 0) -> float | None:
    """The focal length in px at which the photo's lines best follow three orthogonal directions, None if undecided."""
    h, w = shape
    centre = ((w - 1) / 2, (h - 1) / 2)
    few = Segments(segments.ends[:250])
    found = []
    for share in FOCALS:
        frame = find_frame(few, share * max(h, w), centre, all_three=True, seed=seed)
        if frame is None:
            return None
        found.append(frame.share)
    found = np.array(found)
    best = int(found.argmax())
    # a focal length is seen when the ends of the range explain clearly less
    if found[best] < 0.5 or min(found[best] - found[0], found[best] - found[-1]) < 0.06 or best in (0, len(found) - 1):
        return None
    a, b, c = found[best - 1 : best + 2]
    shift = 0.5 * (a - c) / min(a - 2 * b + c, -1e-9)
    return float(max(h, w) * FOCALS[0] * (FOCALS[1] / FOCALS[0]) ** (best + np.clip(shift, -1, 1)))


def line_score(segments: Segments, normal: np.ndarray, focal: float, centre: tuple[float, float]) -> float:
    """How much better than at random the segments' directions are told by few directions in a plane, nats per line.

    The mean log density of the directions in the image, when those in the plane of a normal (3,) follow their own
    histogram, over 180 degrees, or over 90 where lines cross at right angles.
    """
    if len(segments.ends) < 8:
        return 0.0
    middle, unit, _, _, length = _rays(segments.ends, focal, centre)
    weight = length / length.sum()
    a = local_maps(normal, middle)
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    right = (unit[:, 0] * a[:, 1, 1] - unit[:, 1] * a[:, 1, 0]) / det
    down = (unit[:, 1] * a[:, 0, 0] - unit[:, 0] * a[:, 0, 1]) / det
    angle = np.arctan2(down, right) * (BINS / np.pi)
    # a turn in the image is a turn in the plane by so much
    magnified = 1 / (np.abs(det) * (right**2 + down**2))
    found = []
    for bins, penalty in ((BINS, 0.1), (BINS // 2, 0.0)):
        at = angle % bins
        first, part = np.floor(at).astype(int), at % 1
        histogram = np.bincount(first % bins, weight * (1 - part), bins)
        histogram += np.bincount((first + 1) % bins, weight * part, bins)
        histogram = (np.roll(histogram, 1) + 2 * histogram + np.roll(histogram, -1)) / 4
        density = (histogram[first % bins] * (1 - part) + histogram[(first + 1) % bins] * part) * bins
        found.append(float(weight @ np.log((0.9 * density + 0.1) * magnified)) - penalty)
    return max(found)
