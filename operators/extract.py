"""Extract Palette: the enabled regions of the photo become materials, on a background thread, one after the other."""

import base64
import contextlib
import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from bpy.types import Operator

from ..core.errors import Abandoned, Cancelled, PaletteError, explain
from . import history
from .background import BackgroundOperator
from .palette import active_entry, drop_before, put_in_palette, region_of
from .photo import photo_focal, photo_reader, photo_scale
from .preferences import decomposer, diffusion_settings
from .rectify import corners_of, measure_of
from .regions import read_photo_mask

_EXTRACTION = 0.95  # share of the time; the rest is writing


@dataclass
class _Made:
    """One region's outcome: the region's key, its record as in palette.json, the folder of its files."""

    key: int
    record: dict
    folder: Path
    preview: np.ndarray | None


@dataclass
class _Extracted:
    """What the worker hands over at the end. folder: where the files are now; staging: where they were before."""

    made: list[_Made]
    folder: Path
    staging: Path
    temporary: bool
    cancelled: bool = False


@dataclass
class _Order:
    """What is wanted, read from the scene: photo, masks by region name, settings of core.palette."""

    read: object
    photo_name: str
    masks: dict
    keys: dict
    chosen: dict
    folder: Path | None
    overwrite: bool
    temporary: str | None
    geometry: dict  # by region name: corners and measure, in px of a photo of `size`
    size: tuple
    scale: float  # px of that photo per px of its file
    focal: float | None  # in longer sides of the photo
    diffusion: dict = field(default_factory=dict)  # settings of that engine
    warnings: list = field(default_factory=list)


class _Extracts(BackgroundOperator):
    """Mixin: `regions(context)` names what to extract, `seed(context)` with what."""

    kept = None  # the concept as a material keeps it, where it is not learnt anew

    def prepare(self, context):
        settings = context.scene.material_palette
        order = _read_order(settings, self.regions(context), self.seed(context), self.is_whole)
        self.pack = settings.pack
        self.replaces_files = order.overwrite
        self.chosen = order.chosen
        self.description = f"Extracted from {order.photo_name}"
        self.built = {}  # region key: session_uid of its material
        for region in settings.regions:
            if region.key in order.keys.values():
                region.error = ""
        return lambda progress, send: _work(order, progress, send)

    def receive(self, context, scene, made):
        # what can't be built now, as when the files are on their way to their folder, is built or named at the end;
        # packed until then, since the files may yet be taken back
        with contextlib.suppress(Exception):
            self._take(scene.material_palette, made, pack=True)

    def _take(self, settings, made, pack):
        """Put the material of `made` into the palette unless it is there: undo may have taken it back meanwhile."""
        from ..core import nodes

        if made.record["status"] != "ok" or self.built.get(made.key) in {m.session_uid for m in bpy.data.materials}:
            return
        material = nodes.build_material(made.record, made.folder, pack=pack, preview=made.preview)
        try:
            nodes.mark_asset(material, self.description, settings.author, settings.licence)
        except BaseException:
            nodes.remove_material(material)
            raise
        _keep_concept(material, made, self.kept)
        entry = put_in_palette(settings, made.key, material)
        entry.name = made.record["name"]
        entry.seed = self.chosen["seed"]
        entry.warnings = "\n".join([*made.record["warnings"], *_target(made.record)])
        self.built[made.key] = material.session_uid

    def finish(self, context, scene, result):
        from ..core import nodes

        settings = scene.material_palette
        if not self.pack:
            for material in bpy.data.materials:
                if material.session_uid in self.built.values():
                    nodes.unpack(material, result.folder)
        for made in result.made:
            made.folder = result.folder
            try:
                self._take(settings, made, self.pack)
            except Exception as error:
                made.record |= {"status": "failed", "error": explain(error)}
            region = region_of(settings, made.key)
            if region is not None:
                region.error = made.record["error"] or ""
        if self.replaces_files:  # those of the materials before
            drop_before(settings, self.built)
        failed = [made.record for made in result.made if made.record["status"] != "ok"]
        if len(failed) == len(result.made):
            raise PaletteError("No material was made. " + _say(failed))
        if self.kept is None and not self.chosen["target_error"]:  # of which the quality isn't that of all
            history.add(self.chosen, [made.record for made in result.made])
        said = f"{_count(len(result.made) - len(failed))} made"
        if result.cancelled:
            said = f"Cancelled: {_count(len(result.made) - len(failed))} finished before"
        self.report({"WARNING"} if failed else {"INFO"}, ". ".join([said, *([_say(failed)] if failed else [])]))

    @staticmethod
    def discard(result):
        if result.temporary:
            shutil.rmtree(result.staging, ignore_errors=True)


class MATERIAL_PALETTE_OT_extract(_Extracts, Operator):
    """Make a tileable material of every enabled region of the photo. Esc cancels and keeps what is finished"""

    bl_idname = "material_palette.extract"
    bl_label = "Extract Palette"

    only_active: bpy.props.BoolProperty(
        name="Only the Active Region", description="Extract the active region alone", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, context, properties):
        return "Make a material of the active region alone. Esc cancels" if properties.only_active else cls.__doc__

    @property
    def is_whole(self):
        return not self.only_active

    def regions(self, context):
        settings = context.scene.material_palette
        if not self.only_active:
            return [region for region in settings.regions if region.enabled]
        return list(settings.regions)[settings.active_region :][:1]

    def seed(self, context):
        return context.scene.material_palette.seed


class MATERIAL_PALETTE_OT_vary(_Extracts, Operator):
    """Extract the active material anew with the next seed. It takes the place of the one before, which is kept to be
    compared"""

    bl_idname = "material_palette.vary"
    bl_label = "Variation"

    is_whole = False

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        settings = context.scene.material_palette
        entry = active_entry(settings)
        if entry is None or region_of(settings, entry.key) is None:
            cls.poll_message_set(
                "The region that this material came from is gone" if entry else "Extract a palette first"
            )
            return False
        return True

    def regions(self, context):
        settings = context.scene.material_palette
        return [region_of(settings, active_entry(settings).key)]

    def seed(self, context):
        return _next(active_entry(context.scene.material_palette).seed)


class MATERIAL_PALETTE_OT_resample(_Extracts, Operator):
    """Make the active material anew from what was kept of its region, at the resolution, quality and scale that are
    chosen now. The photo isn't needed. It takes the place of the one before, which is kept to be compared"""

    bl_idname = "material_palette.resample"
    bl_label = "Resample"

    variation: bpy.props.BoolProperty(
        name="Variation", description="With the next seed, not the material's own", options={"SKIP_SAVE"}
    )
    needs_photo = False

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        entry = active_entry(context.scene.material_palette)
        if entry is None or entry.material is None or not entry.material.material_palette.concept:
            cls.poll_message_set("Nothing is kept of its region: turn on Keep Concepts, and extract it again")
            return False
        return True

    def prepare(self, context):
        settings = context.scene.material_palette
        entry = active_entry(settings)
        self.pack, self.replaces_files, self.built = settings.pack, False, {}
        self.kept = entry.material.material_palette.concept, entry.material.material_palette.concept_tensors
        asset = entry.material.asset_data
        self.description = asset.description if asset else ""
        self.chosen = sampling(settings, _next(entry.seed) if self.variation else entry.seed)
        folder = None if settings.pack else _unused(_output_folder(settings))
        work = self.kept, entry.key, self.chosen, folder, bpy.app.tempdir
        return lambda progress, send: _resample(*work, progress, send)


def _next(seed):
    return (seed + 1) % 2**31  # what an IntProperty holds


def _target(record):
    """What became of the error asked for, in words."""
    target = record.get("target")
    if target is None:
        return []
    found = "" if target.get("found") is None else f", found {target['found']:.3f}"
    asked, predicted = target["asked"], target["predicted"]
    return [f"Error asked {asked:.3f}, predicted {predicted:.3f}{found}: quality {target['quality']}"]


def sampling(settings, seed):
    return {
        "quality": settings.quality,
        "resolution": settings.resolution,
        "scale": settings.scale,
        "seed": seed,
        "decomposer": decomposer(bpy.context),
    }


def light(settings):
    """What the scene says of the photo's light, as `core.palette.Settings` take it."""
    card = tuple(settings.grey_card) if settings.white_balance == "card" else None
    return {"flatten": settings.flatten, "white_balance": settings.white_balance, "grey_card": card}


def _keep_concept(material, made, kept):
    """Put the concept that was written beside a material's maps, or that it was sampled from, into the material."""
    from ..core.region import file_name

    name = file_name(made.record["name"])
    path = made.folder / name / f"{name}_concept.json"
    if kept is None and path.exists():
        tensors = path.with_suffix(".safetensors").read_bytes()
        kept = path.read_text(encoding="utf-8"), base64.b64encode(tensors).decode("ascii")
    if kept is not None:
        material.material_palette.concept, material.material_palette.concept_tensors = kept


def _read_order(settings, regions, seed, is_whole):
    """Read from the scene what the worker needs; raises PaletteError naming what can't be used."""
    chosen = sampling(settings, seed) | {
        "engine": settings.engine,
        "rectify": settings.rectify,
        **light(settings),
        "metres_per_tile": settings.metres_per_tile,
        "keep_concepts": settings.keep_concepts and settings.engine == "patch",
        "target_error": (settings.target_error or None) if settings.engine == "patch" else None,
    }
    read = photo_reader(settings.photo)
    masks = _read_masks(settings, regions)
    order = _Order(
        read=read,
        photo_name=os.path.basename(settings.photo.filepath_raw) or settings.photo.name,
        masks=masks,
        keys={region.name: region.key for region in regions},
        chosen=chosen,
        folder=None,
        overwrite=False,
        temporary=bpy.app.tempdir,
        diffusion=diffusion_settings(bpy.context),
        geometry={region.name: (corners_of(region), measure_of(region)) for region in regions},
        size=tuple(settings.photo.size),
        scale=photo_scale(settings.photo),
        focal=settings.focal_length / 36.0 or photo_focal(settings.photo),
    )
    if not settings.pack:
        order.folder, order.overwrite = _output_folder(settings), settings.overwrite and is_whole
        if not is_whole:
            # a palette in the folder holds the textures of the other materials
            order.folder = _unused(order.folder)
        elif order.folder.is_dir() and any(order.folder.iterdir()) and not order.overwrite:
            raise PaletteError(f"Output folder isn't empty: {order.folder}. Choose another one, or turn on Overwrite")
    return order


def _read_masks(settings, regions):
    """The regions' masks as {name: (H, W) bool}; raises PaletteError naming the region that can't be used."""
    from ..core.region import file_name

    if not regions:
        raise PaletteError("No region to extract: add and paint one, import masks, or use Auto Segment")
    owners, masks = {}, {}
    for region in regions:
        owner = owners.setdefault(file_name(region.name).casefold(), region)
        if owner != region:
            raise PaletteError(f"Regions '{owner.name}' and '{region.name}' would share one file name; rename one")
        masks[region.name] = read_photo_mask(region, settings.photo)
    return masks


def _output_folder(settings):
    if settings.output_folder.startswith("//") and not bpy.data.filepath:
        raise PaletteError("Output folder is relative to a file that isn't saved yet: save it, or pack the textures")
    if not settings.output_folder.strip():
        raise PaletteError("No output folder: choose one, or pack the textures")
    return Path(os.path.normpath(bpy.path.abspath(settings.output_folder)))


def _unused(folder):
    number, unused = 1, folder
    while unused.exists():
        number += 1
        unused = folder.with_name(f"{folder.name}_{number}")
    return unused


def _work(order, progress, send):
    """Everything that happens on the worker; touches no bpy."""
    # importing torch takes seconds, which the window shouldn't wait for
    progress(0.0, "Getting ready")
    from ..core.engines.diffusion import DiffusionSettings
    from ..core.output import staged
    from ..core.palette import Settings
    from ..core.region import Region, add_geometry

    diffusion = DiffusionSettings(**order.diffusion) if order.chosen["engine"] == "diffusion" else None
    settings = Settings(**order.chosen, diffusion=diffusion)
    settings.check()
    progress(0.0, "Reading the photo")
    pixels, order.warnings = order.read()
    shape, scale = pixels.shape[:2], pixels.shape[1] / order.size[0]
    regions = [Region(name, nearest(mask, shape)) for name, mask in order.masks.items()]
    for region in regions:
        add_geometry([region], *({region.name: g} if g is not None else {} for g in order.geometry[region.name]), scale)
    place = staged(order.folder, order.overwrite) if order.folder else _temporary(order.temporary)
    with place as staging:
        made, cancelled = _extract(order, pixels, regions, settings, progress, send, staging)
    return _Extracted(made, order.folder or staging, staging, order.folder is None, cancelled)


def _resample(kept, key, chosen, folder, tempdir, progress, send):
    """As `_work`, of a concept that a material keeps."""
    progress(0.0, "Getting ready")
    from ..core.output import staged
    from ..core.palette import Palette, Settings, write_material, write_palette
    from ..core.region import file_name

    settings = Settings(**chosen)
    material = sample_kept(kept, settings, tempdir, lambda f, message: progress(_EXTRACTION * f, message))
    with staged(folder, False) if folder else _temporary(tempdir) as staging:
        record = write_material(material, staging / file_name(material.name))
        made = _Made(key, record, staging, material.preview)
        send(made)
        if folder:
            palette = Palette(None, "a kept concept", [], settings, [material])
            write_palette(palette, staging, _to_the_end(progress), {record["name"]: record})
    return _Extracted([made], folder or staging, staging, folder is None)


def sample_kept(kept, settings, tempdir, progress):
    """The core's material of a concept as a material keeps it: its JSON, and its tensors in base 64."""
    from ..core.palette import resample_material

    with tempfile.TemporaryDirectory(prefix="material_palette_", dir=tempdir) as beside:
        path = Path(beside) / "concept.json"
        path.write_text(kept[0], encoding="utf-8")
        path.with_suffix(".safetensors").write_bytes(base64.b64decode(kept[1]))
        return resample_material(path, settings, progress)


@contextlib.contextmanager
def _temporary(tempdir):
    """A new folder that is removed when the body fails, else by whoever takes its content."""
    staging = Path(tempfile.mkdtemp(prefix="material_palette_", dir=tempdir))
    try:
        yield staging
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def _extract(order, pixels, regions, settings, progress, send, staging):
    """Return the list of _Made and whether the user cancelled before all were finished."""
    from ..core.palette import Palette, extract_palette, write_material, write_palette
    from ..core.region import file_name

    made, materials = [], []

    def on_material(material):
        record = write_material(material, staging / file_name(material.name))
        materials.append(material)
        made.append(_Made(order.keys[material.name], record, staging, material.preview))
        send(made[-1])

    def extracting(fraction, message):
        progress(_EXTRACTION * fraction, message)

    cancelled = False
    try:
        palette = extract_palette(
            pixels,
            regions,
            settings,
            extracting,
            on_material,
            order.photo_name,
            order.focal and order.focal * max(pixels.shape),
        )
    except Abandoned:
        raise
    except Cancelled:
        if not any(material.error is None for material in materials):
            raise
        cancelled = True
        palette = Palette(pixels, order.photo_name, regions[: len(materials)], settings, materials)
    if order.folder:
        palette.warnings[:0] = order.warnings
        palette.scale = pixels.shape[1] / order.size[0] * order.scale
        write_palette(palette, staging, _to_the_end(progress), {one.record["name"]: one.record for one in made})
    return made, cancelled


def _to_the_end(progress):
    """Progress of the writing: what is finished is kept, so that a cancel doesn't stop it; Abandoned does."""

    def writing(fraction, message):
        try:
            progress(_EXTRACTION + (1.0 - _EXTRACTION) * fraction, message)
        except Abandoned:
            raise
        except Cancelled:
            pass

    return writing


def nearest(mask, shape):
    """`mask` at `shape` (H, W): a huge photo is reduced when it is read from disk, its masks follow."""
    if mask.shape == shape:
        return mask
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(shape, mask.shape, strict=True))
    return mask[np.ix_(rows, columns)]


def _count(materials):
    return f"{materials} material" if materials == 1 else f"{materials} materials"


def _say(failed):
    return "; ".join(f"Region '{record['name']}' failed: {record['error']}" for record in failed)


CLASSES = (MATERIAL_PALETTE_OT_extract, MATERIAL_PALETTE_OT_vary, MATERIAL_PALETTE_OT_resample)
