import cv2
import numpy as np
import pytest
from material_palette.core.flip import flip


def pictures():
    """A picture, and three that differ from it."""
    random = np.random.default_rng(0)
    first = cv2.GaussianBlur(random.random((96, 128, 3)).astype(np.float32), (0, 0), 3)
    first = (first - first.min()) / (first.max() - first.min())
    others = []
    for strength in (0.002, 0.02, 0.2):
        other = np.clip(first + strength * (random.random(first.shape).astype(np.float32) - 0.5), 0, 1)
        other[40:50, 40:50] = 0.3
        others.append(other)
    return first, others


def test_is_what_the_authors_program_finds():
    first, others = pictures()
    # flip-evaluator 1.7 on the same pictures
    for other, mean in zip(others, (0.015298, 0.032936, 0.127619), strict=True):
        assert flip(first, other).mean() == pytest.approx(mean, abs=2e-4)


def test_bounds():
    first, (*_, second) = pictures()
    assert flip(first, first).max() == 0
    black, white = np.zeros((32, 32, 3)), np.ones((32, 32, 3))
    assert flip(black, white).mean() > 0.9
    assert 0 <= flip(first, second).min() and flip(first, second).max() <= 1


def test_what_is_far_away_differs_less():
    chequers = (np.indices((64, 64)).sum(0) % 2).astype(np.float32)[..., None].repeat(3, -1) * 0.2 + 0.4
    grey = np.full_like(chequers, chequers.mean())
    assert flip(chequers, grey, 67).mean() < 0.5 * flip(chequers, grey, 15).mean()
