"""CLIP's class of a picture without training: at which place of a list of classes it puts the true one.

Source: Radford et al. 2021; the paper's table of resemblance has the shares of first places and of the first five. The
weights are the user's: a folder with `config.json`, `model.safetensors` and the tokenizer's files, as CLIP is passed
on. Needs transformers (requirements-diffusion.txt).
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)  # of CLIP's training
PROMPT = "a close-up photo of {}, a material"


class ZeroShot:
    """classes: their names, as people say them. Raises OSError or ValueError where the folder holds no CLIP."""

    def __init__(self, folder: Path, classes: Sequence[str]):
        from transformers import CLIPModel, CLIPTokenizer

        self.classes = list(classes)
        self._model = CLIPModel.from_pretrained(folder, local_files_only=True).eval()
        tokenizer = CLIPTokenizer.from_pretrained(folder, local_files_only=True)
        prompts = [PROMPT.format(name.replace("_", " ")) for name in self.classes]
        with torch.no_grad():
            text = self._model(
                **tokenizer(prompts, padding=True, truncation=True, return_tensors="pt"),
                pixel_values=torch.zeros(1, 3, self._side, self._side),
            )
        self._text = text.text_embeds

    @property
    def _side(self) -> int:
        return self._model.config.vision_config.image_size

    def rank(self, picture: np.ndarray, name: str) -> int:
        """Place of class `name` among all, 1 the likeliest, for a picture (H, W, 3) sRGB-encoded in [0, 1]."""
        small = cv2.resize(
            np.ascontiguousarray(picture, np.float32), (self._side, self._side), interpolation=cv2.INTER_AREA
        )
        pixels = torch.from_numpy((small - np.float32(MEAN)) / np.float32(DEVIATION)).permute(2, 0, 1)[None]
        with torch.no_grad():
            seen = self._model.visual_projection(self._model.vision_model(pixel_values=pixels).pooler_output)
        likeness = (torch.nn.functional.normalize(seen, dim=-1) @ self._text.T)[0]
        return 1 + int((likeness > likeness[self.classes.index(name)]).sum())
