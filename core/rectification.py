"""Rectification: a region of a slanted plane, resampled as if the camera had faced it.

The plane comes from the user's four corners, from a camera and an object, or is found: of the three planes that the
lines of the whole photo follow, since what people build stands in one frame, the one under which the texture's local
spectra agree (`texture_gradient`); where none of them will do, of all planes the one under which the spectra agree and
the region's own lines run in few directions (`vanishing`). Where the spectra agree better on a round surface, that is
unrolled (`cylinder`). Where nothing says enough, the region stays as it is, but turned so that its lines lie along rows
and columns.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from .cylinder import Cylinder, find_cylinder, unroll
from .errors import PaletteError
from .exemplar import LARGEST, LUMINANCE, white
from .image import srgb_from_linear
from .texture_gradient import AXIS, Spectra, gradient_scores, local_spectra, plane_axes
from .vanishing import Frame, Segments, find_focal, find_frame, find_segments, line_score

MODES = ("off", "auto", "quad")
DEFAULT_FOCAL = 1.0  # in longer sides of the photo: 53 degrees, between a telephone's camera and a normal lens
LOOKED_AT = 512  # px: side of the square with the region's area when its plane is sought
LEAST_GAIN, LEAST_MARGIN, POOR_MARGIN, MARGIN_SHARE = 0.04, 0.05, 0.15, 0.25  # of the score, see `_confidence`
MOST_SPREAD, FAR = 5.0, 20.0  # degrees
LEAST_SLANT = 10.0  # degrees: below it the region stays as it is
PART = 0.3, 0.9  # of a region: a largest part of this share may lie on a plane of its own
LEAST_TURN = 1.0  # degrees: by less no region that is seen from the front is turned
STRAIGHT, LEAST_STRAIGHT = 3.0, 0.5  # degrees, and share of its lines' length that lies along rows or columns so nearly
# lines that tell a plane by themselves: how many, off by how many degrees at most; the share of their length that is so
# straight on the plane, how much more that is than from the front, and the least of it across the others
LEAST_SQUARED, SQUARE, LEAST_SQUARE, MORE_SQUARE, LEAST_ACROSS = 20, 1.5, 0.7, 0.3, 0.04
LEAST_FACING = 0.14  # cosine of the angle at which a plane is seen in the middle of its region: 82 degrees
LINES_WEIGHT = 0.3  # of the lines' score, when there are ENOUGH_LINES
ENOUGH_LINES = 100
ENOUGH_WINDOWS = 20  # to tell any plane; a plane of the photo's frame needs no more than make spectra
# of the photo's frame: share of the length of its longest lines that follow it, and its second direction, without which
# it may lie anyhow around the first; gain of one of its planes over the front with any part of the region left out, and
# over its other planes
LONGEST_LINES, LEAST_FOLLOWED, LEAST_SECOND = 250, 0.5, 0.06
LEAST_FRAMED, LEAST_AHEAD = 0.03, 0.03
AGAINST = 1.5  # times the evidence for a plane that lies FAR from all of the photo's frame
CLEARER = 4.0  # times the gain of the frame's plane, from which on another one is believed, if it is certain
LEAST_CONFIDENCE = 0.5
SUSPECTED = 0.05  # confidence from which on a slant that was not told for certain is worth a warning
# of a texel's density in the photo, in the worst direction
SHARE_BENT = 0.5  # of the exemplar's, below which a part of a column is seen too obliquely
SHARPNESS = 2.0  # a plane's texel counts by this power
FINEST = 1.4  # times what is chosen then, a texel's own
SHARE, LEAST_SHARE = 0.7, 0.35  # of what is chosen then, below which a part is seen too obliquely
ENOUGH = 160 * 160  # px of the photo that are learnt from, where LEAST_SHARE allows
MOST_SAMPLES = 4  # per texel and axis
DARKEST = 1e-3


@dataclass
class View:
    """What a photo tells about its camera: focal length in px, whether it is known, the straight segments, and the
    frame that these follow, where they do."""

    focal: float
    known: bool
    segments: Segments
    frame: Frame | None = None


@dataclass
class Rectification:
    """A region ready to be cut.

    pixels (h, w, 3) float32 linear and mask (h, w) bool; homography (3, 3): from its px to the photo's px, None where
    the region was left as it is or unrolled: then cylinder is in photo px, and to_surface (2, 3) goes from its px to
    the surface laid flat; method: "off", "turned", "corners", "auto", "plane" or "cylinder"; normal (3,): unit, towards
    the camera, camera coordinates (x right, y down, z forward), None when not known; slant in degrees between it and
    the optical axis; confidence 0 to 1; level as `cut_exemplar` takes it.
    """

    pixels: np.ndarray
    mask: np.ndarray
    homography: np.ndarray | None = None
    method: str = "off"
    normal: np.ndarray | None = None
    confidence: float = 0.0
    warnings: list[str] = field(default_factory=list)
    cylinder: Cylinder | None = None
    to_surface: np.ndarray | None = None
    level: float = 1.0

    @property
    def slant(self) -> float | None:
        return None if self.normal is None else float(np.degrees(np.arccos(np.clip(-self.normal[2], -1, 1))))

    def record(self) -> dict:
        """What palette.json holds of it."""
        record = {"method": self.method, "confidence": round(self.confidence, 3)}
        if self.normal is not None:
            record |= {"slant_degrees": round(self.slant, 2), "normal": [round(float(n), 5) for n in self.normal]}
        if self.homography is not None:
            record["homography"] = [[float(f"{v:.9g}") for v in row] for row in self.homography]
        if self.cylinder is not None:
            across, middle, radius = self.cylinder.across, self.cylinder.middle, self.cylinder.radius
            record["cylinder"] = {
                "across": [round(float(v), 5) for v in across],
                "middle_px": round(float(middle), 2),
                "radius_px": round(float(radius), 2),
            }
        return record


@dataclass
class PlaneEstimate:
    """normal (3,): unit, away from the camera; confidence 0 to 1; evidence as `_confidence` takes it; the spectra."""

    normal: np.ndarray
    confidence: float
    evidence: dict[str, float]
    spectra: Spectra | None = None

    @property
    def slant(self) -> float:
        return _between(self.normal, AXIS)


def look(pixels: np.ndarray, focal: float | None = None) -> View:
    """Find a photo's segments, their frame and, unless it is given in px, its focal length. pixels (H, W, 3) linear."""
    segments, shape = find_segments(srgb_from_linear(np.clip(pixels @ LUMINANCE, 0, 1))), pixels.shape[:2]
    known = focal or find_focal(segments, shape)
    focal = float(known or DEFAULT_FOCAL * max(shape))
    frame = find_frame(Segments(segments.ends[:LONGEST_LINES]), focal, _principal_point(shape), all_three=True)
    sure = frame is not None and frame.share >= LEAST_FOLLOWED and frame.balance >= LEAST_SECOND
    return View(focal, known is not None, segments, frame if sure else None)


def rectify_corners(
    pixels: np.ndarray, mask: np.ndarray, corners: np.ndarray, focal: float | None = None
) -> Rectification:
    """Rectify a region of a photo by four points of a rectangle on its surface.

    pixels (H, W, 3) float32 linear; mask (H, W) bool; corners (4, 2): photo px (x, y), clockwise as seen, beginning
    with the top left one; focal in px where it is known. Raises PaletteError for corners that are no view of a
    rectangle and when nothing of the region is left.
    """
    to_photo, normal = plane_of_corners(corners, pixels.shape[:2], focal)
    return resample(pixels, mask, to_photo, "corners", normal)


def rectify(pixels: np.ndarray, mask: np.ndarray, view: View) -> Rectification:
    """Rectify a region of a photo by the plane that is found, if it is.

    pixels (H, W, 3) float32 linear; mask (H, W) bool with at least one pixel; view as `look` finds it. Where texture
    and frame tell no plane for certain, that is taken on which the region's lines become rows and columns. What is seen
    from the front, or on no certain plane, is turned so that its lines lie along rows and columns, otherwise as it is,
    with a warning where much speaks for a slant. Of a region that falls apart the largest part is taken where that lies
    on a plane on which not all does.
    """
    estimate, mask, warnings = _plane_of_most(pixels, mask, view)
    squared = None if _claimed(estimate) else _squared(mask, view)
    if squared is not None:
        return _flat(pixels, mask, squared, view, warnings)
    bent = _find_cylinder(estimate, view, mask.shape) if estimate is not None else None
    if bent is not None:
        flat, within, to_surface = unroll(pixels, mask, bent, SHARE_BENT, LARGEST)
        return Rectification(flat, within, method="cylinder", cylinder=bent, to_surface=to_surface)
    if estimate is not None and estimate.slant < LEAST_SLANT:
        seen = Rectification(pixels, mask, normal=-estimate.normal, confidence=estimate.confidence)
        return _turned(seen, view.segments)
    if estimate is None or estimate.confidence < LEAST_CONFIDENCE:
        confidence = estimate.confidence if estimate else 0.0
        warning = "the slant of the region could not be told for certain; it is used as the photo shows it"
        warnings = [warning] if confidence >= SUSPECTED else []
        return _turned(Rectification(pixels, mask, confidence=confidence, warnings=warnings), view.segments)
    return _flat(pixels, mask, estimate, view, warnings)


def _flat(pixels, mask: np.ndarray, plane: PlaneEstimate, view: View, warnings: list[str]) -> Rectification:
    """A region brought to the front from a plane, its lines along rows and columns."""
    to_photo = plane_to_photo(plane.normal, view.focal, _principal_point(mask.shape), _centroid(mask))
    turn = _turn(view.segments.within(mask), to_photo)
    found = resample(pixels, mask, to_photo @ turn, "auto", -plane.normal, plane.confidence)
    return replace(found, warnings=warnings + found.warnings)


def _plane_of_most(
    pixels: np.ndarray, mask: np.ndarray, view: View
) -> tuple[PlaneEstimate | None, np.ndarray, list[str]]:
    """The plane of a region, what of it (H, W) bool lies on it, and what to say of the rest: walls on both sides
    of a street are one material on two planes."""
    whole, part = find_plane(pixels, mask, view), _largest_part(mask)
    if part is mask:
        return whole, mask, []
    own = find_plane(pixels, part, view)
    if not _claimed(own):
        return whole, mask, []
    if _same_plane(own, whole):
        rest = find_plane(pixels, mask & ~part, view)
        if not _claimed(rest) or _same_plane(own, rest):
            return whole, mask, []
    share = 1 - part.sum() / mask.sum()
    return own, part, [f"{share:.0%} of the region, apart from the rest and on another plane, is left out"]


def _largest_part(mask: np.ndarray) -> np.ndarray:
    """The largest connected part of a mask (H, W) bool; itself where that is nearly all of it or little of it."""
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    areas = sizes[1:, cv2.CC_STAT_AREA]
    least, most = PART
    return labels == 1 + areas.argmax() if least < areas.max() / areas.sum() < most else mask


def _claimed(estimate: PlaneEstimate | None) -> bool:
    return estimate is not None and estimate.confidence >= LEAST_CONFIDENCE and estimate.slant >= LEAST_SLANT


def _same_plane(known: PlaneEstimate, other: PlaneEstimate | None) -> bool:
    return _claimed(other) and _between(known.normal, other.normal) < FAR


def _find_cylinder(estimate: PlaneEstimate, view: View, shape: tuple[int, int]) -> Cylinder | None:
    """The cylinder, in photo px, that the texture of a region is on rather than on its best plane; None for a plane."""
    if estimate.spectra is None or _claimed(estimate):
        return None
    planes = np.max([gradient_scores(estimate.spectra, n) for n in (AXIS, estimate.normal)], 0)
    found, _ = find_cylinder(estimate.spectra, planes)
    if found is None:
        return None
    middle = _principal_point(shape) @ found.across + found.middle * view.focal
    return Cylinder(found.across, float(middle), found.radius * view.focal)


# ---------------------------------------------------------------- the plane


def plane_of_corners(
    corners: np.ndarray, shape: tuple[int, int], focal: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Homography (3, 3) from a plane, in units of the rectangle's width, to photo px, and the plane's normal (3,).

    corners (4, 2) as `rectify` takes them; shape (H, W) of the photo; focal in px, None: found from the corners where
    perspective shows, else DEFAULT_FOCAL. The rectangle's proportions follow from it (Zhang and He 2007).
    """
    corners = np.asarray(corners, np.float64)
    if corners.shape != (4, 2) or not np.isfinite(corners).all():
        raise PaletteError("a region's corners are four points x,y in photo px")
    sides = np.roll(corners, -1, 0) - corners
    turns = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    if turns.min() < 0.05 * np.abs(turns).max() or turns.min() < 4:
        raise PaletteError(
            "the corners are no view of a rectangle: give four points around it, clockwise from its top left corner"
        )
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    centre = _principal_point(shape)
    h = cv2.getPerspectiveTransform(square, (corners - centre).astype(np.float32)).astype(np.float64)
    longer = max(shape)
    if focal is None:
        focal = DEFAULT_FOCAL * longer
        both = h[2, 0] * h[2, 1]
        if abs(both) * longer**2 > 0.02 * abs(h[0, 0] * h[1, 1]) and both:
            squared = -(h[0, 0] * h[0, 1] + h[1, 0] * h[1, 1]) / both
            if (0.4 * longer) ** 2 < squared < (4 * longer) ** 2:
                focal = float(np.sqrt(squared))
    axes = h[:, :2] / [[focal], [focal], [1]]
    width, height = np.linalg.norm(axes, axis=0)
    h = h @ np.diag([1.0, width / height, 1.0])
    h[:2] += np.outer(centre, h[2])
    normal = np.cross(axes[:, 0], axes[:, 1])
    normal *= -np.sign(normal[2]) / np.linalg.norm(normal)
    return h, normal


def corners_on_plane(right: np.ndarray, up: np.ndarray, focal: float, mask: np.ndarray) -> np.ndarray:
    """Corners (4, 2) in photo px of a square on a surface, in the middle of a region, as `rectify_corners` takes them.

    right and up (3,): directions on the surface, camera coordinates (x right, y down, z forward); mask (H, W) bool;
    focal in px. Raises PaletteError for an empty region and a surface that is seen edge on or lies behind the camera.
    """
    if not mask.any():
        raise PaletteError("the region is empty; paint it first")
    centre, where = _principal_point(mask.shape), _centroid(mask)
    to_photo, normal = plane_of_camera(np.cross(right, up), focal, centre, where)
    axes = plane_axes(-normal)
    along = axes @ right / np.linalg.norm(right)
    along /= np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    # of the four turns of the square, the one that stands upright in the photo
    if abs(along[0]) < abs(along[1]):
        along, across = -across, along
    along, across = along * np.sign(along[0]), across * np.sign(along[0])
    density, _ = _density(np.linalg.inv(to_photo), np.array([where]))
    half = 0.25 * np.sqrt(mask.sum()) / density[0]
    for _ in range(20):
        square = np.array([-along - across, along - across, along + across, -along + across]) * half
        bottom = _denominator(to_photo, square)
        if bottom.min() > 0.3 * _denominator(to_photo, np.zeros((1, 2)))[0]:
            return _mapped(to_photo, square)
        half *= 0.7
    raise PaletteError("the surface is seen edge on; nothing of it can be rectified")


def plane_of_camera(
    normal: np.ndarray, focal: float, centre: tuple[float, float], where: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Homography (3, 3) from a plane to photo px, and its normal towards the camera, for `resample`.

    normal (3,): of the surface, either side, camera coordinates (x right, y down, z forward); focal and principal point
    (x, y) in photo px; where: the photo px (x, y) that becomes the plane's origin. Raises PaletteError for a plane that
    is seen edge on there.
    """
    normal = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    ray = np.append((np.asarray(where, float) - centre) / focal, 1.0)
    if abs(normal @ ray) < np.cos(np.radians(88)) * np.linalg.norm(ray):
        raise PaletteError("the surface is seen edge on; nothing of it can be rectified")
    normal = -normal * np.sign(normal @ ray)
    return plane_to_photo(-normal, focal, centre, where), normal


def plane_to_photo(normal: np.ndarray, focal: float, centre: tuple[float, float], where) -> np.ndarray:
    """Homography (3, 3) from a plane, its origin at the photo px `where`, to photo px.

    normal (3,): unit, away from the camera, camera coordinates; focal and principal point `centre` in photo px.
    """
    ray = np.append((np.asarray(where, float) - centre) / focal, 1.0)
    origin = ray / (normal @ ray)
    camera = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    return camera @ np.column_stack([*plane_axes(normal), origin])


def find_plane(pixels: np.ndarray, mask: np.ndarray, view: View) -> PlaneEstimate | None:
    """The plane of a region from its texture and lines; None where there is neither."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    scale = min(1.0, LOOKED_AT / float(mask.sum()) ** 0.5)
    size = max(1, round((box[1].stop - box[1].start) * scale)), max(1, round((box[0].stop - box[0].start) * scale))
    grey = cv2.resize(np.ascontiguousarray(pixels[box] @ LUMINANCE), size, interpolation=cv2.INTER_AREA)
    seen = mask[box] & (pixels[box] < white(pixels, mask)).any(-1)
    small = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    centre = np.array(_principal_point(mask.shape))
    own = ((centre - (box[1].start, box[0].start)) + 0.5) * scale - 0.5
    spectra = local_spectra(np.log(grey + DARKEST), small, view.focal * scale, tuple(own))
    if spectra is None:
        return None
    ray = np.append(spectra.at.mean(0), 1.0)
    ray /= np.linalg.norm(ray)
    framed = _framed(spectra, view.frame, ray)
    if len(spectra.at) < ENOUGH_WINDOWS:
        return framed
    inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    segments = view.segments.within(inside)
    enough = min(len(segments.ends), ENOUGH_LINES) / ENOUGH_LINES
    starts, frame = _starts(ray), find_frame(segments, view.focal, tuple(centre))
    if frame is not None:
        normal = frame.axes[2] * np.sign(frame.axes[2] @ ray)
        starts += [normal] if normal @ ray > LEAST_FACING else []

    def score(normal: np.ndarray) -> np.ndarray | None:
        scores = gradient_scores(spectra, normal) if normal @ ray > LEAST_FACING else None
        if scores is None:
            return None
        return scores + LINES_WEIGHT * enough * line_score(segments, normal, view.focal, tuple(centre))

    planes, scores = _search(score, starts)
    best = scores[:, 0].argmax()
    away = np.array([_between(planes[best], n) for n in planes])
    others = away[scores[:, 1:].argmax(0)]
    inverse_depth = spectra.at @ planes[best][:2] + planes[best][2]
    evidence = {
        "gain": float(scores[best, 0] - scores[0, 0]),
        "spread": float(np.sqrt((others**2).mean())),
        "margin": float(scores[best, 0] - scores[away > FAR, 0].max()) if (away > FAR).any() else 1.0,
        "agreement": float(scores[best, 0]),
        "range": float(np.log(inverse_depth).std()),
        "windows": len(spectra.at),
        "lines": len(segments.ends),
    }
    against = view.frame is not None and np.abs(view.frame.axes @ planes[best]).max() < np.cos(np.radians(FAR))
    confidence = _confidence(evidence, AGAINST if against else 1.0)
    free = PlaneEstimate(planes[best], confidence, evidence, spectra)
    if framed is None:
        return free
    clearer = free.confidence >= LEAST_CONFIDENCE and evidence["gain"] > CLEARER * framed.evidence["gain"]
    return free if clearer else framed


def _framed(spectra: Spectra, frame: Frame | None, ray: np.ndarray) -> PlaneEstimate | None:
    """Of a photo's frame the plane that explains the texture better than its others and, with any part of the region
    left out, better than the front; None where none does. ray (3,): to the middle of the region."""
    if frame is None:
        return None
    front, found = gradient_scores(spectra, AXIS), []
    for axis in frame.axes:
        normal = axis * np.sign(axis @ ray)
        scores = gradient_scores(spectra, normal) if normal @ ray > LEAST_FACING else None
        if scores is not None:
            found.append((float(scores[0] - front[0]), float((scores - front).min()), normal))
    found.sort(key=lambda plane: -plane[0])
    if not found or found[0][1] < LEAST_FRAMED or _between(found[0][2], AXIS) < LEAST_SLANT:
        return None
    gain, least, normal = found[0]
    margin = gain - found[1][0] if len(found) > 1 else 1.0
    if margin < LEAST_AHEAD:
        return None
    evidence = {"gain": gain, "least_gain": least, "margin": margin, "windows": len(spectra.at)}
    return PlaneEstimate(normal, _certainty(min(least / LEAST_FRAMED, margin / LEAST_AHEAD)), evidence, spectra)


def _certainty(times: float) -> float:
    """0.5 for evidence that just suffices, which is 1 times what is asked for."""
    return float(1 / (1 + np.exp(-3 * np.log(max(times, 1e-6)))))


def _confidence(evidence: dict[str, float], asked: float) -> float:
    """Of a slanted plane: 0.5 where the weakest of what speaks for it is `asked` times what just suffices.

    The plane has to explain more than the front does, clearly more than planes more than FAR degrees off, and with any
    part of the region left out it has to stay about the same. Where even the best plane explains little, the texture is
    not homogeneous and a difference counts for less. Thresholds chosen on training textures so that 1 in 100 is false.
    """
    margin = max(LEAST_MARGIN if evidence["agreement"] > 0 else POOR_MARGIN, MARGIN_SHARE * min(evidence["gain"], 0.4))
    weakest = min(
        evidence["gain"] / LEAST_GAIN, evidence["margin"] / margin, MOST_SPREAD / max(evidence["spread"], 0.1)
    )
    return _certainty(weakest / asked)


def _starts(ray: np.ndarray) -> list[np.ndarray]:
    """Normals about 14 degrees apart: that of the front, then in rings around a ray."""
    right, down = plane_axes(ray)
    found = [AXIS]
    for ring, (slant, count) in enumerate([(14, 8), (28, 12), (42, 14), (54, 16), (64, 16), (72, 16)]):
        for tilt in (np.arange(count) + 0.5 * (ring % 2)) * 2 * np.pi / count:
            c, s = np.cos(np.radians(slant)), np.sin(np.radians(slant))
            found.append(c * ray + s * (np.cos(tilt) * right + np.sin(tilt) * down))
    return found


def _search(score, starts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All planes tried (k, 3), the first start first, and their scores (k, s); the two best starts are refined."""
    planes, scores = [], []

    def tried(normal: np.ndarray) -> float:
        found = score(normal)
        if found is None:
            return -np.inf
        planes.append(normal)
        scores.append(found)
        return float(found[0])

    values = [tried(n) for n in starts]
    first = starts[int(np.argmax(values))]
    apart = [v if _between(first, n) > 15 else -np.inf for n, v in zip(starts, values, strict=True)]
    for start in (int(np.argmax(values)), int(np.argmax(apart))):
        normal, best = starts[start], values[start]
        for step in (7.0, 3.5, 1.8, 0.9):
            around = [_tilted(normal, step, i * np.pi / 3 + step) for i in range(6)]
            value, near = max(((tried(n), n) for n in around), key=lambda pair: pair[0])
            if value > best:
                normal, best = near, value
    return np.array(planes), np.array(scores)


def _tilted(normal: np.ndarray, degrees: float, towards: float) -> np.ndarray:
    """A unit normal tilted by some degrees in a direction (radians)."""
    right, down = plane_axes(normal)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return c * normal + s * (np.cos(towards) * right + np.sin(towards) * down)


def _between(first: np.ndarray, second: np.ndarray) -> float:
    """Degrees between two unit vectors."""
    return float(np.degrees(np.arccos(np.clip(first @ second, -1, 1))))


def _principal_point(shape: tuple[int, int]) -> tuple[float, float]:
    return (shape[1] - 1) / 2, (shape[0] - 1) / 2


def _centroid(mask: np.ndarray) -> tuple[float, float]:
    y, x = np.nonzero(mask)
    return float(x.mean()), float(y.mean())


def _turned(seen: Rectification, segments: Segments) -> Rectification:
    """A region as the photo shows it, turned so that its lines lie along rows and columns, where they do not."""
    turn, shares = _straight(segments.within(seen.mask), np.eye(3), STRAIGHT)
    # grass and clouds have lines of one direction too, but loosely
    if abs(turn[1, 0]) < np.sin(np.radians(LEAST_TURN)) or shares.sum() < LEAST_STRAIGHT:
        return seen
    found = resample(seen.pixels, seen.mask, turn, "turned", seen.normal, seen.confidence)
    return replace(found, warnings=seen.warnings + found.warnings)


def _squared(mask: np.ndarray, view: View) -> PlaneEstimate | None:
    """The plane on which a region's lines become rows and columns, as they are not from the front: uprights and courses
    of a wall that converge. None where there is none."""
    lines, where, centre = view.segments.within(mask), _centroid(mask), _principal_point(mask.shape)
    if len(lines.ends) < LEAST_SQUARED:
        return None
    own = find_frame(lines, view.focal, centre)
    axes = ([own.axes[2]] if own else []) + (list(view.frame.axes) if view.frame else [])
    ray = np.append((np.array(where) - centre) / view.focal, 1.0)
    found = None, LEAST_SQUARE
    for axis in axes:
        normal = axis * np.sign(axis @ ray)
        if normal @ ray > LEAST_FACING * np.linalg.norm(ray):
            shares = _straight(lines, plane_to_photo(normal, view.focal, centre, where), SQUARE)[1]
            if shares.sum() > found[1] and shares.min() >= LEAST_ACROSS:
                found = normal, float(shares.sum())
    normal, share = found
    if normal is None or share < _straight(lines, np.eye(3), SQUARE)[1].sum() + MORE_SQUARE:
        return None
    return PlaneEstimate(normal, share, {"lines": len(lines.ends)})


def _straight(lines: Segments, to_photo: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The turn of `_turn`, and the shares (2,) of the lines' length that then lie along rows and along columns, off by
    `degrees` at most."""
    turn = _turn(lines, to_photo)
    step = np.abs(np.diff(_mapped(np.linalg.inv(to_photo @ turn), lines.ends.reshape(-1, 2)).reshape(-1, 2, 2), axis=1))
    length = np.linalg.norm(np.diff(lines.ends, axis=1), axis=2)[:, 0]
    flat = step[:, 0, ::-1] < np.tan(np.radians(degrees)) * step[:, 0]
    return turn, (length @ flat) / max(length.sum(), 1e-9)


def _turn(segments: Segments, to_photo: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the plane that lays its lines along rows and columns; unity where they have no direction."""
    if len(segments.ends) < 8:
        return np.eye(3)
    ends = _mapped(np.linalg.inv(to_photo), segments.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    step = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(step, axis=1)
    quadruple = (length * np.exp(4j * np.arctan2(step[:, 1], step[:, 0]))).sum() / length.sum()
    if abs(quadruple) < 0.5:
        return np.eye(3)
    angle = np.angle(quadruple) / 4
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def metres_per_texel(points: np.ndarray, metres: float, rectification: Rectification) -> float:
    """Metres that one px of a rectified region covers; points (2, 2): photo px (x, y) `metres` apart on its surface."""
    points = np.asarray(points, np.float64)
    if rectification.homography is not None:
        points = _mapped(np.linalg.inv(rectification.homography), points)
    elif rectification.cylinder is not None:
        points = rectification.cylinder.unrolled(points) / rectification.to_surface[0, 0]
    length = float(np.linalg.norm(points[1] - points[0]))
    if not (0 < metres < np.inf) or not 0.5 < length < np.inf:
        raise PaletteError("a measure is two different points of the surface and a positive length in metres")
    return metres / length


# ---------------------------------------------------------------- resampling


def resample(
    pixels: np.ndarray,
    mask: np.ndarray,
    to_photo: np.ndarray,
    method: str = "plane",
    normal: np.ndarray | None = None,
    confidence: float = 1.0,
) -> Rectification:
    """Resample a region onto its plane.

    to_photo (3, 3): homography from the plane, any unit, to photo px. Learnt from is the part that is seen best, of a
    floor the near one: of all densities that one counts at which the photo has the most texels of its own, fine ones
    counting more (SHARPNESS). A texel is as large as a photo px there, at most FINEST times as fine as a px is in its
    worst direction, for it is blurred in that one. What is seen more obliquely than SHARE of
    that is left out, unless less than ENOUGH were left; of what is larger than LARGEST the fullest part is taken.
    Raises PaletteError when nothing remains.
    """
    y, x = np.nonzero(mask)
    some = slice(None, None, max(1, len(x) // 50_000))
    points = np.stack([x, y], -1)[some].astype(float)
    density, facing = _density(np.linalg.inv(to_photo), points)
    # from the densest on, the plane's area that is seen at least so densely
    area = np.abs(np.linalg.det(np.linalg.inv(to_photo))) / _denominator(np.linalg.inv(to_photo), points) ** 3
    good = facing & np.isfinite(density) & (density > 0)
    if not good.any():
        raise PaletteError("the region lies beyond the horizon of its plane; give other corners or turn rectify off")
    order = np.argsort(-density[good], kind="stable")
    sorted_density, sorted_area = density[good][order], np.abs(area[good][order])
    best = (np.cumsum(sorted_area) * sorted_density ** (2 + SHARPNESS)).argmax()
    scale = min(1 / float(np.sqrt(sorted_area[best])), FINEST * float(sorted_density[best]))
    enough = sorted_density[min(len(order) - 1, ENOUGH * len(points) // len(x))]
    least = max(LEAST_SHARE * sorted_density[best], min(SHARE * sorted_density[best], enough))
    kept = good & (density >= least)
    low, high = (f(_mapped(np.linalg.inv(to_photo), points[kept]), 0) for f in (np.min, np.max))
    side = (high - low) * scale + 2
    to_plane = np.array([[1 / scale, 0, low[0]], [0, 1 / scale, low[1]], [0, 0, 1]])
    warnings = []
    if side.max() > LARGEST:
        to_plane = to_plane @ _fullest_window(mask, to_photo @ to_plane, side)
        warnings.append(
            f"rectified, the region spreads over {side[0]:.0f} x {side[1]:.0f} px; the fullest {LARGEST} px are used"
        )
        side = np.minimum(side, LARGEST)
    w, h = (max(1, int(np.ceil(n))) for n in side)
    homography = to_photo @ to_plane
    homography /= homography[2, 2]
    flat = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
    within = np.zeros(h * w, bool)
    for part in range(0, len(flat), 1 << 18):
        at = flat[part : part + (1 << 18)]
        back = _mapped(homography, at)
        texels, facing = _density(np.linalg.inv(homography), back)
        inside = (back >= 0).all(1) & (back <= [mask.shape[1] - 1, mask.shape[0] - 1]).all(1)
        column, row = np.rint(np.where(inside[:, None], back, 0)).astype(int).T
        within[part : part + (1 << 18)] = inside & facing & (texels >= least / scale) & mask[row, column]
    within = within.reshape(h, w)
    if not within.any():
        raise PaletteError("the region is seen too obliquely to be rectified; paint a nearer part of it")
    lost = 1 - kept.mean()
    if lost > 0.5:
        warnings.append(f"{lost:.0%} of the region is seen too obliquely and left out")
    return Rectification(
        _warp(pixels, homography, (h, w), within), within, homography, method, normal, confidence, warnings
    )


def _warp(pixels: np.ndarray, homography: np.ndarray, size: tuple[int, int], within: np.ndarray) -> np.ndarray:
    """Pixels (h, w, 3) under a homography to photo px; where several photo px fall on a texel, their mean."""
    h, w = size
    y, x = np.nonzero(within)
    some = slice(None, None, max(1, len(x) // 5000))
    step = np.stack([x, y], -1)[some].astype(float)
    here = _mapped(homography, step)
    reach = max(np.linalg.norm(_mapped(homography, step + d) - here, axis=1).max() for d in ((1, 0), (0, 1)))
    samples = int(np.clip(np.ceil(reach), 1, MOST_SAMPLES))
    finer = np.array([[1 / samples, 0, 0.5 / samples - 0.5], [0, 1 / samples, 0.5 / samples - 0.5], [0, 0, 1]])
    result = np.empty((h, w, 3), np.float32)
    for top in range(0, h, 256):
        rows = min(256, h - top)
        down = np.array([[1, 0, 0], [0, 1, top], [0, 0, 1]])
        band = cv2.warpPerspective(
            pixels,
            homography @ down @ finer,
            (w * samples, rows * samples),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        result[top : top + rows] = cv2.resize(band, (w, rows), interpolation=cv2.INTER_AREA) if samples > 1 else band
    # cubic interpolation oversteps: beyond white no camera sees
    return np.clip(result, 0, pixels.max())


def _fullest_window(mask: np.ndarray, homography: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Translation (3, 3) to the LARGEST x LARGEST px of the rectified picture that hold most of the mask."""
    shrink = max(1.0, float(side.max()) / 512)
    w, h = (max(1, int(n / shrink)) for n in side)
    small = cv2.warpPerspective(
        mask.astype(np.uint8),
        homography @ np.diag([shrink, shrink, 1]),
        (w, h),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )
    width, height = (min(n, int(LARGEST / shrink)) for n in (w, h))
    total = cv2.integral(small)
    count = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = np.unravel_index(count.argmax(), count.shape)
    return np.array([[1, 0, left * shrink], [0, 1, top * shrink], [0, 0, 1]])


def _mapped(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 2) under a homography."""
    h = points @ homography[:, :2].T + homography[:, 2]
    return h[:, :2] / h[:, 2:]


def _denominator(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ homography[2, :2] + homography[2, 2]


def _density(to_plane: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Photo px per unit of the plane in the worst direction (n,) at photo points, and whether they face the camera."""
    bottom = _denominator(to_plane, points)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (points @ to_plane[:2, :2].T + to_plane[:2, 2]) / bottom[:, None]
        j = (to_plane[None, :2, :2] - at[:, :, None] * to_plane[2, None, None, :2]) / bottom[:, None, None]
        # the largest singular value of a 2 x 2 matrix
        square, det = (j**2).sum((1, 2)), j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]
        stretch = np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * det**2, 0))) / 2)
        return 1 / stretch, det > 0
