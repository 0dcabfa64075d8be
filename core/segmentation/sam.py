"""Segmentation "sam": Segment Anything (Kirillov et al. 2023) and SAM 2 (Ravi et al. 2024), with weights of the user's.

The folder holds a model as transformers saves it: config.json of type "sam" or "sam2" and model.safetensors. Its masks
are objects and parts, not materials: two walls of one plaster are two. Nothing is downloaded and no pickle is read.
"""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ..errors import PaletteError
from ..image import srgb_from_linear
from ..region import Region, check_region
from .pick import Click

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the photos all these models were trained on
GRID = 16  # points a side, "everything"
BATCH = 16  # points at once
LEAST_SCORE = 0.8  # IoU that the model expects of its mask
LEAST_STABILITY = 0.9  # IoU of the mask a little larger with it a little smaller (logits of -1 and 1)
MOST_OVERLAP = 0.7  # IoU; of two masks beyond it the better stays
LEAST_SHARE = 0.01  # of the photo


class Sam:
    """A model and one photo: `Sam(folder)`, `look(pixels)`, then `select` as often as wanted, or `everything`."""

    def __init__(self, folder: str | Path | None):
        """Load the model. Raises PaletteError without a folder, the packages, or weights of these kinds in it."""
        self.model, self.kind = _load(folder)
        self.side = _first(self.model.config.prompt_encoder_config.image_size)

    def look(self, pixels: np.ndarray) -> None:
        """Encode a photo (H, W, 3) linear float32; the slow part, once per photo."""
        import torch

        self.shape = height, width = pixels.shape[:2]
        encoded = np.clip(srgb_from_linear(np.clip(pixels, 0, 1)), 0, 1)
        if self.kind == "sam":  # the longer side fills the square, the rest is padding
            scale = self.side / max(height, width)
            self.inner = max(1, round(height * scale)), max(1, round(width * scale))
        else:  # SAM 2 stretches the photo
            self.inner = self.side, self.side
        small = cv2.resize(encoded, self.inner[::-1], interpolation=cv2.INTER_AREA)
        square = np.zeros((self.side, self.side, 3), np.float32)
        square[: self.inner[0], : self.inner[1]] = (small - MEAN) / DEVIATION
        with torch.inference_mode():
            batch = torch.from_numpy(square.transpose(2, 0, 1)[None])
            self.embedding = self.model.get_image_embeddings(batch)

    def select(self, clicks: list[Click] = (), box: tuple[float, float, float, float] | None = None) -> np.ndarray:
        """(H, W) bool: the mask of clicks together and a box (left, top, right, bottom) in px of the photo."""
        import torch

        if not clicks and box is None:
            return np.zeros(self.shape, bool)
        prompts = {}
        if clicks:
            prompts["input_points"] = torch.tensor([[[self._placed(click.x, click.y) for click in clicks]]])
            prompts["input_labels"] = torch.tensor([[[int(click.positive) for click in clicks]]])
        if box is not None:
            prompts["input_boxes"] = torch.tensor([[[*self._placed(*box[:2]), *self._placed(*box[2:])]]])
        logits, scores = self._masks(**prompts)
        return self._full(logits[0, int(scores[0].argmax())]) > 0

    def everything(self, progress: Callable[[float, str], None]) -> list[np.ndarray]:
        """(H, W) bool masks, disjoint, by decreasing area: what a grid of points finds, small ones over large ones."""
        import torch

        height, width = self.shape
        points = [((x + 0.5) / GRID * width, (y + 0.5) / GRID * height) for y in range(GRID) for x in range(GRID)]
        found: list[tuple[float, np.ndarray]] = []
        for start in range(0, len(points), BATCH):
            placed = [[list(self._placed(x, y))] for x, y in points[start : start + BATCH]]
            logits, scores = self._masks(
                input_points=torch.tensor([placed]), input_labels=torch.ones((1, len(placed), 1), dtype=torch.int)
            )
            outer, inner = (logits > -1).sum((2, 3)), (logits > 1).sum((2, 3))
            stable = inner / np.maximum(outer, 1)
            kept = (scores >= LEAST_SCORE) & (stable >= LEAST_STABILITY) & (inner > 0)
            found += [(float(scores[index]), logits[index] > 0) for index in zip(*np.nonzero(kept), strict=True)]
            progress((start + len(placed)) / len(points), "Segmenting")
        owner = np.full(self.shape, -1)
        for index, mask in enumerate(sorted(_distinct(found), key=np.count_nonzero, reverse=True)):
            owner[self._full(np.where(mask, 1.0, -1.0)) > 0] = index
        masks = [owner == index for index in range(owner.max() + 1)]
        return sorted(masks, key=np.count_nonzero, reverse=True)

    def _placed(self, x: float, y: float) -> tuple[float, float]:
        return float(x / self.shape[1] * self.inner[1]), float(y / self.shape[0] * self.inner[0])

    def _masks(self, **prompts) -> tuple[np.ndarray, np.ndarray]:
        """Logits (points, 3, h, w) and expected IoU (points, 3) of the model's candidates."""
        import torch

        with torch.inference_mode():
            out = self.model(image_embeddings=self.embedding, multimask_output=True, **prompts)
        return out.pred_masks[0].numpy(), out.iou_scores[0].numpy()

    def _full(self, logits: np.ndarray) -> np.ndarray:
        square = cv2.resize(logits.astype(np.float32), (self.side, self.side), interpolation=cv2.INTER_LINEAR)
        return cv2.resize(square[: self.inner[0], : self.inner[1]], self.shape[::-1], interpolation=cv2.INTER_LINEAR)


def segment_sam(
    pixels: np.ndarray,
    regions: int,
    seed: int,
    progress: Callable[[float, str], None],
    warn: Callable[[str], None] = lambda text: None,
    weights: str | Path | None = None,
) -> list[Region]:
    """The `regions` largest of what SAM finds in a photo (H, W, 3) linear float32; nothing is drawn at random."""
    progress(0.0, "Loading Segment Anything")
    sam = Sam(weights)
    progress(0.1, "Looking at the photo")
    sam.look(pixels)
    masks = sam.everything(lambda fraction, message: progress(0.4 + 0.59 * fraction, message))
    found = []
    for mask in masks:
        try:
            check_region(Region("region", mask))
        except PaletteError:
            continue
        if mask.mean() >= LEAST_SHARE:
            found.append(mask)
    if len(found) > regions:
        warn(f"Segment Anything found {len(found)} regions; the {regions} largest are kept.")
    progress(1.0, "Segmenting")
    return [Region(f"region_{number}", mask) for number, mask in enumerate(found[:regions], 1)]


def _load(folder: str | Path | None):
    wanted = "a folder with config.json and model.safetensors of a 'sam' or 'sam2' model in transformers' form"
    if folder is None:
        raise PaletteError(f"Segmentation 'sam' needs weights: name {wanted} with --weights DIR.")
    folder = Path(folder)
    try:
        kind = json.loads((folder / "config.json").read_text(encoding="utf-8")).get("model_type")
    except (OSError, ValueError, AttributeError):
        raise PaletteError(f"'{folder}' holds no readable config.json. Name {wanted}.") from None
    kind = {"sam2_video": "sam2"}.get(kind, kind)  # how SAM 2 is published; its image part is the same
    if kind not in ("sam", "sam2"):
        raise PaletteError(f"'{folder}' holds a model of type '{kind}'. Name {wanted}.")
    if not list(folder.glob("*.safetensors")):
        raise PaletteError(f"'{folder}' holds no safetensors file (pickled weights aren't read). Name {wanted}.")
    try:
        import transformers
    except ImportError:
        raise PaletteError("Segmentation 'sam' needs transformers: pip install transformers") from None
    model_class = transformers.SamModel if kind == "sam" else transformers.Sam2Model
    try:
        model, loading = model_class.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise PaletteError(f"The weights in '{folder}' can't be loaded: {' '.join(str(error).split())[:300]}") from None
    if loading["missing_keys"]:
        first = sorted(loading["missing_keys"])[0]
        raise PaletteError(f"The weights in '{folder}' lack {len(loading['missing_keys'])} tensors, such as '{first}'.")
    return model.eval(), kind


def _distinct(found: list[tuple[float, np.ndarray]]) -> list[np.ndarray]:
    """Masks of which no two overlap by MOST_OVERLAP, the best first."""
    kept: list[np.ndarray] = []
    for _, mask in sorted(found, key=lambda pair: -pair[0]):
        area = np.count_nonzero(mask)
        for other in kept:
            both = np.count_nonzero(mask & other)
            if both > MOST_OVERLAP * (area + np.count_nonzero(other) - both):
                break
        else:
            kept.append(mask)
    return kept


def _first(size) -> int:
    return int(size if isinstance(size, int) else size[0])
