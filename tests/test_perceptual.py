import cv2
import numpy as np
import pytest
import torch
from material_palette.core import perceptual
from textures import pebbles


def test_the_original_implementations_numbers():
    # stlpips-pytorch 0.0.2, LPIPS(net="alex", variant="shift_tolerant"), in float32
    first, second = pebbles(96, 128), pebbles(96, 128, 1)
    assert perceptual.distance(first, second) == pytest.approx(0.142189, rel=1e-3)
    assert perceptual.distance(first, cv2.GaussianBlur(first, (0, 0), 2)) == pytest.approx(0.429396, rel=1e-3)
    assert perceptual.distance(first, first * 0.5) == pytest.approx(0.270125, rel=1e-3)


def test_distance_is_zero_to_itself_symmetric_and_tolerates_shifts():
    first, second = pebbles(96, 96), pebbles(96, 96, 1)
    assert perceptual.distance(first, first) == 0
    assert perceptual.distance(first, second) == pytest.approx(perceptual.distance(second, first), rel=1e-6)
    shifted = pebbles(100, 100)
    assert perceptual.distance(shifted[2:98, 2:98], shifted[:96, 1:97]) < 0.5 * perceptual.distance(first, second)


def test_layers_are_differentiable_and_as_described():
    images = torch.rand(2, 3, 64, 80, requires_grad=True)
    found = perceptual.layers(images)
    assert tuple(x.shape[1] for x in found) == perceptual.CHANNELS
    assert all(abs(x.shape[2] * stride - 64) <= 2 * stride for x, stride in zip(found, perceptual.STRIDES, strict=True))
    sum(x.mean() for x in found).backward()
    assert images.grad.abs().sum() > 0


def test_a_picture_of_few_pixels_is_refused():
    with pytest.raises(ValueError, match="32 px at least"):
        perceptual.features(np.zeros((20, 64, 3), np.float32))


def test_crops_tell_a_texture_of_the_exemplar_from_another():
    exemplar = pebbles(128, 128)
    crops = perceptual.Crops(exemplar, np.ones((128, 128), bool))
    assert crops.found
    other = cv2.GaussianBlur(exemplar, (0, 0), 3)
    assert crops.distance(pebbles(96, 160, seed=3)) < 0.8 * crops.distance(other)
    narrow = np.zeros((128, 128), bool)
    narrow[:40] = True
    assert not perceptual.Crops(exemplar, narrow).found
