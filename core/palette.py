"""The pipeline: photo and regions in, a palette of tileable SVBRDF materials out. Knows nothing of Blender.

photo + regions -> exemplar -> concept -> texture -> SVBRDF -> reduced SVBRDF -> files
"""

import dataclasses
import hashlib
import json
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch

from . import brdf, decomposition, engines, front, rectification, reduction, sheet
from .delighting import LUMINANCE, log_mean
from .engines.diffusion import DiffusionSettings
from .errors import Cancelled, PaletteError, explain
from .exemplar import LEAST_SAID, WHITE_BALANCES, Exemplar, cut_exemplar, without_rim, without_white
from .image import linear_from_srgb, srgb_from_linear, write_image
from .mask import without_strays
from .material import SVBRDF
from .perceptual import Crops
from .region import EXEMPLARS, Region, check_names, check_region, file_name, write_geometry
from .sides import largest_side, same_hue
from .tensors import read_tensors, write_tensors
from .torus import resize

VERSION = 1  # of palette.json
QUALITIES = tuple(engines.patch.PRESETS)
RESOLUTION_RANGE = (64, 8192)
SCALE_RANGE = (0.25, 8.0)
LEAST_SAMPLED = 32  # px
CONCEPT_VERSION = 1
MOST_LEVEL = 0.5  # of log luminance, by which what is learnt from takes on the level of its whole region
PREVIEW = 256  # px
LEAST_FITTED = 16  # px
HEIGHTS_PER_PIXEL = 2.0  # of a picture, where the relief is displaced
LARGEST_ABREAST = 2048  # px: larger materials are finished one by one, for memory

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Settings:
    """What the user chooses; the same for every region.

    resolution is the side of the square maps in px; metres_per_tile the length that one repeat covers on an object,
    where a region's measure does not tell; rectify: "auto" brings a slanted region to the front, by its corners or by
    the plane that is found, "quad" by its corners only, "off" never; flatten takes slow changes of light and cast
    shadows out of a region; white_balance "region" takes the region's mean for grey, "card"
    takes grey_card, the linear colour of the photo's grey card, for a reflectance of 18 %. scale is how much larger the
    texture is shown than the photo shows it; the tile's area shrinks by as much. keep_concepts: each material's concept
    is kept and written, to sample others from. full_maps: nothing is reduced. target_error:
    each region's quality is the cheapest predicted to meet it (core/front.py), not `quality`. diffusion: settings of
    the engine of that name.
    """

    engine: str = "patch"
    decomposer: str = "unet"
    quality: str = "balanced"
    resolution: int = 1024
    seed: int = 0
    rectify: str = "auto"
    flatten: bool = True
    white_balance: str = "off"
    grey_card: tuple[float, float, float] | None = None
    metres_per_tile: float = 1.0
    diffusion: DiffusionSettings | None = None
    scale: float = 1.0
    keep_concepts: bool = False
    full_maps: bool = False
    target_error: float | None = None

    def check(self) -> None:
        """Raise PaletteError naming the first setting that cannot be honoured."""
        if self.engine not in engines.ENGINES:
            raise PaletteError(f"engine '{self.engine}' is unknown; choose one of: {', '.join(engines.ENGINES)}")
        decomposition.choose(self.decomposer)
        if self.quality not in QUALITIES:
            raise PaletteError(f"quality '{self.quality}' is unknown; choose one of: {', '.join(QUALITIES)}")
        least, most = RESOLUTION_RANGE
        if not least <= self.resolution <= most:
            raise PaletteError(f"resolution {self.resolution} px is out of range; choose {least} to {most} px")
        if not 0 <= self.seed < 2**63:
            raise PaletteError(f"seed {self.seed} is out of range; choose a whole number from 0 to 2^63 - 1")
        if self.rectify not in rectification.MODES:
            raise PaletteError(f"rectify '{self.rectify}' is unknown; choose one of: {', '.join(rectification.MODES)}")
        if self.white_balance not in WHITE_BALANCES:
            raise PaletteError(
                f"white balance '{self.white_balance}' is unknown; choose one of: {', '.join(WHITE_BALANCES)}"
            )
        if self.white_balance == "card" and not (self.grey_card and min(self.grey_card) > 0):
            raise PaletteError("white balance 'card' needs the grey card's colour in the photo: name or pick the card")
        if self.target_error is not None:
            front.check(self.target_error)
            if self.engine != "patch":
                raise PaletteError(f"a target error can be met by engine 'patch' only, not by '{self.engine}'")
        if not (0 < self.metres_per_tile < float("inf")):
            raise PaletteError(f"metres per tile is {self.metres_per_tile}; choose a positive length")
        if self.engine == "diffusion":
            (self.diffusion or DiffusionSettings()).check()
            if self.keep_concepts:
                raise PaletteError(
                    "concepts of the engine 'diffusion' can't be kept beside the maps; name a folder of theirs "
                    "(--concepts DIR), from which another extraction takes them, or leave --keep-concepts out"
                )
        least, most = SCALE_RANGE
        if not least <= self.scale <= most:
            raise PaletteError(f"scale {self.scale:g} is out of range; choose {least:g} to {most:g}")
        if not LEAST_SAMPLED <= self.sampled <= RESOLUTION_RANGE[1]:
            raise PaletteError(
                f"resolution {self.resolution} px at scale {self.scale:g} needs a texture of {self.sampled} px; "
                f"{LEAST_SAMPLED} to {RESOLUTION_RANGE[1]} can be made. Choose another resolution or scale"
            )

    @property
    def sampled(self) -> int:
        """Side in px of the texture at the photo's own scale."""
        return round(self.resolution / self.scale)


@dataclass
class Material:
    """One region's outcome. status is "ok", or "failed" with the reason in error and no SVBRDF.

    exemplar (h, w, 3), dark where nothing is learnt from, and texture (H, W, 3) are sRGB-encoded uint8 for looking at;
    preview (256, 256, 4) float32 is a rendered sphere, sRGB-encoded RGBA; seconds are per stage; reduced is the
    ledger of `reduction.reduce` and bits are those of the maps; rectification is the record for palette.json.
    """

    name: str
    status: str = "ok"
    svbrdf: SVBRDF | None = None
    reduced: list[dict] = field(default_factory=list)
    bits: dict[str, int] = field(default_factory=lambda: dict.fromkeys(reduction.KINDS, 8))
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    error: str | None = None
    metres_per_tile: float = 1.0
    rectification: dict = field(default_factory=lambda: {"method": "off"})
    exemplar: np.ndarray | None = None
    texture: np.ndarray | None = None
    preview: np.ndarray | None = None
    target: dict | None = None  # the error asked for, the preset chosen, the error predicted and the one found
    concept: tuple[dict[str, np.ndarray], dict] | None = None  # as engines save it; None: not asked for, or a constant


@dataclass
class Palette:
    """photo (H, W, 3) float32 linear, its regions and, in the same order, their materials; photo None and no regions
    where the materials were sampled from saved concepts.

    scale: px of the photo per px of its file.
    """

    photo: np.ndarray | None
    photo_name: str
    regions: list[Region]
    settings: Settings
    materials: list[Material]
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    scale: float = 1.0


def extract_palette(
    pixels: np.ndarray,
    regions: list[Region],
    settings: Settings,
    progress: Progress,
    on_material: Callable[[Material], None] | None = None,
    photo_name: str = "",
    focal: float | None = None,
) -> Palette:
    """Extract one material per region of a photo (H, W, 3) float32 linear.

    A region that cannot be extracted becomes a material with status "failed"; the others are finished. on_material is
    called with each material as soon as it is done, in their order but on another thread, as progress may be. focal is
    the photo's focal length in px where it is known. progress may raise Cancelled, which ends the call.
    Raises PaletteError for settings that cannot be honoured, weights that cannot be read, when there is no region and
    for two of one file name.
    """
    settings.check()
    if not regions:
        raise PaletteError("there is no region; paint one or choose automatic segmentation")
    check_names(regions)
    decomposition.prepare(settings.decomposer)
    start = time.perf_counter()
    engine = engines.open_engine(settings.engine, settings.diffusion)
    palette = Palette(pixels, photo_name, regions, settings, [])
    progress = _onward(progress)
    view = None
    # engines leave a part of the cores free: what comes behind them is done for one region while the next is sampled
    with _one_thread_each(), ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) as behind:
        if settings.rectify == "auto" and any(region.corners is None for region in regions):
            progress(0.0, "looking for lines")
            with _timed(palette.seconds, "look"):
                view = rectification.look(pixels, focal)
        finishing: list[Future[Material]] = []
        for i, region in enumerate(regions):
            share = _part(progress, i / len(regions), (i + 1) / len(regions), f"{region.name}: ")
            try:
                material, texture = _textured(pixels, region, settings, share, view, focal, engine)
            except Cancelled:
                raise
            except Exception as error:  # whatever it is, it costs one region, not the palette
                material, texture = _failed(region.name, error, settings), None
            if finishing:
                finishing[-1].result()  # what failed there ends it here
            finishing.append(behind.submit(_end_of, material, texture, settings, share, on_material))
            if settings.resolution > LARGEST_ABREAST:
                finishing[-1].result()
        palette.materials += [future.result() for future in finishing]
    progress(1.0, "done")
    for material in palette.materials:
        for stage, seconds in material.seconds.items():
            palette.seconds[stage] = palette.seconds.get(stage, 0.0) + seconds
    palette.seconds["extract"] = time.perf_counter() - start
    return palette


def _failed(name: str, error: Exception, settings: Settings) -> Material:
    return Material(name, "failed", error=explain(error), metres_per_tile=settings.metres_per_tile)


def _end_of(material: Material, texture, settings, progress: Progress, on_material) -> Material:
    if material.error is None:
        try:
            _finish(material, texture, settings, progress)
        except Cancelled:
            raise
        except Exception as error:
            material = _failed(material.name, error, settings)
    if on_material:
        on_material(material)
    return material


def _onward(progress: Progress) -> Progress:
    """Progress that two threads may call and that never goes back."""
    lock, at = threading.Lock(), 0.0

    def both(fraction: float, message: str) -> None:
        nonlocal at
        with lock:
            at = max(at, fraction)
            progress(at, message)

    return both


@contextmanager
def _one_thread_each():
    """Engines share their work among threads of their own, each with one torch thread. Threads within an operation wait
    on each other when a core is busy with something else, such as Blender's window, and lose more than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def extract_material(
    pixels: np.ndarray,
    region: Region,
    settings: Settings,
    progress: Progress,
    view: rectification.View | None = None,
    focal: float | None = None,
    engine=None,
) -> Material:
    """Extract the material of one region of a photo (H, W, 3) float32 linear.

    view is what `rectification.look` finds in the photo, None: it is looked at here; focal as `extract_palette` takes;
    engine is one that is open already.
    Raises PaletteError for settings that cannot be honoured and for a region too small to hold a texture.
    """
    settings.check()
    material, texture = _textured(pixels, region, settings, progress, view, focal, engine)
    _finish(material, texture, settings, progress)
    return material


def _textured(pixels, region, settings, progress, view, focal, engine) -> tuple[Material, np.ndarray]:
    """The material of a region so far, and its texture, which `_finish` takes: (H, W, 3) float32 sRGB-encoded at the
    photo's scale, or the linear colour (3,) of a uniform region."""
    check_region(region)
    engine = engine or engines.open_engine(settings.engine, settings.diffusion)
    learnt = 0.03 + 0.83 * engine.LEARNING_SHARE
    material = Material(region.name, metres_per_tile=settings.metres_per_tile)
    seconds = material.seconds

    with _timed(seconds, "rectify"):
        flat = _rectified(pixels, region, settings, view, focal, progress)
        material.warnings += flat.warnings
        material.rectification = flat.record()
        if region.measure is not None:
            material.metres_per_tile = settings.sampled * rectification.metres_per_texel(*region.measure, flat)
    with _timed(seconds, "exemplar"):
        exemplar = _exemplar(flat, settings, _part(progress, 0.02, 0.03))
        encoded = srgb_from_linear(np.clip(exemplar.pixels, 0, 1))
        material.warnings += exemplar.warnings
        material.exemplar = exemplar.picture()

    if exemplar.uniform is not None:
        material.warnings.append("the region has one colour up to noise; the material is a constant")
        return material, exemplar.uniform
    with _timed(seconds, "learn"):
        concept = engine.learn(encoded, exemplar.mask, _part(progress, 0.03, learnt))
    if settings.keep_concepts:
        tensors, facts = engine.to_tensors(concept)
        facts |= {
            "engine": settings.engine,
            "metres_per_texel": material.metres_per_tile / settings.sampled,
            "rectification": material.rectification,
        }
        material.concept = tensors, facts
    judge = None
    if settings.target_error is not None:
        settings, judge = _cheapest(material, encoded, exemplar.mask, settings)
    return material, _sample(material, engine, concept, settings, progress, learnt, judge)


def _cheapest(material: Material, encoded: np.ndarray, mask: np.ndarray, settings: Settings):
    """Settings of the cheapest quality predicted to meet the error asked, and what judges its texture; both go into
    the material's record."""
    with _timed(material.seconds, "target"):
        quality, predicted, meets = front.choose(front.spread(encoded, mask), settings.target_error)
    material.target = {"asked": settings.target_error, "quality": quality, "predicted": round(predicted, 4)}
    if not meets:
        material.warnings.append(
            f"no quality is predicted to meet the error {settings.target_error:g} asked of this region; "
            f"'{quality}' comes nearest, {predicted:.3f}"
        )

    def judge(pixels: np.ndarray) -> None:
        crops = Crops(encoded, mask)
        found = crops.distance(pixels) if crops.found and min(pixels.shape[:2]) >= Crops.SIDE else None
        material.target["found"] = None if found is None else round(found, 4)

    return dataclasses.replace(settings, quality=quality), judge


def resample_material(path: Path, settings: Settings, progress: Progress) -> Material:
    """Another material of a concept that `write_material` saved: at another resolution, seed, quality or scale.

    path: the concept's .json or .safetensors, which lie side by side. metres_per_tile follows from the concept.
    Raises PaletteError for settings that cannot be honoured and for files that hold no concept.
    """
    settings.check()
    decomposition.prepare(settings.decomposer)
    progress(0.0, "reading the concept")
    try:
        path = path.with_suffix(".json")
        facts = json.loads(path.read_text(encoding="utf-8"))
        if facts["version"] != CONCEPT_VERSION:
            raise ValueError(f"version {facts['version']}, this extension reads {CONCEPT_VERSION}")
        tensors, _ = read_tensors(path.with_suffix(".safetensors"))
        engine = engines.open_engine(facts["engine"], None)
        with _one_thread_each():
            concept = engine.from_tensors(tensors, facts, _part(progress, 0.0, 0.06))
        metres = float(facts["metres_per_texel"]) * settings.sampled
        dataclasses.replace(settings, metres_per_tile=metres).check()
        material = Material(facts["name"], metres_per_tile=metres, rectification=dict(facts["rectification"]))
        file_name(material.name)
    except PaletteError as error:
        raise PaletteError(f"'{path}': {error}") from error
    except OSError as error:
        raise PaletteError(f"cannot read '{path}': {error.strerror or error}") from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise PaletteError(f"'{path}' holds no concept that can be read ({error}); extract it again") from error
    with _one_thread_each():
        _finish(material, _sample(material, engine, concept, settings, progress, 0.06), settings, progress)
    return material


def _sample(material: Material, engine, concept, settings, progress: Progress, start: float, judge=None) -> np.ndarray:
    with _timed(material.seconds, "sample"):
        size = settings.sampled, settings.sampled
        texture = engine.sample(concept, size, settings.seed, _part(progress, start, 0.86), settings.quality)
        material.warnings += getattr(texture, "warnings", [])
        pixels = texture.pixels
        if judge is not None:
            judge(pixels)
    return pixels


def _finish(material: Material, texture: np.ndarray, settings: Settings, progress: Progress) -> None:
    """From the texture, as `_textured` gives it, to the material's least maps and its picture."""
    seconds = material.seconds
    with _timed(seconds, "decompose"):
        if texture.ndim == 1:
            svbrdf = decomposition.constant(texture)
        else:
            if settings.sampled != settings.resolution:
                texture = np.clip(resize(texture, (settings.resolution, settings.resolution)), 0, 1)
            material.texture = sheet.thumbnail(np.tile(texture, (2, 2, 1)))
            svbrdf = decomposition.decompose(
                linear_from_srgb(texture), _part(progress, 0.86, 0.96), settings.decomposer
            )
    with _timed(seconds, "reduce"):
        material.svbrdf = svbrdf
        if not settings.full_maps:
            found = reduction.reduce(svbrdf, _part(progress, 0.96, 0.99))
            material.svbrdf, material.reduced, material.bits = found.svbrdf, found.ledger, found.bits
            material.metres_per_tile /= found.parts
    with _timed(seconds, "preview"):
        material.preview = _preview(material.svbrdf)
    progress(1.0, "done")


def _preview(svbrdf: SVBRDF) -> np.ndarray:
    sphere = brdf.render_sphere(svbrdf, PREVIEW)
    return np.concatenate([srgb_from_linear(sphere[..., :3]), sphere[..., 3:]], -1)


def fit_material(
    material: Material,
    pixels: float,
    progress: Progress,
    displaced: bool = False,
    visible: float = reduction.VISIBLE,
) -> None:
    """Leave in a material, whose tile is shown `pixels` long at most, what can then be told from the whole.

    displaced: its height is displayed, so that normals which don't show are no reason to drop it. visible: the error
    that may be made, FLIP in [0, 1].
    """
    full = material.svbrdf
    with _timed(material.seconds, "fit"):
        # of what no camera sees anything will do
        found = reduction.reduce(full, progress, visible if pixels else 1.0, 1, max(pixels, LEAST_FITTED))
        if displaced:
            side = max(LEAST_FITTED, math.ceil(pixels * HEIGHTS_PER_PIXEL))
            found.svbrdf.height = reduction.shrink(full, side).height
        # what was constant before stands in the ledger already
        known = {(e["map"], e["change"]) for e in material.reduced}
        material.reduced = [*material.reduced, *(e for e in found.ledger if (e["map"], e["change"]) not in known)]
        material.svbrdf, material.bits = found.svbrdf, found.bits
        material.preview = _preview(material.svbrdf)


def read_palette(folder: Path) -> tuple[dict, list[Material], Settings]:
    """What palette.json holds, its materials and settings. Raises PaletteError for a folder that holds no palette."""
    try:
        content = json.loads((folder / "palette.json").read_text(encoding="utf-8"))
        if content["version"] != VERSION:
            raise ValueError(f"version {content['version']}, this extension reads {VERSION}")
        known = {f.name for f in dataclasses.fields(Settings)} - {"diffusion"}
        settings = Settings(**{name: value for name, value in content["settings"].items() if name in known})
        return content, [read_material(record, folder) for record in content["materials"]], settings
    except OSError as error:
        raise PaletteError(f"cannot read '{folder / 'palette.json'}': {error.strerror or error}") from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise PaletteError(f"'{folder}' holds no palette that can be read ({error}); extract it again") from error


def read_material(record: dict, folder: Path) -> Material:
    """The material of a record that `write_material` has returned, from its files below `folder`.

    Raises PaletteError for a file that is missing, or that is no map.
    """
    material = Material(
        record["name"],
        record["status"],
        reduced=list(record["reduced"]),
        warnings=list(record["warnings"]),
        seconds=dict(record["seconds"]),
        error=record["error"],
        metres_per_tile=record["metres_per_tile"],
        rectification=record["rectification"],
        target=record.get("target"),
    )
    if material.status != "ok":
        return material

    def read(kind: str) -> np.ndarray:
        entry = record["maps"][kind]
        if "value" in entry:
            return np.asarray(entry["value"], np.float32)
        pixels = cv2.imread(str(folder / entry["file"]), cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.ndim != (2 if kind in ("roughness", "height") else 3):
            raise PaletteError(f"'{folder / entry['file']}' is missing or no map of kind {kind}; extract it again")
        material.bits[kind] = 8 * pixels.itemsize
        pixels = pixels / np.float32(np.iinfo(pixels.dtype).max)
        return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])

    albedo, normal, roughness, height = (read(kind) for kind in ("basecolor", "normal", "roughness", "height"))
    if normal.ndim > 1:
        normal = normal * 2 - 1
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    relief = record["maps"]["height"]
    material.svbrdf = SVBRDF(
        linear_from_srgb(albedo) if albedo.ndim > 1 else albedo,
        normal,
        roughness if roughness.ndim else float(roughness),
        (height - relief["midlevel"]) * relief["scale"] if height.ndim else None,
    )
    material.preview = _preview(material.svbrdf)
    if record["exemplar"]:
        picture = cv2.imread(str(folder / record["exemplar"]))
        material.exemplar = None if picture is None else np.ascontiguousarray(picture[..., ::-1])
    return material


def preview_exemplar(
    pixels: np.ndarray, region: Region, settings: Settings, progress: Progress, focal: float | None = None
) -> tuple[np.ndarray, list[str]]:
    """What `extract_material` would learn from, as a picture (h, w, 3) uint8 sRGB-encoded, and the warnings."""
    settings.check()
    check_region(region)
    flat = _rectified(pixels, region, settings, None, focal, _part(progress, 0.0, 0.5))
    exemplar = _exemplar(flat, settings, _part(progress, 0.5, 1.0))
    return exemplar.picture(), flat.warnings + exemplar.warnings


def _exemplar(flat: rectification.Rectification, settings: Settings, progress: Progress) -> Exemplar:
    progress(0.0, "cutting the exemplar")
    balance = np.float32(settings.grey_card) if settings.white_balance == "card" else settings.white_balance
    return cut_exemplar(flat.pixels, flat.mask, settings.flatten, balance, progress, flat.level)


def _rectified(pixels, region, settings, view, focal, progress) -> rectification.Rectification:
    """The region seen from the front, or as it is; of a region on a solid's several sides the largest."""
    whole, warnings = without_strays(region.mask), []
    if whole is not region.mask:
        share = 1 - whole.sum() / region.mask.sum()
        if share > LEAST_SAID:
            warnings.append(f"{share:.0%} of the region, pieces beside it, is left out")
    mask = without_rim(whole)
    if settings.flatten and region.corners is None:
        progress(0.0, "looking for the sides of the region")
        side = largest_side(pixels, mask)
        if side is not mask:
            share = 1 - side.sum() / mask.sum()
            warnings.append(f"{share:.0%} of the region, on another side or in another light, is left out")
            whole = whole if same_hue(pixels, side, mask & ~side) else side
            mask = side
    # before it is rectified: a near part that is white would outweigh a far one that is not
    mask = without_white(pixels, mask, warnings)
    if settings.rectify == "off" or (settings.rectify == "quad" and region.corners is None):
        flat = rectification.Rectification(pixels, mask)
    else:
        progress(0.1, "rectifying")
        if region.corners is not None:
            flat = rectification.rectify_corners(pixels, mask, region.corners, focal)
        else:
            flat = rectification.rectify(pixels, mask, view or rectification.look(pixels, focal))
    flat.warnings[:0] = warnings
    if flat.mask is not whole:
        brighter = (log_mean(pixels, whole) - log_mean(flat.pixels, flat.mask)) @ LUMINANCE
        flat.level = float(np.exp(np.clip(brighter, -MOST_LEVEL, MOST_LEVEL)))
    return flat


def write_material(material: Material, folder: Path) -> dict:
    """Write a material's maps and its .json into `folder` (made if missing); return its record for palette.json.

    What it was learnt from is written into EXEMPLARS beside the folder.

    Files in the record are relative to the folder's parent. Normal Map convention is OpenGL (+Y up).
    """
    name = file_name(material.name)
    record = {
        "name": material.name,
        "status": material.status,
        "exemplar": None,
        "maps": {},
        "metres_per_tile": material.metres_per_tile,
        "rectification": material.rectification,
        "seconds": {stage: round(s, 3) for stage, s in material.seconds.items()},
        "reduced": material.reduced,
        "warnings": material.warnings,
        "error": material.error,
    }
    if material.target is not None:
        record["target"] = material.target
    if material.exemplar is not None:
        record["exemplar"] = f"{EXEMPLARS}/{name}.png"
        (folder.parent / EXEMPLARS).mkdir(parents=True, exist_ok=True)
        write_image(folder.parent / record["exemplar"], material.exemplar / np.float32(255))
    if material.svbrdf is None:
        return record
    folder.mkdir(parents=True, exist_ok=True)

    def entry(kind: str, value: np.ndarray | float, encoded: np.ndarray | None, bits: int = 8, **more) -> None:
        if encoded is None:
            record["maps"][kind] = {"value": value.tolist() if isinstance(value, np.ndarray) else value}
        else:
            file = f"{name}_{kind}.png"
            write_image(folder / file, encoded, bits)
            record["maps"][kind] = {"file": f"{folder.name}/{file}", **more}

    svbrdf, bits = material.svbrdf, material.bits
    is_map = svbrdf.albedo.ndim > 1
    entry("basecolor", svbrdf.albedo, srgb_from_linear(svbrdf.albedo) if is_map else None, bits["basecolor"])
    entry("normal", svbrdf.normal, (svbrdf.normal + 1) / 2 if svbrdf.normal.ndim > 1 else None, bits["normal"])
    entry("roughness", svbrdf.roughness, svbrdf.roughness if np.ndim(svbrdf.roughness) else None, bits["roughness"])
    if svbrdf.height is None:
        entry("height", 0.0, None)
    else:
        # the 16 bits span the relief; height = (pixel - 0.5) * scale, in tile widths
        scale = max(2 * float(np.abs(svbrdf.height).max()), 1e-9)
        entry("height", 0.0, svbrdf.height / scale + 0.5, 16, scale=scale, midlevel=0.5)
    if material.concept is not None:
        write_concept(material, folder)
    _write_json(folder / f"{name}.json", record)
    return record


def write_concept(material: Material, folder: Path) -> Path:
    """Write a material's concept, which it has, into `folder` (made if missing); return the path of its .json."""
    tensors, facts = material.concept
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{file_name(material.name)}_concept.json"
    write_tensors(path.with_suffix(".safetensors"), tensors)
    _write_json(path, {"version": CONCEPT_VERSION, "name": material.name} | facts)
    return path


def write_palette(
    palette: Palette,
    folder: Path,
    progress: Progress = lambda fraction, message: None,
    written: dict[str, dict] | None = None,
    referred: bool = True,
) -> dict:
    """Write maps, masks/, palette.json and palette.png into an empty folder; return what palette.json holds.

    written: records, by name, of materials that `write_material` has put into the folder already; referred: who has
    done so refers to their files by now, so that none of them is dropped.
    """
    start = time.perf_counter()
    records = []
    for i, material in enumerate(palette.materials):
        progress(0.8 * i / len(palette.materials), f"writing {material.name}")
        record = (written or {}).get(material.name)
        records.append(record or write_material(material, folder / file_name(material.name)))
    if not (written and referred):
        _store_once(records, folder)
    if palette.regions:
        (folder / "masks").mkdir()
    for region in palette.regions:
        write_image(folder / "masks" / f"{file_name(region.name)}.png", region.mask.astype(np.float32))
    write_geometry(palette.regions, folder / "masks", palette.scale)
    progress(0.85, "writing the contact sheet")
    write_image(folder / "palette.png", sheet.contact_sheet(palette))
    seconds = palette.seconds | {"write": time.perf_counter() - start}
    content = {
        "version": VERSION,
        "photo": palette.photo_name,
        "settings": dataclasses.asdict(palette.settings),
        "seconds": {stage: round(s, 3) for stage, s in seconds.items()},
        "warnings": palette.warnings,
        "materials": records,
    }
    _write_json(folder / "palette.json", content)
    progress(1.0, "written")
    return content


def _store_once(records: list[dict], folder: Path) -> None:
    """Maps of the same bits become one file, that of the first material which has it."""
    first = {}
    for record in records:
        changed = False
        for entry in record["maps"].values():
            if "file" not in entry:
                continue
            path = folder / entry["file"]
            same = first.setdefault(hashlib.sha256(path.read_bytes()).digest(), entry["file"])
            if same != entry["file"]:
                entry["file"], changed = same, True
                path.unlink()
        if changed:
            name = file_name(record["name"])
            _write_json(folder / name / f"{name}.json", record)


def _write_json(path: Path, content: dict) -> None:
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _part(progress: Progress, start: float, end: float, prefix: str = "") -> Progress:
    """Progress of a stage, mapped to its part of the whole; exact at both ends, so that the whole never steps back."""
    return lambda fraction, message: progress((1 - fraction) * start + fraction * end, prefix + message)


@contextmanager
def _timed(seconds: dict[str, float], stage: str):
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start
