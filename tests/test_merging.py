import numpy as np
from material_palette.core.image import linear_from_srgb
from material_palette.core.merging import find_alike, merge
from material_palette.core.region import Region
from textures import pebbles


def photo():
    """Two parts of one gravel, a wall of another colour and texture, and a speck."""
    pixels = linear_from_srgb(pebbles(160, 480))
    stripes = 0.3 + 0.2 * (np.arange(160)[:, None] // 4 % 2) * np.ones((160, 160))
    pixels[:, 320:] = (stripes[..., None] * (1.0, 0.5, 0.3)).astype(np.float32)
    regions = []
    for name, left, right in (("left", 4, 150), ("right", 170, 310), ("wall", 325, 470)):
        mask = np.zeros((160, 480), bool)
        mask[4:150, left:right] = True
        regions.append(Region(name, mask))
    speck = np.zeros((160, 480), bool)
    speck[:20, :20] = True
    return pixels, [*regions, Region("speck", speck)]


def test_parts_of_one_material_are_found_and_others_are_not():
    pixels, regions = photo()
    groups, distances = find_alike(pixels, regions)
    assert groups == [[0, 1], [2], [3]]
    assert distances[0, 1] < 0.15 < 0.3 < min(distances[0, 2], distances[1, 2])
    # too small to be judged
    assert not any(3 in pair for pair in distances)


def test_the_limit_decides():
    pixels, regions = photo()
    assert find_alike(pixels, regions, 0.0)[0] == [[0], [1], [2], [3]]
    assert find_alike(pixels, regions, 100.0)[0] == [[0, 1, 2], [3]]


def test_the_largest_gives_its_name_and_measure():
    _, regions = photo()
    regions[0].measure = (np.zeros((2, 2)), 1.5)
    one, two = merge(regions[:3], [[0, 1], [2]])
    assert one.name == "left" and one.measure is regions[0].measure and two.name == "wall"
    assert (one.mask == (regions[0].mask | regions[1].mask)).all()
