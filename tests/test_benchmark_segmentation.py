"""The measures of the benchmark of regions on cases whose answer is known."""

import json

import cv2
import numpy as np
import pytest
from material_palette.benchmarks import regions
from material_palette.benchmarks.collage import photos


def test_no_region_is_given_to_two_materials():
    truth = np.repeat([[0, 0, 1, 1]], 4, 0)
    assert regions.mean_iou(truth, truth) == 1
    assert regions.mean_iou(1 - truth, truth) == 1  # their numbers don't matter
    assert regions.mean_iou(np.zeros_like(truth), truth) == pytest.approx(0.25)  # half of one, none of the other
    assert regions.mean_iou(np.full_like(truth, -1), truth) == 0


def test_what_is_not_scored_still_must_not_be_in_a_region():
    truth = np.repeat([[0, 0, 1, -1]], 4, 0)
    assert regions.mean_iou(np.repeat([[0, 0, -1, 0]], 4, 0), truth, scored=1) == 1  # unknown pixels don't count
    assert regions.mean_iou(np.zeros_like(truth), truth, scored=1) == pytest.approx(2 / 3)


def test_a_material_has_an_exemplar_where_a_part_of_it_is_a_region_that_is_pure():
    truth = np.repeat([[0] * 8 + [1] * 8 + [-1] * 4], 4, 0)
    part = np.full_like(truth, -1)
    part[:, 4:6] = 0  # a quarter
    assert regions.pure(part, truth) == 0.5
    part[:, 5] = -1
    assert regions.pure(part, truth) == 0
    mixed = np.where(truth == 1, 1, 0)
    mixed[:, 8:10] = 0  # a fifth of the first region is the other material
    assert regions.pure(mixed, truth) == 0.5
    assert regions.pure(truth, truth, scored=1) == 1


def test_borders_are_matched_within_a_little_of_the_diagonal():
    truth, near, far = (np.zeros((300, 400), int) for _ in range(3))
    truth[:, 200:], near[:, 203:], far[:, 210:] = 1, 1, 1
    assert regions.boundary_f(near, truth) == 1
    assert regions.boundary_f(far, truth) == 0


def test_labelled_patches_of_photos_have_the_sky_last(tmp_path):
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "house.jpg"), np.full((100, 200, 3), 90, np.uint8))
    labels = {"house": {"sky": [[0, 0, 100, 10]], "wall": [[10, 50, 20, 100]]}, "absent": {"wall": [[0, 0, 9, 9]]}}
    (tmp_path / "labels.json").write_text(json.dumps({"photo": labels}))
    (photo,) = photos(tmp_path, tmp_path / "labels.json")
    assert photo.name == "photo_house" and photo.scored == 1
    assert (photo.labels[:10] == 1).all() and (photo.labels[50:, 20:40] == 0).all()
    assert (photo.labels >= 0).sum() == 10 * 200 + 50 * 20
