"""Fit Palette to Scene: each material keeps the texels that the scene's cameras show, and the full one beside it."""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .background import BackgroundOperator
from .export import read_map
from .extract import sample_kept, sampling
from .palette import adopt_adjustments, put_in_palette, take_place

FITTED = "palette_fitted"  # custom property of a material that this has made


@dataclass
class _Fitted:
    """What the worker hands over: the folder of the entries' folders, and per entry its key, record and preview."""

    folder: Path
    made: list


@dataclass
class _Order:
    """What is wanted of an entry: what cameras see of it, its full maps and their metres per tile, and where one is
    kept its concept and how to sample it."""

    key: int
    name: str
    seen: object
    svbrdf: object
    metres: float
    kept: tuple
    chosen: dict | None


class MATERIAL_PALETTE_OT_fit_scene(BackgroundOperator, Operator):
    """Give each material of the palette only the maps and texels that the scene's cameras show over the frame range.
    The full materials are kept to be compared and put back; run it again when cameras or objects have moved"""

    bl_idname = "material_palette.fit_scene"
    bl_label = "Fit Palette to Scene"

    keep_full: BoolProperty(
        name="Keep Full Materials",
        default=True,
        description="Keep the full materials in the file as those before; else they are deleted and the file shrinks",
    )

    needs_photo = False

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        settings = context.scene.material_palette
        sentence = "" if any(entry.material for entry in settings.palette) else "Extract a palette first"
        if not sentence and not any(obj.type == "CAMERA" for obj in context.scene.objects):
            sentence = "Add a camera where the palette will be seen from"
        if sentence:
            cls.poll_message_set(sentence)
        return not sentence

    def prepare(self, context):
        from ..core.scene import look

        entries = [entry for entry in context.scene.material_palette.palette if entry.material is not None]
        seen = look(context.scene, [entry.material for entry in entries])
        self.kept, order = [], []
        for entry in entries:
            one = seen[entry.material.name]
            if one.why:
                self.kept.append(f"'{entry.material.name}' stays: {one.why}")
            else:
                full = _full(entry)
                kept = full.material_palette.concept, full.material_palette.concept_tensors
                chosen = sampling(context.scene.material_palette, entry.seed) if kept[0] else None
                order.append(_Order(entry.key, entry.material.name, one, *_svbrdf(full), kept, chosen))
        if not order:
            raise PaletteError("; ".join(self.kept))
        temporary = bpy.app.tempdir
        return lambda progress, send: _work(order, temporary, progress)

    def finish(self, context, scene, result):
        from ..core import nodes

        settings = scene.material_palette
        saved = 0
        for key, record, preview in result.made:
            entry = next((entry for entry in settings.palette if entry.key == key), None)
            if entry is None or entry.material is None:
                continue
            _put_full_back(entry)
            full = entry.material
            asset = full.asset_data
            told = (asset.description, asset.author, asset.license) if asset else None
            before = _bytes(full)
            material = nodes.build_material(record, result.folder / str(key), pack=True, preview=preview)
            material[FITTED] = True
            _share(material, full)
            put_in_palette(settings, key, material, self.keep_full)
            saved += before - _bytes(material)
            if told is not None:
                nodes.mark_asset(material, *told)
        said = [f"{len(result.made)} materials fitted, {saved / 1e6:.1f} MB of textures saved", *self.kept]
        self.report({"WARNING"} if self.kept else {"INFO"}, "; ".join(said))

    @staticmethod
    def discard(result):
        shutil.rmtree(result.folder, ignore_errors=True)


def _full(entry):
    """The material that a fitted one was made of, where it is kept; else the entry's own."""
    return entry.previous if entry.material.get(FITTED) and entry.previous is not None else entry.material


def _put_full_back(entry):
    """Undo the fit before: the full material, with the fitted one's adjustments, takes its place."""
    from ..core import nodes

    full, fitted = _full(entry), entry.material
    if full == fitted:
        return
    entry.previous = None
    adopt_adjustments(full, fitted)
    take_place(full, fitted)
    entry.material = full
    nodes.remove_material(fitted)


def _share(material, full):
    """What the fit has left as it was is the full material's, and stored once; so what was learnt goes along."""
    from ..core.nodes import Controls

    for kind in ("basecolor", "normal", "roughness"):
        mine, theirs = (Controls(m).node(kind) for m in (material, full))
        # as large is not enough: where normals get fewer texels the roughness takes over what they lose
        if mine and theirs and mine.image and theirs.image and _same(mine.image, theirs.image):
            spare, mine.image = mine.image, theirs.image
            bpy.data.images.remove(spare)
    for name in ("concept", "concept_tensors"):
        setattr(material.material_palette, name, getattr(full.material_palette, name))


def _same(first, second):
    return tuple(first.size) == tuple(second.size) and np.array_equal(read_map(first), read_map(second))


def _bytes(material):
    """What a renderer holds of the material's maps."""
    from ..core.nodes import Controls

    controls, total = Controls(material), 0
    for kind, channels in (("basecolor", 4), ("normal", 4), ("roughness", 1)):
        node = controls.node(kind)
        if node and node.image:
            width, height = node.image.size
            total += width * height * channels * (2 if node.image.is_float else 1)
    return total


def _svbrdf(material):
    """The maps of a material of ours as they were extracted, without adjustments, and its metres per tile."""
    from ..core.material import SVBRDF
    from ..core.nodes import Controls

    controls = Controls(material)
    principled = controls.node("principled")

    def picture(kind):
        node = controls.node(kind)
        return read_map(node.image) if node and node.image else None

    albedo, normal, roughness = (picture(kind) for kind in ("basecolor", "normal", "roughness"))
    if albedo is None:
        albedo = np.array(principled.inputs["Base Color"].default_value[:3], np.float32)
    if normal is None:
        normal = np.array([0, 0, 1], np.float32)
    else:
        normal = normal * 2 - 1
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    roughness = float(principled.inputs["Roughness"].default_value) if roughness is None else roughness[..., 0].copy()
    height = material.get("height")
    if height is not None:
        height = (read_map(height)[..., 0] - material["height_midlevel"]) * material["height_scale"]
    return SVBRDF(albedo, normal, roughness, height), float(material.get("metres_per_tile", 1.0))


def _work(order, temporary, progress):
    """Runs on the worker; touches no bpy."""
    from ..core.palette import Material, Settings, fit_material, write_material
    from ..core.reduction import largest
    from ..core.region import file_name

    folder = Path(tempfile.mkdtemp(prefix="material_palette_", dir=temporary))
    try:
        made = []
        for i, one in enumerate(order):
            material = Material(one.name, svbrdf=one.svbrdf, metres_per_tile=one.metres)

            def share(fraction, message, i=i, name=one.name):
                progress((i + fraction) / len(order), f"{name}: {message}")

            pixels, have = one.seen.texels, largest(one.svbrdf)
            if one.chosen and pixels > have and have < one.chosen["resolution"]:
                again = sample_kept(one.kept, Settings(**one.chosen, full_maps=True), temporary, share)
                # a tile of which a part was kept is whole again
                pixels *= again.metres_per_tile / one.metres
                material.svbrdf, material.metres_per_tile = again.svbrdf, again.metres_per_tile
            fit_material(material, pixels, share, one.seen.displaced)
            # by key, since names may share a file name
            record = write_material(material, folder / str(one.key) / file_name(one.name))
            made.append((one.key, record, material.preview))
        return _Fitted(folder, made)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


CLASSES = (MATERIAL_PALETTE_OT_fit_scene,)
