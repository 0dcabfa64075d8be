"""Segmentation "materialistic": the network of Sharma et al. 2023 (`models/materialistic.py`), weights of the user's.

It answers clicks: what is of the clicked material, wherever it lies. For regions without clicks it is asked in the
depth of what no region covers yet, until enough are found. Seconds per photo and click on a CPU.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ..errors import PaletteError
from ..image import srgb_from_linear
from ..region import Region, holds_texture, too_small
from .pick import Click

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet
SHORTER_SIDE = 512  # px, as trained
LONGEST_SIDE = 1024
LEAST_SHARE = 0.01  # of the photo
WANTED = "the checkpoint that the authors of Materialistic publish (ViT-B/8), or its state dict as safetensors"


class Materialistic:
    """A network and one photo: `Materialistic(file)`, `look(pixels)`, then `select` as often as wanted."""

    takes_box = False

    def __init__(self, path: str | Path | None):
        """Load the network. Raises PaletteError without a file, or when it is none of this network."""
        self.net = _load(path)

    def look(self, pixels: np.ndarray, progress: Callable[[float, str], None] = lambda fraction, message: None) -> None:
        """Encode a photo (H, W, 3) linear float32; the slow part, once per photo."""
        import torch

        from ...models.materialistic import PATCH

        self.shape = height, width = pixels.shape[:2]
        scale = min(SHORTER_SIDE / min(height, width), LONGEST_SIDE / max(height, width))
        rows, columns = (max(PATCH, round(side * scale / PATCH) * PATCH) for side in (height, width))
        encoded = np.clip(srgb_from_linear(np.clip(pixels, 0, 1)), 0, 1)
        small = cv2.resize(encoded, (columns, rows), interpolation=cv2.INTER_AREA)
        small = ((small - MEAN) / DEVIATION).astype(np.float32)
        depth = len(self.net.dino_model.blocks)
        done = iter(range(1, depth + 1))
        with torch.inference_mode():
            batch = torch.from_numpy(np.ascontiguousarray(small.transpose(2, 0, 1)[None]))
            self.maps = self.net.look(batch, lambda: progress(next(done) / depth, "Looking at the photo"))
        self.inner, self.scores = (rows, columns), {}

    def select(self, clicks: list[Click], tolerance: float = 0.5) -> np.ndarray:
        """(H, W) bool: pixels whose score for a positive click exceeds 1 - tolerance and that for any negative one."""
        positive = [self._score(click) for click in clicks if click.positive]
        if not positive:
            return np.zeros(self.shape, bool)
        best = np.max(positive, 0)
        inside = best > 1 - tolerance
        for click in clicks:
            if not click.positive:
                inside &= best > self._score(click)
        return inside

    def _score(self, click: Click) -> np.ndarray:
        """(H, W) float32, remembered: a new tolerance needs no new pass."""
        import torch

        place = tuple(
            int(np.clip(at / size * inner, 0, inner - 1))
            for at, size, inner in zip((click.y, click.x), self.shape, self.inner, strict=True)
        )
        if place not in self.scores:
            with torch.inference_mode():
                score = self.net.score(self.maps, place).numpy()
            self.scores[place] = cv2.resize(score, self.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return self.scores[place]


def segment_materialistic(
    pixels: np.ndarray,
    regions: int,
    seed: int,
    progress: Callable[[float, str], None],
    warn: Callable[[str], None] = lambda text: None,
    weights: str | Path | None = None,
) -> list[Region]:
    """At most `regions` disjoint regions of a photo (H, W, 3) linear float32; nothing is drawn at random."""
    progress(0.0, "Loading Materialistic")
    network = Materialistic(weights)
    network.look(pixels, lambda fraction, message: progress(0.5 * fraction, message))
    uncovered = np.ones(pixels.shape[:2], bool)
    found, small = [], []
    asked = 0
    while len(found) < regions and asked < 3 * regions and uncovered.mean() >= LEAST_SHARE:
        depth = cv2.distanceTransform(np.pad(uncovered, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        y, x = np.unravel_index(depth.argmax(), depth.shape)
        mask = network.select([Click(x + 0.5, y + 0.5)]) & uncovered
        cv2.circle(around := np.zeros(mask.shape, np.uint8), (int(x), int(y)), max(1, int(depth.max() / 2)), 1, -1)
        uncovered &= ~mask & (around == 0)  # what gave nothing is not asked again
        asked += 1
        progress(0.5 + 0.49 * max(len(found) / regions, asked / (3 * regions)), "Segmenting")
        if mask.any():
            (found if mask.mean() >= LEAST_SHARE and holds_texture(mask) else small).append(mask)
    if small:
        warn(too_small(len(small), np.sum(small) / uncovered.size))
    found.sort(key=np.count_nonzero, reverse=True)
    progress(1.0, "Segmenting")
    return [Region(f"region_{number}", mask) for number, mask in enumerate(found, 1)]


def _load(path: str | Path | None):
    import torch

    from ...models import materialistic
    from ...models.published import differences, read_state

    if path is None:
        raise PaletteError(f"Segmentation 'materialistic' needs weights: name {WANTED} with --weights FILE.")
    path = Path(path)
    if path.is_dir():
        files = [file for suffix in ("safetensors", "ckpt", "pth") for file in sorted(path.glob(f"*.{suffix}"))]
        if not files:
            raise PaletteError(f"'{path}' holds no .safetensors, .ckpt or .pth file. Name {WANTED}.")
        path = files[0]
    try:
        state = read_state(path)
    except OSError as error:
        raise PaletteError(f"'{path}' can't be read: {error.strerror or error}. Name {WANTED}.") from None
    found = {name.removeprefix("net.").removeprefix("module."): x for name, x in state.items()}
    try:
        with torch.device("meta"):
            net = materialistic.Materialistic(**_sizes(found))
    except (KeyError, ValueError, ZeroDivisionError):
        raise PaletteError(f"'{path}' is not Materialistic's network with ViT-B/8. Name {WANTED}.") from None
    expected = net.state_dict()
    found = {name: x for name, x in found.items() if not name.startswith(("dino_model.head", "criterion"))}
    if wrong := differences(found, expected):
        raise PaletteError(
            f"'{path}' is not Materialistic's network with ViT-B/8 ({len(wrong)} of its {len(expected)} tensors "
            f"differ: {'; '.join(wrong[:3])}). Name {WANTED}."
        )
    net.load_state_dict(found, assign=True)
    return net.eval().requires_grad_(False)


def _sizes(state: dict) -> dict[str, int]:
    """What the network is built of, read off its tensors: DINO's heads have 64 channels each, or there are 2."""
    width = state["dino_model.cls_token"].shape[2]
    return {
        "width": width,
        "heads": max(2, width // 64),
        "depth": 1 + max(int(name.split(".")[2]) for name in state if name.startswith("dino_model.blocks.")),
        "grid": round((state["dino_model.pos_embed"].shape[1] - 1) ** 0.5),
        "channels": state["cross_attention_1.query.weight"].shape[0],
    }
