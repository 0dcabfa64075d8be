"""Segmentation "sam": Segment Anything (Kirillov et al. 2023) and its like, with weights of the user's.

The folder holds a model as transformers saves it: config.json of type "sam" or "sam2" (Ravi et al. 2024) and
model.safetensors. Or, for ONNX Runtime, an image encoder and a decoder as Segment Anything's own script exports it,
which is how MobileSAM (Zhang et al. 2023) and others are passed on. Masks are objects and parts, not materials: two
walls of one plaster are two. Nothing is downloaded and no pickle is read.
"""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ..errors import PaletteError
from ..image import srgb_from_linear
from ..region import Region, holds_texture, too_small
from .pick import Click

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the photos all these models were trained on
GRID = 16  # points a side, "everything"
BATCH = 16  # points at once
LEAST_SCORE = 0.8  # IoU that the model expects of its mask
LEAST_STABILITY = 0.9  # IoU of the mask a little larger with it a little smaller (logits of -1 and 1)
MOST_OVERLAP = 0.7  # IoU; of two masks beyond it the better stays
LEAST_SHARE = 0.01  # of the photo
SURENESS = 20.0  # range of the logits over which the tolerance moves the border
SIDE = 1024  # px, of an ONNX encoder that leaves its canvas open


class Sam:
    """A model and one photo: `Sam(folder)`, `look(pixels)`, then `select` as often as wanted, or `everything`."""

    takes_box = True

    def __init__(self, folder: str | Path | None):
        """Load the model. Raises PaletteError without a folder, the packages, or weights of these kinds in it."""
        self.model = _load(folder)

    def look(self, pixels: np.ndarray, progress: Callable[[float, str], None] = lambda fraction, message: None) -> None:
        """Encode a photo (H, W, 3) linear float32; the slow part, once per photo, without a step that could stop it."""
        progress(0.0, "Looking at the photo")
        self.shape = height, width = pixels.shape[:2]
        encoded = np.clip(srgb_from_linear(np.clip(pixels, 0, 1)), 0, 1)
        if self.model.stretches:
            self.inner = self.model.canvas
        else:  # the photo keeps its shape, the rest of the canvas is padding
            scale = min(self.model.canvas[0] / height, self.model.canvas[1] / width)
            self.inner = max(1, round(height * scale)), max(1, round(width * scale))
        small = cv2.resize(encoded, self.inner[::-1], interpolation=cv2.INTER_AREA)
        canvas = np.zeros((*self.model.canvas, 3), np.float32)
        canvas[: self.inner[0], : self.inner[1]] = 255 * small if self.model.raw else (small - MEAN) / DEVIATION
        self.model.look(canvas)
        progress(1.0, "Looking at the photo")

    def select(
        self,
        clicks: list[Click] = (),
        tolerance: float = 0.5,
        box: tuple[float, float, float, float] | None = None,
    ) -> np.ndarray:
        """(H, W) bool: the mask of clicks together and a box (left, top, right, bottom) in px of the photo.

        tolerance 0 to 1: how unsure the model may be of a pixel; 0.5 is its own border.
        """
        if not clicks and box is None:
            return np.zeros(self.shape, bool)
        points = np.array([self._placed(click.x, click.y) for click in clicks], np.float32).reshape(1, -1, 2)
        labels = np.array([[int(click.positive) for click in clicks]])
        if box is not None:
            box = np.array([*self._placed(*box[:2]), *self._placed(*box[2:])], np.float32)
        logits, scores = self.model.masks(points, labels, box)
        return self._full(logits[0, int(scores[0].argmax())]) > SURENESS * (0.5 - tolerance)

    def everything(self, progress: Callable[[float, str], None]) -> list[np.ndarray]:
        """(H, W) bool masks, disjoint, by decreasing area: what a grid of points finds, small ones over large ones."""
        height, width = self.shape
        points = [((x + 0.5) / GRID * width, (y + 0.5) / GRID * height) for y in range(GRID) for x in range(GRID)]
        found: list[tuple[float, np.ndarray]] = []
        for start in range(0, len(points), BATCH):
            placed = np.array([[self._placed(x, y)] for x, y in points[start : start + BATCH]], np.float32)
            logits, scores = self.model.masks(placed, np.ones(placed.shape[:2], int))
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

    def _full(self, logits: np.ndarray) -> np.ndarray:
        side = max(self.model.canvas)
        square = cv2.resize(logits.astype(np.float32), (side, side), interpolation=cv2.INTER_LINEAR)
        return cv2.resize(square[: self.inner[0], : self.inner[1]], self.shape[::-1], interpolation=cv2.INTER_LINEAR)


class _Transformers:
    """A model of transformers. canvas: (rows, columns) it looks at; stretches: whether photos are stretched to it;
    raw: whether it takes 0 to 255 instead of normalised values."""

    raw = False

    def __init__(self, folder: Path, kind: str):
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
            text = " ".join(str(error).split())[:300]
            raise PaletteError(f"The weights in '{folder}' can't be loaded: {text}") from None
        if loading["missing_keys"]:
            first = sorted(loading["missing_keys"])[0]
            raise PaletteError(
                f"The weights in '{folder}' lack {len(loading['missing_keys'])} tensors, such as '{first}'."
            )
        self.network = model.eval()
        self.canvas = (_first(model.config.prompt_encoder_config.image_size),) * 2
        self.stretches = kind == "sam2"

    def look(self, canvas: np.ndarray) -> None:
        import torch

        with torch.inference_mode():
            batch = torch.from_numpy(np.ascontiguousarray(canvas.transpose(2, 0, 1)[None]))
            self.embedding = self.network.get_image_embeddings(batch)

    def masks(
        self, points: np.ndarray, labels: np.ndarray, box: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Logits (prompts, masks, h, w) and expected IoU (prompts, masks) of points (prompts, n, 2), their labels
        (prompts, n), 1 inside and 0 outside, and a box (4,), all in px of the canvas."""
        import torch

        prompts = {}
        if points.shape[1]:
            prompts["input_points"] = torch.from_numpy(points)[None]
            prompts["input_labels"] = torch.from_numpy(labels)[None]
        if box is not None:
            prompts["input_boxes"] = torch.from_numpy(box)[None, None]
        with torch.inference_mode():
            out = self.network(image_embeddings=self.embedding, multimask_output=True, **prompts)
        return out.pred_masks[0].numpy(), out.iou_scores[0].numpy()


class _Onnx:
    """An encoder and a decoder for ONNX Runtime; attributes and methods as `_Transformers`.

    Encoder: one input, (1, 3, rows, columns) normalised or (rows, columns, 3) of 0 to 255. Decoder: what the encoder
    puts out, by name or else in order, and point_coords, point_labels (2 and 3: a box's corners; -1: none), mask_input,
    has_mask_input and orig_im_size as far as it asks for them; low_res_masks (else masks) and iou_predictions.
    SAM 2's is known by its more than one embedding; it is stretched to the canvas.
    """

    PROMPTS = ("point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size")

    def __init__(self, folder: Path, encoder: Path, decoder: Path):
        try:
            import onnxruntime
        except ImportError:
            raise PaletteError(
                "These weights need ONNX Runtime: pip install --no-deps onnxruntime flatbuffers"
            ) from None
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        try:
            self.encoder, self.decoder = (
                onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
                for path in (encoder, decoder)
            )
        except Exception as error:  # ONNX Runtime's own kinds, of which none is public
            text = " ".join(str(error).split())[:300]
            raise PaletteError(f"The ONNX models in '{folder}' can't be loaded: {text}") from None
        asked = [each.name for each in self.decoder.get_inputs()]
        given = [each.name for each in self.encoder.get_outputs()]
        wanted = [name for name in asked if name not in self.PROMPTS]
        put_out = [each.name for each in self.decoder.get_outputs()]
        self.output = "low_res_masks" if "low_res_masks" in put_out else "masks"
        if (
            not {"point_coords", "point_labels"} <= set(asked)
            or not {self.output, "iou_predictions"} <= set(put_out)
            or not 0 < len(wanted) <= len(given)
            or len(self.encoder.get_inputs()) != 1
        ):
            raise PaletteError(
                f"The decoder '{decoder.name}' takes {', '.join(asked)} and gives {', '.join(put_out)}. Name a folder "
                f"with an image encoder and the decoder that Segment Anything's export script writes."
            )
        self.embeddings = dict(zip(wanted, wanted if set(wanted) <= set(given) else given, strict=False))
        (self.input,) = self.encoder.get_inputs()
        shape = self.input.shape
        self.raw = len(shape) == 3
        self.canvas = tuple(x if isinstance(x, int) else SIDE for x in (shape[:2] if self.raw else shape[2:]))
        self.asked, self.stretches = asked, len(wanted) > 1

    def look(self, canvas: np.ndarray) -> None:
        batch = canvas if self.raw else np.ascontiguousarray(canvas.transpose(2, 0, 1)[None])
        names = [each.name for each in self.encoder.get_outputs()]
        found = dict(zip(names, self.encoder.run(None, {self.input.name: batch}), strict=True))
        self.embedding = {name: found[source] for name, source in self.embeddings.items()}

    def masks(
        self, points: np.ndarray, labels: np.ndarray, box: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        # without a box the exported prompt encoder wants a point that is none
        more, kinds = ([box[:2], box[2:]], [2, 3]) if box is not None else ([[0, 0]], [-1])
        found = []
        for at, kind in zip(points, labels, strict=True):  # the decoder's batch is one prompt
            side = max(self.canvas) // 4
            prompts = {
                "point_coords": np.concatenate([at, np.array(more, np.float32)])[None],
                "point_labels": np.concatenate([kind, kinds]).astype(np.float32)[None],
                "mask_input": np.zeros((1, 1, side, side), np.float32),
                "has_mask_input": np.zeros(1, np.float32),
                "orig_im_size": np.array(self.canvas, np.float32),
            }
            feed = self.embedding | {name: prompts[name] for name in self.asked if name in prompts}
            found.append(self.decoder.run([self.output, "iou_predictions"], feed))
        logits, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
        if logits.shape[1] == 4:  # the first is for many clicks; without it, as transformers has them
            logits, scores = logits[:, 1:], scores[:, 1:]
        return logits, scores


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
    found, small = [], []
    for mask in masks:
        (found if mask.mean() >= LEAST_SHARE and holds_texture(mask) else small).append(mask)
    if small:
        warn(too_small(len(small), np.sum(small) / pixels[..., 0].size))
    if len(found) > regions:
        warn(f"Segment Anything found {len(found)} regions; the {regions} largest are kept.")
    progress(1.0, "Segmenting")
    return [Region(f"region_{number}", mask) for number, mask in enumerate(found[:regions], 1)]


def _load(folder: str | Path | None) -> _Transformers | _Onnx:
    wanted = (
        "a folder with config.json and model.safetensors of a 'sam' or 'sam2' model in transformers' form, or with "
        "*encoder*.onnx and *decoder*.onnx"
    )
    if folder is None:
        raise PaletteError(f"Segmentation 'sam' needs weights: name {wanted} with --weights DIR.")
    folder = Path(folder)
    parts = [sorted(folder.glob(f"*{part}*.onnx")) for part in ("encoder", "decoder")]
    if any(parts):
        if [len(files) for files in parts] != [1, 1]:
            count = " and ".join(str(len(files)) for files in parts)
            raise PaletteError(
                f"'{folder}' holds {count} files *encoder*.onnx and *decoder*.onnx; one of each is needed."
            )
        return _Onnx(folder, parts[0][0], parts[1][0])
    try:
        kind = json.loads((folder / "config.json").read_text(encoding="utf-8")).get("model_type")
    except (OSError, ValueError, AttributeError):
        raise PaletteError(f"'{folder}' holds no readable config.json. Name {wanted}.") from None
    kind = {"sam2_video": "sam2"}.get(kind, kind)  # how SAM 2 is published; its image part is the same
    if kind not in ("sam", "sam2"):
        raise PaletteError(f"'{folder}' holds a model of type '{kind}'. Name {wanted}.")
    if not list(folder.glob("*.safetensors")):
        raise PaletteError(f"'{folder}' holds no safetensors file (pickled weights aren't read). Name {wanted}.")
    return _Transformers(folder, kind)


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
