import json

import cv2
import numpy as np
import pytest
from material_palette.core import rectification
from material_palette.core.errors import PaletteError
from material_palette.core.image import read_photo
from material_palette.core.palette import Settings, _rectified, extract_palette
from material_palette.core.region import Region, parse_corners, parse_measure, read_regions
from textures import pebbles, quiet

FOCAL = 1.1  # in sides of the photo


def slanted(texture, normal, side=384, density=1.0):
    """A square photo of a plane, normal (3,) away from the camera."""
    centre = ((side - 1) / 2,) * 2
    to_photo = rectification.plane_to_photo(normal, FOCAL * side, centre, centre)
    size = len(texture)
    # the plane's origin lies in the middle of the texture; 4 x 4 samples a px
    fine = 4
    shift = np.array([[FOCAL * side * density, 0, size / 2], [0, FOCAL * side * density, size / 2], [0, 0, 1]])
    from_fine = np.array([[1 / fine, 0, 0.5 / fine - 0.5], [0, 1 / fine, 0.5 / fine - 0.5], [0, 0, 1]])
    back = shift @ np.linalg.inv(to_photo) @ from_fine
    wide = cv2.warpPerspective(
        texture, back, (side * fine,) * 2, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_WRAP
    )
    return cv2.resize(wide, (side, side), interpolation=cv2.INTER_AREA)


def tilted(slant, towards):
    slant = np.radians(slant)
    return np.array([np.sin(slant) * np.cos(towards), np.sin(slant) * np.sin(towards), np.cos(slant)])


def bricks(side=512):
    picture = pebbles(side, side) * 0.15 + 0.5
    for row in range(0, side, 32):
        picture[row : row + 3] = 0.1
        for column in range(row % 64, side, 64):
            picture[row : row + 32, column : column + 3] = 0.1
    return picture.astype(np.float32)


def view_of(pixels):
    return rectification.look(pixels, FOCAL * len(pixels))


@pytest.mark.parametrize("texture", [pebbles(512, 512), bricks()], ids=["pebbles", "bricks"])
def test_the_plane_of_a_texture_is_found(texture):
    normal = tilted(50, 1.2)
    pixels = slanted(texture, normal)
    found = rectification.rectify(pixels, np.ones(pixels.shape[:2], bool), view_of(pixels))
    assert found.method == "auto"
    assert np.degrees(np.arccos(found.normal @ -normal)) < 8


def room(floor_texture, turn=0.35, drop=0.3):
    """A photo of a wall of bricks above a floor, its floor's mask, and the floor's normal away from the camera."""
    c, s = np.cos(drop), np.sin(drop)
    lower = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])  # the camera looks down a little
    wall = lower @ np.array([np.sin(turn), 0, np.cos(turn)])
    floor = lower @ np.array([0, 1.0, 0])
    side, level = 384, 205
    photo = slanted(bricks(), wall)
    centre = ((side - 1) / 2,) * 2
    to_photo = rectification.plane_to_photo(floor, FOCAL * side, centre, ((side - 1) / 2, 0.8 * side))
    to_texture = np.diag([300.0, 300.0, 1.0]) @ np.linalg.inv(to_photo)
    flat = cv2.warpPerspective(
        floor_texture, to_texture, (side, side), flags=cv2.INTER_AREA | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_WRAP
    )
    mask = np.zeros((side, side), bool)
    mask[level:] = True
    photo[mask] = flat[mask]
    return photo, mask, floor


def test_a_floor_without_lines_is_found_by_the_lines_of_the_wall():
    photo, mask, floor = room(pebbles(1024, 1024))
    view = view_of(photo)
    found = rectification.find_plane(photo, mask, view)
    assert "least_gain" in found.evidence and found.confidence >= 0.5
    assert np.degrees(np.arccos(found.normal @ floor)) < 5
    assert rectification.rectify(photo, mask, view).method == "auto"


def test_a_frame_that_the_texture_does_not_follow_is_no_plane_of_its():
    photo, mask, floor = room(pebbles(1024, 1024))
    facing, _, _ = room(pebbles(1024, 1024))
    facing[mask] = pebbles(384, 384)[mask]
    view = view_of(photo)
    assert rectification.rectify(facing, mask, view).homography is None
    # of no other plane of the frame, either
    view.frame.axes = view.frame.axes[np.abs(view.frame.axes @ floor) < 0.9]
    found = rectification.find_plane(photo, mask, view)
    assert found is None or "least_gain" not in found.evidence


def test_a_plane_against_the_frame_of_the_photo_takes_more_evidence():
    pixels, mask = slanted(pebbles(512, 512), tilted(50, 1.2)), np.ones((384, 384), bool)
    view = view_of(pixels)
    alone = rectification.find_plane(pixels, mask, view)
    view.frame = rectification.Frame(np.eye(3), 0.9, 0.3, 0.3, 100, view.focal)
    against = rectification.find_plane(pixels, mask, view)
    assert np.array_equal(against.normal, alone.normal) and 0 < against.confidence < alone.confidence


def test_a_wrong_frame_does_not_beat_a_plane_that_is_clear():
    truth = tilted(50, 1.2)
    pixels, mask = slanted(bricks(), truth), np.ones((384, 384), bool)
    view = view_of(pixels)
    # turned about the courses, as a frame may be that little but they tell of
    courses = rectification.plane_axes(truth)[0]
    turn = cv2.Rodrigues(courses * np.radians(44))[0]
    view.frame = rectification.Frame(
        np.array([courses, turn @ truth, turn @ np.cross(truth, courses)]), 0.9, 0.07, 0.2, 100, view.focal
    )
    found = rectification.find_plane(pixels, mask, view)
    assert found.confidence >= 0.5 and np.degrees(np.arccos(found.normal @ truth)) < 8


def test_lines_that_all_run_one_way_make_no_frame():
    boards = np.full((384, 384, 3), 0.4, np.float32)
    boards[::24] = 0.05
    assert view_of(boards).frame is None and view_of(pebbles(384, 384)).frame is None
    assert view_of(slanted(bricks(), tilted(50, 0.3))).frame is not None


def test_a_region_seen_from_the_front_stays_bit_for_bit():
    pixels, mask = pebbles(384, 384), np.ones((384, 384), bool)
    found = rectification.rectify(pixels, mask, view_of(pixels))
    assert found.homography is None and np.array_equal(found.pixels, pixels) and np.array_equal(found.mask, mask)


def test_of_walls_on_both_sides_of_a_street_the_larger_one_is_brought_to_the_front():
    left, right = tilted(55, 0.0), tilted(55, np.pi)
    pixels, mask = slanted(bricks(), left), np.ones((384, 384), bool)
    pixels[:, 220:] = slanted(bricks(), right)[:, 220:]
    mask[:, 190:220] = False
    view = view_of(pixels)
    found = rectification.rectify(pixels, mask, view)
    assert found.method == "auto" and np.degrees(np.arccos(found.normal @ -left)) < 8
    (warning,) = (w for w in found.warnings if "another plane" in w)
    assert warning.startswith("46%")
    # of one wall behind a lamp post nothing is left out
    pixels = slanted(bricks(), left)
    found = rectification.rectify(pixels, mask, view_of(pixels))
    assert found.method == "auto" and not any("another plane" in w for w in found.warnings)


def test_a_region_seen_from_the_front_is_turned_by_its_lines():
    for degrees in (-20, 4):
        turn = cv2.getRotationMatrix2D((255.5, 255.5), degrees, 1)
        pixels = cv2.warpAffine(bricks(), turn, (512, 512), flags=cv2.INTER_CUBIC)[80:432, 80:432].clip(0)
        found = rectification.rectify(pixels, np.ones((352, 352), bool), view_of(pixels))
        assert found.method == "turned" and not found.warnings
        column, row = found.homography[:2, :2].T
        assert np.degrees(np.arctan2(*column[::-1])) == pytest.approx(-degrees, abs=0.7)
        assert np.linalg.norm(column) == pytest.approx(1, abs=0.01) and abs(column @ row) < 1e-6
        # the joints of the courses fill rows
        middle = found.pixels[150:300, 150:300, 0]
        assert (middle < 0.3).mean(1).max() > 0.9
        level = rectification.rectify(found.pixels, found.mask, view_of(found.pixels))
        assert level.method == "off"


def test_uprights_and_courses_that_converge_tell_the_plane_of_a_wall():
    wall = np.full((512, 512, 3), 0.5, np.float32)
    wall[::64] = wall[1::64] = 0.1
    boards = wall.copy()
    boards[:, ::24] = boards[:, 1::24] = 0.1
    normal = tilted(14, 0.8)
    for texture, found in ((boards, True), (wall, False)):  # lines of one direction lie on many planes
        photo = slanted(texture, normal)
        view, mask = view_of(photo), np.ones(photo.shape[:2], bool)
        estimate = rectification._squared(mask, view)
        assert (estimate is not None) == found
    flat = rectification.rectify(slanted(boards, normal), mask, view_of(slanted(boards, normal)))
    assert flat.method == "auto"
    assert np.degrees(np.arccos(flat.normal @ -normal)) < 2
    assert rectification._squared(mask, view_of(boards[:384, :384])) is None  # from the front there is nothing to gain


def test_noise_on_a_plain_wall_is_no_plane():
    pixels = 0.5 + 0.002 * np.random.default_rng(0).standard_normal((384, 384, 3)).astype(np.float32)
    found = rectification.rectify(pixels, np.ones((384, 384), bool), view_of(pixels))
    assert found.method == "off" and not found.warnings


def test_a_slant_is_warned_of_only_where_much_speaks_for_it(monkeypatch):
    pixels, mask = pebbles(384, 384), np.ones((384, 384), bool)
    for confidence, said in ((0.3, True), (0.01, False)):
        estimate = rectification.PlaneEstimate(tilted(40, 0.3), confidence, {})
        monkeypatch.setattr(rectification, "find_plane", lambda *arguments, found=estimate: found)
        rectified = rectification.rectify(pixels, mask, view_of(pixels))
        assert rectified.method == "off" and bool(rectified.warnings) == said


def corners_in_photo(normal, rectangle, side=384):
    centre = ((side - 1) / 2,) * 2
    to_photo = rectification.plane_to_photo(normal, FOCAL * side, centre, centre)
    points = np.append(np.array(rectangle, float), np.ones((4, 1)), 1) @ to_photo.T
    return points[:, :2] / points[:, 2:]


@pytest.mark.parametrize("known", [True, False])
def test_four_corners_give_normal_and_proportions(known):
    truth = tilted(45, 0.7)
    rectangle = [(-0.3, -0.1), (0.3, -0.1), (0.3, 0.1), (-0.3, 0.1)]  # 3 : 1
    corners = corners_in_photo(truth, rectangle)
    to_photo, normal = rectification.plane_of_corners(corners, (384, 384), FOCAL * 384 if known else None)
    assert np.degrees(np.arccos(np.clip(normal @ -truth, -1, 1))) < 0.1
    back = np.linalg.inv(to_photo) @ np.append(corners, np.ones((4, 1)), 1).T
    back = (back[:2] / back[2]).T
    assert back == pytest.approx(np.array([[0, 0], [1, 0], [1, 1 / 3], [0, 1 / 3]]), abs=1e-3)


def test_rectified_by_corners_the_texture_is_the_flat_one():
    texture, normal = cv2.GaussianBlur(pebbles(512, 512), (0, 0), 2), tilted(40, 0)
    pixels = slanted(texture, normal)
    corners = corners_in_photo(normal, [(-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)])
    mask = np.zeros((384, 384), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 1)
    found = rectification.rectify_corners(pixels, mask > 0, corners, FOCAL * 384)
    centre = ((384 - 1) / 2,) * 2
    to_texture = np.array([[FOCAL * 384, 0, 256], [0, FOCAL * 384, 256], [0, 0, 1]])
    to_texture = to_texture @ np.linalg.inv(rectification.plane_to_photo(normal, FOCAL * 384, centre, centre))
    to_texture = to_texture @ found.homography
    to_texture /= to_texture[2, 2]
    similarity = to_texture[:2, :2]
    # square texels, no smaller than the photo's own px
    assert np.abs(to_texture[2, :2]).max() < 1e-5
    assert similarity.T @ similarity / similarity[0, 0] ** 2 == pytest.approx(np.eye(2), abs=0.01)
    assert similarity[0, 0] > 1
    h, w = found.mask.shape
    flat = cv2.warpPerspective(texture, to_texture, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    inside = cv2.erode(found.mask.astype(np.uint8), np.ones((9, 9))) > 0
    assert np.corrcoef(found.pixels[inside].ravel(), flat[inside].ravel())[0, 1] > 0.97


def test_of_an_over_exposed_floor_the_part_that_is_not_is_learnt_from():
    normal = tilted(60, np.pi / 2)
    photo = slanted(0.2 + 0.5 * pebbles(512, 512), normal)
    photo[170:] = 1.0  # the near part, most of what is seen from above
    mask = np.ones((384, 384), bool)
    corners = corners_in_photo(normal, [(-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)])
    settings = Settings(resolution=256)
    for region in (Region("floor", mask, corners=tuple(map(tuple, corners))), Region("floor", mask)):
        flat = _rectified(photo, region, settings, view_of(photo), FOCAL * 384, quiet)
        assert "56% of the region is over-exposed and left out" in flat.warnings
        assert flat.pixels[flat.mask].max() < 0.9
    # cubic interpolation must not overstep what the camera calls white
    whole = rectification.rectify_corners(photo, mask, corners, FOCAL * 384)
    assert whole.pixels.max() == 1


def test_what_is_seen_too_obliquely_is_left_out():
    pixels, mask = slanted(pebbles(512, 512), tilted(65, np.pi / 2)), np.ones((384, 384), bool)
    mask[:20] = False
    centre = (191.5, 191.5)
    to_photo = rectification.plane_to_photo(tilted(65, np.pi / 2), FOCAL * 384, centre, centre)
    found = rectification.resample(pixels, mask, to_photo)
    y, x = np.nonzero(found.mask)
    points = np.stack([x, y, np.ones_like(x)]).astype(float)
    back = found.homography @ points
    rows = back[1] / back[2]
    assert rows.min() > 60 and rows.max() > 360  # the far part is gone, the near one kept


def test_of_a_floor_the_near_part_keeps_its_detail_and_a_small_region_more_of_its_area():
    stripes = np.where(np.arange(512) % 8 < 4, 0.2, 0.6).astype(np.float32)
    texture = np.repeat(np.broadcast_to(stripes, (512, 512))[..., None], 3, -1).copy()
    normal = tilted(65, np.pi / 2)
    pixels = slanted(texture, normal)
    to_photo = rectification.plane_to_photo(normal, FOCAL * 384, (191.5, 191.5), (191.5, 191.5))
    found = rectification.resample(pixels, np.ones((384, 384), bool), to_photo)
    inside = cv2.erode(np.pad(found.mask, 1).astype(np.uint8), np.ones((7, 7)))[1:-1, 1:-1] > 0
    assert found.pixels[inside].std() > 0.9 * pixels[340:].std()
    shares = []
    for half in (190, 60):
        mask = np.zeros((384, 384), bool)
        mask[192 - half : 192 + half, 192 - half : 192 + half] = True
        kept = rectification.resample(pixels, mask, to_photo)
        back = kept.homography @ np.stack([*np.nonzero(kept.mask)[::-1], np.ones(kept.mask.sum())])
        shares.append(1 - (back[1] / back[2]).min() / (2 * half) + (192 - half) / (2 * half))
    assert shares[1] > 0.95 > 0.7 > shares[0]


@pytest.mark.parametrize("corners", [[(0, 0), (0, 9), (9, 9), (9, 0)], [(0, 0), (9, 0), (5, 1), (0, 9)], [(0, 0)] * 4])
def test_corners_of_no_rectangle_are_refused(corners):
    with pytest.raises(PaletteError, match="clockwise"):
        rectification.plane_of_corners(np.array(corners, float) * 20, (200, 200))


def test_a_measure_sets_the_size_of_a_tile():
    pixels = pebbles(128, 128)
    region = Region("gravel", np.ones((128, 128), bool), measure=(np.array([[10.0, 20.0], [74.0, 20.0]]), 0.5))
    settings = Settings(quality="draft", resolution=128, rectify="off")
    assert extract_palette(pixels, [region], settings, quiet).materials[0].metres_per_tile == pytest.approx(1.0)


def test_corners_and_measures_beside_the_masks_and_as_text(tmp_path):
    cv2.imwrite(str(tmp_path / "floor.png"), np.full((40, 40), 255, np.uint8))
    points = [[1, 2], [30, 2], [30, 20], [1, 20]]
    content = {"floor": {"corners": points, "measure": {"points": points[:2], "metres": 0.3}}}
    (tmp_path / "regions.json").write_text(json.dumps(content), encoding="utf-8")
    (region,) = read_regions(tmp_path, (40, 40))
    assert np.array_equal(region.corners, points) and region.measure[1] == 0.3
    assert np.array_equal(parse_corners("floor:1,2 30,2 30,20 1,20")[1], points)
    name, (ends, metres) = parse_measure("a:b:1,2 30,2=0.3")
    assert (name, metres) == ("a:b", 0.3) and np.array_equal(ends, points[:2])
    for text in ("floor:1,2 30,2 30,20", "1,2 3,4 5,6 7", "floor:a,b c,d e,f g,h"):
        with pytest.raises(PaletteError, match="NAME:X,Y"):
            parse_corners(text)
    with pytest.raises(PaletteError, match="positive"):
        parse_measure("floor:1,2 30,2=-1")
    (tmp_path / "regions.json").write_text('{"roof": {"corners": 3}}', encoding="utf-8")
    with pytest.raises(PaletteError, match="regions.json"):
        read_regions(tmp_path, (40, 40))


def test_the_focal_length_is_read_from_exif(tmp_path):
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(360, 240, 3, "uint8")
    spec.attribute("Exif:FocalLengthIn35mmFilm", 50)
    file = oiio.ImageOutput.create("photo.jpg")
    assert file.open(str(tmp_path / "photo.jpg"), spec)
    file.write_image(np.zeros((240, 360, 3), np.uint8))
    file.close()
    assert read_photo(tmp_path / "photo.jpg").focal == pytest.approx(50 / 36 * 360, rel=0.01)
