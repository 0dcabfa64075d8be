"""Photos of known materials under rich light: what the network is shown, and what it should answer.

Everything is batched: maps are (B, C, S, S) float32 torch tensors. Gradients and heights wrap nowhere: crops do not.
"""

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from material_palette.core import brdf
from material_palette.core.image import linear_from_srgb, srgb_from_linear
from material_palette.core.torus import integrate
from materials import MaterialSet

MOST_SLOPE = 4.0
VECTORS = ("slope", "lamp")  # what turns with the picture
# deviation of the logarithm of exposure: nothing in a picture tells it from a brighter material, so the albedo keeps
# the photo's. A network that expects more of it draws bright and dark materials to the mean of what it knows
EXPOSURE = 0.04


class Source:
    """Endless random crops of material sets: scaled, turned, mirrored, recoloured, two in one.

    size: side of the crops; scales: least and most side of what is cut, in sizes (the largest is what the set has).
    """

    def __init__(self, sets: list[MaterialSet], size: int, seed: int, most_scale: float = 6.0):
        self.sets, self.size, self.most_scale = sets, size, most_scale
        self.random = np.random.default_rng(seed)
        self.heights = [relief(s.normal) for s in sets]

    def replace(self, index: int, by: MaterialSet) -> None:
        self.sets[index], self.heights[index] = by, relief(by.normal)

    def crop(self, index: int) -> dict[str, np.ndarray]:
        """albedo (S, S, 3) linear, slope (S, S, 2) = d height/dx, /d row, height (S, S) in pixels, roughness,
        metallic (S, S), known (S, S): 1 where the slope is measured."""
        s, random = self.sets[index], self.random
        h, w = s.roughness.shape
        side = int(
            self.size * np.exp(random.uniform(0, np.log(max(1.01, min(self.most_scale, min(h, w) / self.size)))))
        )
        side = min(side, h, w)
        top, left = random.integers(h), random.integers(w)
        rows, columns = (top + np.arange(side)) % h, (left + np.arange(side)) % w

        def cut(x):
            x = x.take(rows, 0).take(columns, 1).astype(np.float32)
            return cv2.resize(x, (self.size, self.size), interpolation=cv2.INTER_AREA) if side != self.size else x

        normal = cut(s.normal) / 127.5 - 1
        slope = np.stack([-normal[..., 0], normal[..., 1]], -1) / np.maximum(normal[..., 2:], 0.2)
        crop = {
            "albedo": linear_from_srgb(cut(s.basecolor) / 255),
            "slope": np.clip(slope, -MOST_SLOPE, MOST_SLOPE),
            "height": cut(self.heights[index]) * self.size / side,
            "roughness": cut(s.roughness) / 255,
            "metallic": cut(s.metallic) / 255 if s.metallic is not None else np.zeros((self.size,) * 2, np.float32),
            "known": np.full((self.size,) * 2, float(s.normal_measured), np.float32),
        }
        return {name: np.ascontiguousarray(x, np.float32) for name, x in crop.items()}

    def material(self) -> dict[str, np.ndarray]:
        """A crop, altered so that no network can learn the sets by heart."""
        random = self.random
        crop = self.crop(random.integers(len(self.sets)))
        if random.random() < 0.25:
            # two materials with an irregular border, the second perhaps as paint or stain on the first one's relief
            other, mask = self.crop(random.integers(len(self.sets))), self._blobs()
            names = ("albedo", "roughness", "metallic") if random.random() < 0.4 else tuple(crop)
            for name in names:
                m = mask[..., None] if crop[name].ndim == 3 else mask
                crop[name] = (1 - m) * crop[name] + m * other[name]
        if random.random() < 0.6:
            tint = np.exp(random.normal(0, 0.25) + random.normal(0, 0.08, 3))
            crop["albedo"] = np.clip(crop["albedo"] * tint, 0, 1).astype(np.float32)
        if random.random() < 0.4:
            strength = np.float32(np.exp(random.uniform(np.log(0.3), np.log(1.5))))
            crop["slope"], crop["height"] = crop["slope"] * strength, crop["height"] * strength
        if random.random() < 0.15:
            # nearly nothing to see: paint, plaster, film; otherwise what it gives there is anybody's guess
            level = crop["albedo"].mean((0, 1))
            crop["albedo"] = level + (crop["albedo"] - level) * np.float32(random.uniform(0, 0.6))
            flatter = np.float32(random.uniform(0, 0.5))
            crop["slope"], crop["height"] = crop["slope"] * flatter, crop["height"] * flatter
        return crop

    def _blobs(self) -> np.ndarray:
        cells = int(self.random.integers(2, 9))
        noise = self.random.standard_normal((cells, cells)).astype(np.float32)
        noise = cv2.resize(noise, (self.size, self.size), interpolation=cv2.INTER_CUBIC)
        noise += 0.3 * cv2.resize(
            self.random.standard_normal((cells * 4, cells * 4)).astype(np.float32),
            (self.size, self.size),
            interpolation=cv2.INTER_CUBIC,
        )
        return np.clip((noise - self.random.normal(0, 0.4)) * self.random.uniform(2, 20) + 0.5, 0, 1)

    def batch(self, count: int) -> dict[str, torch.Tensor]:
        return stacked([self.material() for _ in range(count)])


def stacked(crops: list[dict[str, np.ndarray]]) -> dict[str, torch.Tensor]:
    """Crops as a batch, (B, C, S, S)."""
    batch = {name: torch.from_numpy(np.stack([crop[name] for crop in crops])) for name in crops[0]}
    return {name: x.movedim(-1, 1) if x.ndim == 4 else x[:, None] for name, x in batch.items()}


def turned(batch: dict[str, torch.Tensor], random: np.random.Generator) -> dict[str, torch.Tensor]:
    """The batch mirrored and transposed at random, the slopes and where light comes from with it."""
    batch = dict(batch)
    for axis in (3, 2):
        if random.random() < 0.5:
            batch = {name: x.flip(axis) for name, x in batch.items()}
            sign = torch.ones(1, 2, 1, 1)
            sign[:, 3 - axis] = -1
            batch |= {name: batch[name] * sign for name in VECTORS if name in batch}
    if random.random() < 0.5:
        batch = {name: x.transpose(2, 3) for name, x in batch.items()}
        batch |= {name: batch[name].flip(1) for name in VECTORS if name in batch}
    return batch


def relief(normal: np.ndarray) -> np.ndarray:
    """Height (H, W) float16 in pixels of a tileable normal map (H, W, 3) uint8, +Y up."""
    n = torch.from_numpy(normal.astype(np.float32) / 127.5 - 1)
    z = n[..., 2].clamp_min(0.2)
    height = integrate((-n[..., 0] / z).clamp(-MOST_SLOPE, MOST_SLOPE), (n[..., 1] / z).clamp(-MOST_SLOPE, MOST_SLOPE))
    return height.numpy().astype(np.float16)


def normal_of(slope: torch.Tensor) -> torch.Tensor:
    """Unit normals (B, 3, S, S), +Y up, of slopes (B, 2, S, S)."""
    n = torch.stack([-slope[:, 0], slope[:, 1], torch.ones_like(slope[:, 0])], 1)
    return n / n.square().sum(1, keepdim=True).sqrt()


def photographed(batch: dict[str, torch.Tensor], random: np.random.Generator) -> torch.Tensor:
    """Photos (B, 3, S, S), sRGB-encoded in [0, 1], of a batch: sun, lamp, sky, crevices, camera."""
    return lit(batch, random)[0]


def lit(batch: dict[str, torch.Tensor], random: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Photos as of `photographed`, and where their light comes from, (B, 2, 1, 1): along x and down, weighted."""
    count, _, size, _ = batch["albedo"].shape
    generator = torch.Generator().manual_seed(int(random.integers(2**62)))

    def uniform(least, most, *shape):
        return least + (most - least) * torch.rand(count, *shape, 1, 1, generator=generator)

    def last(x):
        return x.movedim(1, -1)

    normal = last(normal_of(batch["slope"]))
    albedo, roughness, metallic = last(batch["albedo"]), batch["roughness"][:, 0], batch["metallic"][:, 0]
    # the camera stands above, up to 20 degrees aside, near enough for the view to change over the picture
    axis = torch.linspace(-0.5, 0.5, size)
    place = torch.stack([axis.expand(size, size), -axis[:, None].expand(size, size), torch.zeros(size, size)], -1)
    aside = torch.cat([uniform(-0.35, 0.35, 2), torch.ones(count, 1, 1, 1)], 1) * uniform(1.5, 6.0, 1)
    view = _unit(last(aside) - place)
    total, lamps = torch.zeros_like(albedo), torch.zeros(count, 2, 1, 1)
    weight = torch.zeros(count, 1, 1, 1)
    for lamp in range(2 if random.random() < 0.2 else 1):
        azimuth, elevation = uniform(0, 2 * np.pi, 1), uniform(0.35, 1.0, 1)
        flat = torch.sqrt(1 - elevation**2)
        direction = last(torch.cat([torch.cos(azimuth) * flat, torch.sin(azimuth) * flat, elevation], 1))
        # from near lamps to the sun
        distance = last(torch.exp(uniform(np.log(0.7), np.log(20.0), 1)))
        to_lamp = direction * distance - place
        falloff = distance**2 / to_lamp.square().sum(-1, keepdim=True)
        colour = last(torch.exp(0.08 * torch.randn(count, 3, 1, 1, generator=generator)))
        share = last(uniform(0.1, 1.2, 1) if lamp == 0 else uniform(0.1, 0.6, 1))
        reflected = brdf.shade(albedo, normal, roughness, _unit(to_lamp), view, metallic) * falloff
        cosine = direction[..., 2:]
        total = total + share * colour * reflected / cosine
        weight = weight + share
        across = direction[..., :2] * torch.tensor([1.0, -1.0])  # rows go down
        lamps = lamps + (share * across / cosine).movedim(-1, 1)
    # the sky: what a normal sees of the hemisphere, less in crevices; a mirror sees it too
    height = batch["height"][:, 0]
    hidden = sum((_blurred(height, sigma) - height).clamp_min(0) / sigma for sigma in (1.5, 4.0, 12.0))
    # in half of the pictures there are none
    crevices = torch.exp(-uniform(-2.5, 2.5).clamp_min(0) * hidden)[..., None]
    tilt = _unit(last(torch.cat([uniform(-0.5, 0.5, 2), torch.ones(count, 1, 1, 1)], 1)))
    open_sky = 0.5 + 0.5 * (normal * tilt).sum(-1, keepdim=True)
    dielectric = albedo * (1 - metallic[..., None]) + brdf.F0
    sky = last(uniform(0.15, 1.0, 1))
    total = total + sky * crevices * open_sky * (dielectric + metallic[..., None] * albedo)
    total, lamps = total / (weight + sky), lamps / (weight + sky)
    # exposure, and what is left of vignetting and of illumination after it was flattened
    drift = torch.randn(count, 1, 3, 3, generator=generator)
    drift = F.interpolate(drift, (size, size), mode="bicubic", align_corners=True)[:, 0, ..., None]
    exposure = torch.exp(EXPOSURE * torch.randn(count, 1, 1, 1, generator=generator))
    total = total * exposure * torch.exp(0.06 * drift)
    return torch.stack([torch.from_numpy(_camera(x, random)) for x in total.numpy()]).movedim(-1, 1), lamps


def _camera(linear: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Blur, noise, clipping, sRGB, JPEG."""
    if random.random() < 0.4:
        linear = cv2.GaussianBlur(linear, (0, 0), random.uniform(0.3, 1.0))
    if random.random() < 0.5:
        deviation = random.uniform(0, 0.01) * np.sqrt(np.maximum(linear, 0.01))
        linear = linear + random.standard_normal(linear.shape, np.float32) * deviation
    encoded = srgb_from_linear(np.clip(linear, 0, 1).astype(np.float32))
    if random.random() < 0.4:
        pixels = np.round(encoded[..., ::-1] * 255).astype(np.uint8)
        pixels = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, int(random.integers(50, 96))])[1]
        encoded = cv2.imdecode(pixels, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float32) / 255
    return np.ascontiguousarray(encoded, np.float32)


def _blurred(x: torch.Tensor, sigma: float) -> torch.Tensor:
    """(B, S, S), two boxes being near a Gaussian."""
    side = max(3, int(round(sigma * 2)) // 2 * 2 + 1)
    return torch.from_numpy(
        np.stack([cv2.blur(cv2.blur(picture, (side, side)), (side, side)) for picture in x.numpy()])
    )


def _unit(x: torch.Tensor) -> torch.Tensor:
    # torch's own normalize takes ten times as long over three channels
    return x / x.square().sum(-1, keepdim=True).sqrt()
