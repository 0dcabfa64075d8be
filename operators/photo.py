"""Open Photo, and the photo as linear pixels for a worker that must not touch bpy."""

import os

import bpy
import numpy as np
from bpy.props import StringProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .setup import NeedsPackages, missing_sentence

# Image.colorspace_settings names, with those of other configurations that mean the same.
_SRGB = {"sRGB", "sRGB - Texture"}
_LINEAR = {"Linear Rec.709", "Linear", "Non-Color", "Linear BT.709"}
# custom properties of an upright copy: focal length, in longer sides, and px of it per px of its file
_FOCAL, _SCALE = "material_palette_focal", "material_palette_scale"


def photo_reader(image):
    """Return a function without arguments and without bpy that gives the photo's (H, W, 3) linear Rec.709 pixels.

    An untouched file is read from disk, where its colour profile is; a packed, generated or edited image is read from
    Blender now. The function returns (pixels, warnings). Raises PaletteError when the image can't be a photo.
    """
    if image is None:
        raise PaletteError("No photo: open one first")
    if image.source not in {"FILE", "GENERATED"}:
        raise PaletteError(f"Photo '{image.name}' is a {image.source.lower()}; a single picture is needed")
    path = bpy.path.abspath(image.filepath_raw, library=image.library)
    if image.source == "FILE" and not image.packed_file and not image.is_dirty:
        if not os.path.isfile(path):
            raise PaletteError(f"Photo '{image.name}' is not where it was: {path}")
        if _is_turned(path):
            raise PaletteError(f"Photo '{image.name}' lies on its side in its file; Open Photo turns it upright")
        return _file_reader(path)
    pixels = read_pixels(image)
    return lambda: _reduced(pixels)


def photo_state(image):
    """What is another whenever the photo's pixels may be others: after Reload, painting, another colour space."""
    if image is None:
        return None
    path = bpy.path.abspath(image.filepath_raw, library=image.library)
    written = os.stat(path).st_mtime_ns if os.path.isfile(path) else 0
    return image.session_uid, tuple(image.size), path, written, image.is_dirty, image.colorspace_settings.name


def take_photo(context, image):
    """Make `image` the scene's photo."""
    from .preferences import apply_defaults

    settings = context.scene.material_palette
    if settings.photo is None:
        apply_defaults(context, settings)
    settings.photo = image


def photo_focal(image):
    """The focal length that the camera wrote into the photo's file, in longer sides of the photo, else None."""
    from ..core.image import read_focal

    path = bpy.path.abspath(image.filepath_raw, library=image.library)
    return read_focal(path) if image.source == "FILE" and os.path.isfile(path) else image.get(_FOCAL)


def photo_scale(image):
    """Px of the photo per px of its file: 1 but where a large one was turned upright."""
    return image.get(_SCALE, 1.0)


def _reduced(pixels):
    from ..core.image import reduce_photo

    return reduce_photo(pixels)


def _file_reader(path):
    def read():
        from ..core.image import read_photo

        photo = read_photo(path)
        return photo.pixels, photo.warnings

    return read


def read_pixels(image):
    """Return Blender's own pixels of `image` as (H, W, 3) float32 linear Rec.709, top row first.

    Raises PaletteError when there are no pixels or their colour space can't be told.
    """
    from ..core.image import linear_from_srgb

    width, height = image.size
    if not image.has_data and not (width and height):
        raise PaletteError(f"Photo '{image.name}' has no pixels; is its file still there?")
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, 4)[::-1, :, :3]
    space = image.colorspace_settings.name
    if image.is_float:  # Blender has them in its working space, which the file chooses from 5.0 on
        working = getattr(getattr(bpy.data, "colorspace", None), "working_space", "Linear Rec.709")
        if working != "Linear Rec.709":
            raise PaletteError(f"The file's working space is {working}; photos with float pixels need Linear Rec.709")
        return np.maximum(pixels, 0.0)
    if space in _SRGB:
        return linear_from_srgb(pixels)
    if space in _LINEAR:
        return np.ascontiguousarray(pixels)
    raise PaletteError(f"Photo '{image.name}' is in colour space {space}; set it to sRGB")


def _is_turned(path):
    return _orientation(path) not in (0, 1)


def _orientation(path):
    """EXIF orientation 1..8 of the file, 1 when it has none; Blender shows pixels as they are stored."""
    import OpenImageIO as oiio

    picture = oiio.ImageInput.open(path)
    if picture is None:
        oiio.geterror()
        return 1
    try:
        return picture.spec().get_int_attribute("Orientation", 1)
    finally:
        picture.close()


def _open(path):
    """Load `path` as an image, upright, and what was changed on the way; raises PaletteError with the file's name when
    it is no picture."""
    if _is_turned(path):
        return _upright_copy(path)
    try:
        image = bpy.data.images.load(path, check_existing=True)
    except RuntimeError as error:
        raise PaletteError(f"Can't open {path}: {error}") from error
    if image.size[0] == 0:
        if image.users == 0:
            bpy.data.images.remove(image)
        raise PaletteError(f"Not a picture, or a damaged one: {path}")
    return image, []


def _upright_copy(path):
    from ..core.image import read_photo, srgb_from_linear

    photo = read_photo(path)
    pixels = photo.pixels
    height, width = pixels.shape[:2]
    bright = bool(pixels.max() > 1.001)  # floats: more than bytes hold
    image = bpy.data.images.new(os.path.basename(path), width, height, alpha=False, float_buffer=bright)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels[::-1] if bright else np.clip(srgb_from_linear(pixels[::-1]), 0.0, 1.0)
    image.pixels.foreach_set(rgba.ravel())
    image.pack()
    image[_SCALE] = photo.scale
    if photo.focal:
        image[_FOCAL] = photo.focal / max(height, width)
    return image, photo.warnings


class MATERIAL_PALETTE_OT_open_photo(NeedsPackages, Operator):
    """Open the photo that materials are extracted from"""

    bl_idname = "material_palette.open_photo"
    bl_label = "Open Photo"
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context, event):
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        path = bpy.path.abspath(self.filepath)
        if not os.path.isfile(path):
            self.report({"ERROR"}, f"No such file: {path}")
            return {"CANCELLED"}
        try:
            image, warnings = _open(path)
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for warning in warnings:
            self.report({"WARNING"}, warning)
        take_photo(context, image)
        space = context.space_data
        if space is not None and space.type == "IMAGE_EDITOR":
            space.image = image
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_use_shown_image(Operator):
    """Extract materials from the image that the Image Editor shows"""

    bl_idname = "material_palette.use_shown_image"
    bl_label = "Use Shown Image"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        space = context.space_data
        image = space.image if space is not None and space.type == "IMAGE_EDITOR" else None
        settings = context.scene.material_palette
        if image is None or image.type != "IMAGE" or any(region.mask == image for region in settings.regions):
            cls.poll_message_set("No Image Editor that shows a picture")
            return False
        return True

    def execute(self, context):
        take_photo(context, context.space_data.image)
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_paste_photo(Operator):
    """Take the picture in the clipboard as the photo"""

    bl_idname = "material_palette.paste_photo"
    bl_label = "Paste Photo"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        space = context.space_data
        if space is None or space.type != "IMAGE_EDITOR" or not bpy.ops.image.clipboard_paste.poll():
            cls.poll_message_set("Blender can paste pictures in the Image Editor only, and not on every system")
            return False
        return True

    def execute(self, context):
        before = set(bpy.data.images)
        try:
            bpy.ops.image.clipboard_paste()
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        pasted = next((image for image in bpy.data.images if image not in before), None)
        if pasted is None:
            self.report({"ERROR"}, "There is no picture in the clipboard")
            return {"CANCELLED"}
        pasted.pack()
        take_photo(context, pasted)
        return {"FINISHED"}


class MATERIAL_PALETTE_FH_photo(bpy.types.FileHandler):
    """A picture dropped on the Palette's editor becomes the photo."""

    bl_idname = "MATERIAL_PALETTE_FH_photo"
    bl_label = "Photo for Material Palette"
    bl_import_operator = "material_palette.open_photo"
    bl_file_extensions = ".jpg;.jpeg;.png;.tif;.tiff;.webp;.exr;.hdr;.bmp"

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "IMAGE_EDITOR" and not missing_sentence()


class MATERIAL_PALETTE_OT_restore_defaults(Operator):
    """Set quality, resolution, seed and the other settings of extraction back to the defaults, those of the preferences
    among them"""

    bl_idname = "material_palette.restore_defaults"
    bl_label = "Restore Defaults"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        from .preferences import apply_defaults

        settings = context.scene.material_palette
        for prop in settings.bl_rna.properties:
            if prop.type not in {"POINTER", "COLLECTION"} and prop.identifier not in _KEPT:
                settings.property_unset(prop.identifier)
        apply_defaults(context, settings)
        return {"FINISHED"}


_KEPT = {"name", "last_key", "active_region", "active_material", "palette_view", "show_regions", "author", "licence"}

CLASSES = (
    MATERIAL_PALETTE_OT_open_photo,
    MATERIAL_PALETTE_OT_use_shown_image,
    MATERIAL_PALETTE_OT_paste_photo,
    MATERIAL_PALETTE_FH_photo,
    MATERIAL_PALETTE_OT_restore_defaults,
)
