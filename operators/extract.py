"""Extract Palette: the enabled regions of the photo become materials, on a background thread."""

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from bpy.types import Operator

from ..core.errors import PaletteError
from .background import BackgroundOperator
from .photo import photo_reader
from .regions import read_mask_image

_EXTRACTION = 0.95  # share of the time; the rest is writing


@dataclass
class _Extracted:
    """What the worker hands over: palette.json's dict, the folder of its files, previews by material name."""

    palette: dict
    folder: Path
    previews: dict
    temporary: bool


class MATERIAL_PALETTE_OT_extract(BackgroundOperator, Operator):
    """Make a tileable material of every enabled region of the photo. Esc cancels"""

    bl_idname = "material_palette.extract"
    bl_label = "Extract Palette"

    def prepare(self, context):
        scene = context.scene.material_palette
        chosen = {
            "engine": scene.engine,
            "quality": scene.quality,
            "resolution": scene.resolution,
            "seed": scene.seed,
            "flatten": scene.flatten,
            "metres_per_tile": scene.metres_per_tile,
        }
        read = photo_reader(scene.photo)
        masks = _read_masks(scene)
        photo_name = os.path.basename(scene.photo.filepath_raw) or scene.photo.name
        if scene.pack:
            folder, overwrite, tempdir = None, False, bpy.app.tempdir
        else:
            folder, overwrite, tempdir = _output_folder(scene), scene.overwrite, None
            if folder.is_dir() and any(folder.iterdir()) and not overwrite:
                raise PaletteError(f"Output folder isn't empty: {folder}. Choose another one, or turn on Overwrite")
        self.pack = scene.pack

        def work(progress, send):
            # importing torch takes seconds, which the window shouldn't wait for
            progress(0.0, "Getting ready")
            from ..core.output import staged
            from ..core.palette import Settings

            settings = Settings(**chosen)
            settings.check()
            pixels, regions, warnings = _read_inputs(read, masks, progress)
            if folder is not None:
                with staged(folder, overwrite) as staging:
                    palette, previews = _extract(pixels, regions, settings, progress, photo_name, warnings, staging)
                return _Extracted(palette, folder, previews, temporary=False)
            staging = Path(tempfile.mkdtemp(prefix="material_palette_", dir=tempdir))
            try:
                palette, previews = _extract(pixels, regions, settings, progress, photo_name, warnings, staging)
            except BaseException:
                shutil.rmtree(staging, ignore_errors=True)
                raise
            return _Extracted(palette, staging, previews, temporary=True)

        return work

    def finish(self, context, scene, result):
        from ..core import nodes

        records = result.palette["materials"]
        failed = [record for record in records if record["status"] != "ok"]
        if len(failed) == len(records):
            raise PaletteError("No material was made. " + _say(failed))
        built = []
        try:
            for record in records:
                if record["status"] == "ok":
                    preview = result.previews.get(record["name"])
                    material = nodes.build_material(record, result.folder, pack=self.pack, preview=preview)
                    built.append((record, material))
                    nodes.mark_asset(material, f"Extracted from {result.palette['photo']}")
        except BaseException:
            for _record, material in built:
                nodes.remove_material(material)
            raise
        _replace_palette(scene.material_palette, built)
        if failed:
            self.report({"WARNING"}, f"{len(built)} materials made. " + _say(failed))
        else:
            self.report({"INFO"}, f"{len(built)} materials made")

    @staticmethod
    def discard(result):
        if result.temporary:
            shutil.rmtree(result.folder, ignore_errors=True)


def _read_masks(scene):
    """The enabled regions' masks as {name: (H, W) bool}; raises PaletteError naming the region that can't be used."""
    from ..core.region import file_name

    regions = [region for region in scene.regions if region.enabled]
    if not regions:
        raise PaletteError("No region to extract: add and paint one, import masks, or use Auto Segment")
    size, owners, masks = tuple(scene.photo.size), {}, {}
    for region in regions:
        owner = owners.setdefault(file_name(region.name).casefold(), region)
        if owner != region:
            raise PaletteError(f"Regions '{owner.name}' and '{region.name}' would share one file name; rename one")
        if region.mask is not None and tuple(region.mask.size) != size:
            wrong, right = (f"{width} x {height} px" for width, height in (region.mask.size, size))
            raise PaletteError(f"Region '{region.name}': its mask is {wrong}, the photo is {right}; paint it anew")
        masks[region.name] = read_mask_image(region)
    return masks


def _output_folder(scene):
    if scene.output_folder.startswith("//") and not bpy.data.filepath:
        raise PaletteError("Output folder is relative to a file that isn't saved yet: save it, or pack the textures")
    if not scene.output_folder.strip():
        raise PaletteError("No output folder: choose one, or pack the textures")
    return Path(os.path.normpath(bpy.path.abspath(scene.output_folder)))


def _read_inputs(read, masks, progress):
    from ..core.region import Region

    progress(0.0, "Reading the photo")
    pixels, warnings = read()
    shape = pixels.shape[:2]
    return pixels, [Region(name, _nearest(mask, shape)) for name, mask in masks.items()], warnings


def _nearest(mask, shape):
    """`mask` at `shape` (H, W): a huge photo is reduced when it is read from disk, its masks follow."""
    if mask.shape == shape:
        return mask
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(shape, mask.shape, strict=True))
    return mask[np.ix_(rows, columns)]


def _extract(pixels, regions, settings, progress, photo_name, warnings, staging):
    from ..core.palette import extract_palette, write_palette

    def extracting(fraction, message):
        progress(_EXTRACTION * fraction, message)

    def writing(fraction, message):
        progress(_EXTRACTION + (1.0 - _EXTRACTION) * fraction, message)

    palette = extract_palette(pixels, regions, settings, extracting, photo_name=photo_name)
    palette.warnings[:0] = warnings
    written = write_palette(palette, staging, writing)
    return written, {material.name: material.preview for material in palette.materials if material.preview is not None}


def _replace_palette(settings, built):
    """List the new materials; those of the last run that no object uses go when the file is closed, as any unused."""
    for entry in settings.palette:
        material = entry.material
        if material is not None and material.users - material.use_fake_user <= 1 and material.asset_data:
            material.asset_clear()
    settings.palette.clear()
    for record, material in built:
        entry = settings.palette.add()
        entry.name = record["name"]
        entry.material = material
        entry.warnings = "\n".join(record["warnings"])
    settings.active_material = 0


def _say(failed):
    return "; ".join(f"Region '{record['name']}' failed: {record['error']}" for record in failed)


CLASSES = (MATERIAL_PALETTE_OT_extract,)
