"""The operators as a script in background mode runs them: results through scene properties, refusals by name."""

import threading
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from material_palette.core.errors import PaletteError


def refused(operator, **properties):
    """Call an operator that has to refuse; return what it says."""
    with pytest.raises(RuntimeError) as error:
        operator(**properties)
    return str(error.value)


@pytest.fixture
def ready(settings, photo_and_masks):
    """A scene with a photo and two regions, set to the smallest and fastest palette."""
    photo, masks = photo_and_masks
    assert bpy.ops.material_palette.open_photo(filepath=str(photo)) == {"FINISHED"}
    assert bpy.ops.material_palette.import_masks(directory=str(masks)) == {"FINISHED"}
    settings.resolution = 64
    settings.quality = "draft"
    return settings


@pytest.fixture
def instant(monkeypatch):
    """Make the pipeline instant: a material per region out of nothing but its mean colour."""
    from material_palette.core import palette
    from material_palette.core.material import SVBRDF

    def textured(pixels, region, settings, progress, *_view_focal_engine):
        progress(0.5, "half")
        if not region.mask.any():
            raise PaletteError(f"Region '{region.name}' is empty")
        noise = np.random.default_rng(0).random((64, 64, 1), np.float32)
        albedo = np.clip(pixels[region.mask].mean(0) * noise, 0, 1).astype(np.float32)
        svbrdf = SVBRDF(albedo, np.array([0, 0, 1], np.float32), 0.6)
        return palette.Material(region.name, "ok", svbrdf, preview=np.ones((256, 256, 4), np.float32)), None

    monkeypatch.setattr(palette, "_textured", textured)
    monkeypatch.setattr(palette, "_finish", lambda material, texture, settings, progress: None)


def test_open_photo_refuses_by_name(settings, tmp_path, data_blocks):
    before = data_blocks()
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"not a picture")
    assert "broken.png" in refused(bpy.ops.material_palette.open_photo, filepath=str(broken))
    assert "nowhere.png" in refused(bpy.ops.material_palette.open_photo, filepath=str(tmp_path / "nowhere.png"))
    assert settings.photo is None
    assert data_blocks() == before


def write_turned(path, pixels, orientation, **more):
    """Write pixels (H, W, 3) uint8 or float32 with an EXIF orientation and other attributes; return the path."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, str(pixels.dtype).replace("float32", "float"))
    for name, value in {"Orientation": orientation, **more}.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), spec)
    output.write_image(pixels)
    output.close()
    return str(path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_photo_is_opened_upright(settings, tmp_path, orientation):
    from material_palette.core.image import read_focal, read_photo
    from material_palette.operators.photo import photo_focal, photo_reader, read_pixels

    pixels = np.zeros((40, 64, 3), np.uint8)
    pixels[:20, :32, 0] = 255
    path = write_turned(tmp_path / "turned.tif", pixels, orientation, **{"Exif:FocalLengthIn35mmFilm": 28})

    bpy.ops.material_palette.open_photo(filepath=path)
    upright = read_photo(path).pixels
    np.testing.assert_allclose(read_pixels(settings.photo), upright, atol=0.01)
    np.testing.assert_allclose(photo_reader(settings.photo)()[0], upright, atol=0.01)
    assert photo_focal(settings.photo) == pytest.approx(read_focal(path)) and read_focal(path) > 0.5


def test_a_turned_photo_in_floats_keeps_what_is_brighter_than_white(settings, tmp_path):
    from material_palette.operators.photo import photo_reader

    pixels = np.full((40, 64, 3), 0.25, np.float32)
    pixels[:20] = 3.0
    path = write_turned(tmp_path / "bright.tif", pixels, 3)
    bpy.ops.material_palette.open_photo(filepath=path)
    np.testing.assert_allclose(photo_reader(settings.photo)()[0], pixels[::-1, ::-1], atol=1e-3)


def test_a_packed_photo_is_no_larger_than_one_of_a_file(monkeypatch):
    from material_palette.core import image as core_image
    from material_palette.operators.photo import photo_reader

    monkeypatch.setattr(core_image.reduce_photo, "__defaults__", (50,))
    image = bpy.data.images.new("packed", 20, 10)
    image.pack()
    pixels, (warning,) = photo_reader(image)()
    assert pixels.shape == (5, 10, 3) and "from 20 x 10 px to 10 x 5 px" in warning


def test_painted_photo_is_read_from_blender_as_linear(settings):
    from material_palette.operators.photo import photo_reader

    image = bpy.data.images.new("painted", 4, 2)
    pixels = np.ones((2, 4, 4), np.float32)
    pixels[0, :, :3] = 128 / 255  # the bottom row
    image.pixels.foreach_set(pixels.ravel())
    linear, warnings = photo_reader(image)()
    assert linear.shape == (2, 4, 3) and linear.dtype == np.float32
    np.testing.assert_allclose(linear[0], 1.0)
    np.testing.assert_allclose(linear[1], 0.21586, atol=1e-4)  # IEC 61966-2-1 of 128
    assert warnings == []


def test_float_photo_is_linear_already(settings):
    from material_palette.operators.photo import photo_reader

    image = bpy.data.images.new("radiance", 2, 2, float_buffer=True)
    image.pixels.foreach_set(np.tile(np.array([0.5, 2.0, -0.1, 1.0], np.float32), 4))
    np.testing.assert_allclose(photo_reader(image)()[0], np.tile([0.5, 2.0, 0.0], (2, 2, 1)))


def test_imported_masks_go_out_as_they_came(ready, photo_and_masks, tmp_path):
    from material_palette.core.image import read_mask

    _photo, masks = photo_and_masks
    assert [region.name for region in ready.regions] == ["left", "right"]
    (tmp_path / "out").mkdir()
    bpy.ops.material_palette.export_masks(directory=str(tmp_path / "out"))
    for name in ("left.png", "right.png"):
        assert (read_mask(tmp_path / "out" / name, (96, 160)) == read_mask(masks / name, (96, 160))).all()


def test_importing_again_replaces_regions_of_the_same_name(ready, photo_and_masks, data_blocks):
    before = data_blocks()
    bpy.ops.material_palette.import_masks(directory=str(photo_and_masks[1]))
    assert [region.name for region in ready.regions] == ["left", "right"]
    assert data_blocks() == before


def test_masks_survive_saving_and_loading(ready, tmp_path):
    from material_palette.operators.regions import read_mask_image

    bpy.ops.material_palette.add_region(name="painted")
    image = ready.regions[2].mask
    pixels = np.zeros(160 * 96 * 4, np.float32)
    pixels[:400] = 1.0
    image.pixels.foreach_set(pixels)
    expected = [read_mask_image(region) for region in ready.regions]
    assert expected[2].sum() == 100
    path = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=path)
    regions = bpy.context.scene.material_palette.regions
    for region, mask in zip(regions, expected, strict=True):
        assert (read_mask_image(region) == mask).all()


def test_removing_a_region_removes_its_mask(ready, data_blocks):
    before = data_blocks()
    bpy.ops.material_palette.add_region()
    assert data_blocks() != before
    bpy.ops.material_palette.remove_region()
    assert data_blocks() == before


def test_regions_that_are_alike_are_merged_and_others_are_not(ready):
    from material_palette.operators.regions import read_mask_image

    both = [read_mask_image(region) for region in ready.regions]
    assert bpy.ops.material_palette.merge_alike() == {"CANCELLED"} and len(ready.regions) == 2
    assert bpy.ops.material_palette.merge_alike(most=100.0) == {"FINISHED"}
    assert len(ready.regions) == 1 and (read_mask_image(ready.regions[0]) == (both[0] | both[1])).all()


def test_a_mask_of_another_size_is_named_before_regions_are_merged(ready):
    ready.regions[1].mask.scale(8, 8)
    with pytest.raises(RuntimeError, match="'right': its mask is 8 x 8 px, the photo is"):
        bpy.ops.material_palette.merge_alike(most=100.0)
    assert len(ready.regions) == 2


def test_masks_take_corners_and_measures_along(ready, tmp_path):
    from material_palette.operators.rectify import corners_of, measure_of, set_corners, set_measure

    corners = np.array([[10, 10], [60, 14], [60, 66], [10, 70]], float)
    set_corners(ready.regions[0], corners)
    set_measure(ready.regions[1], [[90, 10], [120, 10]], 0.5)
    assert bpy.ops.material_palette.export_masks(directory=str(tmp_path)) == {"FINISHED"}
    for region in ready.regions:
        region.has_corners = region.has_measure = False
    assert bpy.ops.material_palette.import_masks(directory=str(tmp_path)) == {"FINISHED"}
    assert (corners_of(ready.regions[0]) == corners).all() and corners_of(ready.regions[1]) is None
    points, metres = measure_of(ready.regions[1])
    assert points.tolist() == [[90, 10], [120, 10]] and metres == 0.5 and measure_of(ready.regions[0]) is None


def test_no_region_gets_the_key_of_one_that_was_removed(ready):
    ready.active_region = 1
    removed = ready.regions[1].key
    bpy.ops.material_palette.remove_region()
    bpy.ops.material_palette.add_region()
    assert ready.regions[1].key > removed


def test_region_names_stay_apart(ready):
    for _ in range(3):
        bpy.ops.material_palette.add_region()
    assert [region.name for region in ready.regions][2:] == ["Region", "Region 2", "Region 3"]


def test_extract_makes_packed_materials_with_previews(ready, instant, temporary_folders):
    assert bpy.ops.material_palette.extract() == {"FINISHED"}
    assert [(entry.name, entry.material.name) for entry in ready.palette] == [("left", "left"), ("right", "right")]
    for entry in ready.palette:
        assert entry.material.asset_data is not None
        assert entry.material.preview.is_image_custom
        images = [node.image for node in entry.material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage"]
        assert images and all(image.packed_file for image in images)
    assert temporary_folders() == []
    assert not bpy.context.window_manager.material_palette_run.running


@pytest.mark.slow
def test_extract_runs_the_real_pipeline(ready, temporary_folders):
    assert bpy.ops.material_palette.extract() == {"FINISHED"}
    assert [entry.material.name for entry in ready.palette] == ["left", "right"]
    assert temporary_folders() == []


def test_extract_leaves_out_regions_that_are_turned_off(ready, instant):
    ready.regions[0].enabled = False
    bpy.ops.material_palette.extract()
    assert [entry.name for entry in ready.palette] == ["right"]


def test_extract_into_a_folder(ready, instant, tmp_path):
    ready.pack = False
    assert "isn't saved" in refused(bpy.ops.material_palette.extract)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    settings = bpy.context.scene.material_palette
    bpy.ops.material_palette.extract()
    assert (tmp_path / "palette" / "palette.json").is_file()
    image = next(n for n in settings.palette[0].material.node_tree.nodes if n.bl_idname == "ShaderNodeTexImage").image
    assert image.filepath_raw == "//palette/left/left_basecolor.png"
    assert image.packed_file is None and tuple(image.size) == (64, 64)
    assert "isn't empty" in refused(bpy.ops.material_palette.extract)
    settings.overwrite = True
    assert bpy.ops.material_palette.extract() == {"FINISHED"}
    assert sorted(material.name for material in bpy.data.materials) == [
        "left",
        "right",
    ]  # of the others no file is left
    assert not any(image.packed_file for entry in settings.palette for image in images_in(entry.material))


def test_extracting_again_puts_the_new_material_where_the_old_one_was(ready, instant):
    bpy.ops.material_palette.extract()
    left, right = (entry.material for entry in ready.palette)
    wall = bpy.data.meshes.new("wall")
    wall.materials.append(right)
    right.material_palette.roughness_offset = 0.1
    right.material_palette.rotation = 0.5
    right.name = "my bricks"
    bpy.ops.material_palette.extract()
    new = ready.palette[1].material
    assert [entry.name for entry in ready.palette] == ["left", "right"]
    assert new != right and wall.materials[0] == new
    assert (new.name, right.name) == ("my bricks", "my bricks (before)")
    assert new.material_palette.rotation == pytest.approx(0.5)
    assert ready.palette[1].previous == right and right.asset_data is None and new.asset_data is not None
    bpy.ops.material_palette.extract()
    assert [m.name for m in bpy.data.materials if "before" in m.name] == ["left (before)", "my bricks (before)"]


def test_only_the_active_region(ready, instant):
    bpy.ops.material_palette.extract()
    before = [entry.material for entry in ready.palette]
    ready.active_region = 1
    bpy.ops.material_palette.extract(only_active=True)
    assert [entry.name for entry in ready.palette] == ["left", "right"]
    assert ready.palette[0].material == before[0] and ready.palette[1].material != before[1]


def test_a_variation_has_another_seed_and_can_be_compared(ready, instant, data_blocks):
    ready.seed = 7
    bpy.ops.material_palette.extract()
    ready.active_material = 1
    ready.regions[1].name = "renamed"  # what ties them is not the name
    old = ready.palette[1].material
    wall = bpy.data.meshes.new("wall")
    wall.materials.append(old)
    before = data_blocks()
    assert not bpy.ops.material_palette.compare.poll()
    bpy.ops.material_palette.vary()
    new = ready.palette[1].material
    assert [entry.seed for entry in ready.palette] == [7, 8]
    assert wall.materials[0] == new != old
    for expected in (old, new):
        bpy.ops.material_palette.compare()
        assert wall.materials[0] == ready.palette[1].material == expected
        assert expected.name == "right" and expected.asset_data is not None
        assert ready.palette[1].previous.name == "right (before)"
    bpy.ops.material_palette.discard_before()
    after = data_blocks()
    assert after["materials"] == before["materials"] and len(after["images"]) == len(before["images"])
    ready.regions.clear()
    assert not bpy.ops.material_palette.vary.poll()


def test_an_adjusted_tile_follows_what_the_new_one_covers(tmp_path, make_record, write_maps):
    from material_palette.core.nodes import Controls, build_material
    from material_palette.operators.palette import adopt_adjustments

    maps = write_maps()
    old, new = (build_material(make_record(maps, metres_per_tile=m), tmp_path, pack=True) for m in (1.0, 2.0))
    for tile_size, expected in ((1.0, 2.0), (1.5, 3.0)):
        Controls(old).tile_size = tile_size
        adopt_adjustments(new, old)
        assert Controls(new).tile_size == pytest.approx(expected)


def test_after_the_last_seed_comes_the_first(ready, instant):
    ready.seed = 2**31 - 1
    bpy.ops.material_palette.extract()
    assert bpy.ops.material_palette.vary() == {"FINISHED"}
    assert ready.palette[0].seed == 0


def test_a_kept_concept_is_sampled_again_without_the_photo(ready, tmp_path, temporary_folders):
    ready.regions[0].enabled, ready.keep_concepts, ready.seed = False, True, 3
    bpy.ops.material_palette.extract()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
    settings = bpy.context.scene.material_palette
    settings.photo, settings.resolution, settings.scale = None, 128, 2.0
    settings.regions.clear()
    for variation in (False, True):
        assert bpy.ops.material_palette.resample(variation=variation) == {"FINISHED"}
        (entry,) = settings.palette
        image = next(n for n in entry.material.node_tree.nodes if n.bl_idname == "ShaderNodeTexImage").image
        assert tuple(image.size) == (128, 128) and image.packed_file
        # twice the pixels at twice the scale: a tile of the same size
        assert entry.material["metres_per_tile"] == pytest.approx(1.0)
        assert entry.seed == 3 + variation and entry.previous is not None
        assert "photo" in entry.material.asset_data.description
    assert temporary_folders() == []
    entry.material.material_palette.concept = "{}"
    assert "holds no concept" in refused(bpy.ops.material_palette.resample)


def test_an_error_asked_for_reaches_the_pipeline_and_its_outcome_is_told(ready, instant, monkeypatch):
    from material_palette.core import palette

    instantly = palette._textured

    def judged(pixels, region, settings, *rest):
        material, texture = instantly(pixels, region, settings, *rest)
        if settings.target_error is not None:
            material.target = {"asked": settings.target_error, "quality": "draft", "predicted": 0.12, "found": 0.1}
        return material, texture

    monkeypatch.setattr(palette, "_textured", judged)
    ready.target_error = 0.15
    bpy.ops.material_palette.extract()
    assert ready.palette[0].warnings == "Error asked 0.150, predicted 0.120, found 0.100: quality draft"
    ready.target_error = 0.0
    bpy.ops.material_palette.extract()
    assert ready.palette[0].warnings == ""


def test_the_network_of_the_preferences_finds_the_maps(settings, monkeypatch):
    from types import SimpleNamespace

    from material_palette.operators import extract, preferences

    assert extract.sampling(settings, 0)["decomposer"] == "unet"
    monkeypatch.setattr(preferences, "preferences", lambda context: SimpleNamespace(maps_by="/weights/model.ckpt"))
    assert extract.sampling(settings, 0)["decomposer"] == "resnet101=/weights/model.ckpt"


def test_without_a_kept_concept_resample_says_so(ready, instant):
    bpy.ops.material_palette.extract()
    assert not bpy.ops.material_palette.resample.poll()


def test_deleting_a_material_deletes_its_images(ready, instant, data_blocks):
    before = data_blocks()
    bpy.ops.material_palette.extract()
    bpy.ops.material_palette.vary()
    for _ in range(2):
        bpy.ops.material_palette.delete_material()
    assert data_blocks() == before
    assert len(ready.palette) == 0
    assert not bpy.ops.material_palette.delete_material.poll()


def test_choosing_a_material_chooses_its_region(ready, instant):
    bpy.ops.material_palette.extract()
    bpy.ops.material_palette.select_material(index=1)
    assert (ready.active_material, ready.active_region) == (1, 1)
    bpy.ops.material_palette.select_material(index=0)
    assert (ready.active_material, ready.active_region) == (0, 0)


def test_a_forecast_counts_what_is_sampled(settings):
    from material_palette.operators import history

    history.clear()
    chosen = {"engine": "patch", "quality": "balanced", "resolution": 2048, "scale": 4.0}
    history.add(chosen, [{"seconds": {"sample": 3.0}}])
    settings.resolution = 512
    assert history.expected(settings, "balanced", 2) == pytest.approx(6.0)
    settings.resolution, settings.scale = 1024, 2.0
    assert history.expected(settings, "balanced", 2) == pytest.approx(6.0)
    history.clear()


def test_progress_of_a_resample_into_a_folder_never_steps_back(tmp_path, monkeypatch):
    from material_palette.core import palette
    from material_palette.core.material import SVBRDF
    from material_palette.operators import extract

    def sample(_path, _settings, progress):
        progress(1.0, "done")
        svbrdf = SVBRDF(np.full(3, 0.5, np.float32), np.array([0, 0, 1], np.float32), 0.6)
        return palette.Material("stone", svbrdf=svbrdf, preview=np.ones((256, 256, 4), np.float32))

    monkeypatch.setattr(palette, "resample_material", sample)
    chosen = {"quality": "draft", "resolution": 64, "scale": 1.0, "seed": 0, "decomposer": "unet"}
    told = []
    kept = "{}", ""
    extract._resample(kept, 1, chosen, tmp_path / "out", str(tmp_path), lambda f, _m: told.append(f), lambda made: None)
    assert told == sorted(told) and told[-1] == 1.0


def test_geometry_is_written_in_px_of_the_photo_not_of_the_reduced_one(ready, instant, tmp_path, monkeypatch):
    import json

    from material_palette.core.image import read_photo
    from material_palette.operators import extract

    photo = ready.photo.filepath_raw
    half = np.ascontiguousarray(read_photo(photo).pixels[::2, ::2])
    monkeypatch.setattr(extract, "photo_reader", lambda image: lambda: (half, []))
    corners = [[10, 10], [60, 12], [58, 70], [12, 68]]
    monkeypatch.setattr(extract, "corners_of", lambda region: np.float64(corners) if region.name == "left" else None)
    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    bpy.ops.material_palette.extract()
    (written,) = (tmp_path / "out" / "masks").glob("*.json")
    assert np.allclose(json.loads(written.read_text())["left"]["corners"], corners, atol=1.0)


def test_a_variation_into_a_folder_leaves_the_other_textures(ready, instant, tmp_path):
    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    bpy.ops.material_palette.extract()
    files = sorted((tmp_path / "out").rglob("*"))
    bpy.ops.material_palette.vary()
    assert sorted((tmp_path / "out").rglob("*")) == files
    assert (tmp_path / "out_2" / "left" / "left_basecolor.png").is_file()
    for entry, folder in zip(ready.palette, ("out_2", "out"), strict=True):
        image = next(n for n in entry.material.node_tree.nodes if n.bl_idname == "ShaderNodeTexImage").image
        assert Path(image.filepath_raw) == tmp_path / folder / entry.name / f"{entry.name}_basecolor.png"
        assert image.size[0] == 64


def test_one_bad_region_is_reported_and_the_others_are_kept(ready, instant, capfd):
    bpy.ops.material_palette.add_region(name="sky")
    assert bpy.ops.material_palette.extract() == {"FINISHED"}
    assert [entry.name for entry in ready.palette] == ["left", "right"]
    assert "'sky'" in capfd.readouterr().out


def test_only_bad_regions_make_nothing(ready, instant, data_blocks, temporary_folders):
    ready.regions[0].enabled = ready.regions[1].enabled = False
    bpy.ops.material_palette.add_region(name="sky")
    before = data_blocks()
    assert "'sky'" in refused(bpy.ops.material_palette.extract)
    assert data_blocks() == before
    assert temporary_folders() == []
    assert "'sky'" in bpy.context.window_manager.material_palette_run.error


def test_refusals_name_what_is_wrong(ready):
    ready.regions[0].name = "a/b"
    ready.regions[1].name = "a_b"
    assert "'a/b' and 'a_b'" in refused(bpy.ops.material_palette.extract)
    ready.regions[1].name = "right"
    ready.regions[1].mask.scale(80, 48)
    message = refused(bpy.ops.material_palette.extract)
    assert "'right'" in message and "80 x 48" in message and "160 x 96" in message
    for region in ready.regions:
        region.enabled = False
    assert "No region" in refused(bpy.ops.material_palette.extract)
    ready.photo = None
    assert not bpy.ops.material_palette.extract.poll()


def test_engine_diffusion_says_what_it_needs(ready, data_blocks):
    ready.engine = "diffusion"
    before = data_blocks()
    assert "model" in refused(bpy.ops.material_palette.extract)
    assert data_blocks() == before


def test_a_failed_run_leaves_nothing(ready, monkeypatch, data_blocks, temporary_folders):
    from material_palette.core import palette

    def extract_palette(*_arguments, **_keywords):
        raise PaletteError("the disk is full")

    monkeypatch.setattr(palette, "extract_palette", extract_palette)
    before = data_blocks()
    assert "the disk is full" in refused(bpy.ops.material_palette.extract)
    assert data_blocks() == before
    assert temporary_folders() == []
    assert bpy.context.window_manager.material_palette_run.error == "the disk is full"


def test_a_failing_build_is_named_and_leaves_the_others(ready, instant, monkeypatch, capfd, temporary_folders):
    from material_palette.core import nodes

    def mark_asset(material, *_told):
        if material.name == "right":
            raise PaletteError("no asset")

    monkeypatch.setattr(nodes, "mark_asset", mark_asset)
    bpy.ops.material_palette.extract()
    assert "Region 'right' failed: no asset" in capfd.readouterr().out
    assert ready.regions[1].error == "no asset" and ready.regions[0].error == ""
    assert [material.name for material in bpy.data.materials] == ["left"]
    assert all(image.name.startswith("left") for image in bpy.data.images if "_" in image.name)
    assert temporary_folders() == []


class Endless:
    """A pipeline that works until it is told to stop, and says when it has begun and ended."""

    def __init__(self):
        self.begun, self.ended = threading.Event(), threading.Event()

    def __call__(self, pixels, regions, settings, progress, on_material=None, photo_name="", focal=None):
        try:
            while True:
                progress(0.3, "working")
                self.begun.set()
                time.sleep(0.05)
        finally:
            self.ended.set()


@pytest.fixture
def endless(monkeypatch):
    from material_palette.core import palette

    pipeline = Endless()
    monkeypatch.setattr(palette, "extract_palette", pipeline)
    return pipeline


class Modal:
    """Stands for the operator in a window, which background mode doesn't have."""

    bl_label = "Extract Palette"
    only_active, is_whole, kept = False, True, None

    def __init__(self):
        self.reports = []

    def report(self, kind, message):
        self.reports.append(message)

    def start(self):
        from material_palette.operators.extract import MATERIAL_PALETTE_OT_extract as Extract

        methods = "prepare regions seed receive finish discard cancel _take _start _drain _end _fail"
        for name in methods.split():
            function = getattr(Extract, name)
            setattr(self, name, function if name == "discard" else function.__get__(self))
        assert self._start(bpy.context)
        return self


@pytest.fixture
def running(ready, endless):
    operator = Modal().start()
    assert endless.begun.wait(20)
    return operator


def run_state():
    return bpy.context.window_manager.material_palette_run


def test_cancel_ends_within_half_a_second_and_leaves_nothing(running, endless, data_blocks, temporary_folders):
    before = data_blocks()
    assert run_state().running
    assert run_state().message == "working"
    assert not bpy.ops.material_palette.extract.poll()  # one run at a time
    asked = time.monotonic()
    assert bpy.ops.material_palette.cancel() == {"FINISHED"}
    while (result := running._drain(bpy.context)) is None:
        assert time.monotonic() - asked < 0.5
        time.sleep(0.01)
    assert result == {"CANCELLED"}
    assert endless.ended.is_set()
    assert not run_state().running
    assert run_state().error == ""
    assert data_blocks() == before
    assert temporary_folders() == []


def test_cancel_into_a_folder_leaves_no_folder(ready, endless, tmp_path):
    ready.pack = False
    ready.output_folder = str(tmp_path / "out")
    files = sorted(tmp_path.rglob("*"))
    operator = Modal().start()
    assert endless.begun.wait(20)
    bpy.ops.material_palette.cancel()
    while operator._drain(bpy.context) is None:
        time.sleep(0.01)
    assert sorted(tmp_path.rglob("*")) == files


class Stepwise:
    """A pipeline whose second region waits until it is told to go on or to stop."""

    def __init__(self, textured):
        self.textured, self.go = textured, threading.Event()

    def __call__(self, pixels, region, settings, progress, *_view_focal_engine):
        while region.name == "right" and not self.go.is_set():
            progress(0.1, "waiting")
            time.sleep(0.01)
        return self.textured(pixels, region, settings, progress)


@pytest.fixture
def stepwise(ready, instant, monkeypatch):
    """An extraction that has made its first material and waits with the second."""
    from material_palette.core import palette

    steps = Stepwise(palette._textured)
    monkeypatch.setattr(palette, "_textured", steps)

    def start():
        operator = Modal().start()
        end = time.monotonic() + 20
        while not ready.palette:
            assert operator._drain(bpy.context) is None and time.monotonic() < end
            time.sleep(0.01)
        return operator

    start.go = steps.go
    return start


def drain(operator):
    while (result := operator._drain(bpy.context)) is None:
        time.sleep(0.01)
    return result


def test_materials_appear_one_by_one(stepwise, ready):
    operator = stepwise()
    assert [entry.material.name for entry in ready.palette] == ["left"]
    assert run_state().running
    stepwise.go.set()
    assert drain(operator) == {"FINISHED"}
    assert [entry.material.name for entry in ready.palette] == ["left", "right"]


def test_cancel_keeps_what_is_finished(stepwise, ready, temporary_folders):
    operator = stepwise()
    bpy.ops.material_palette.cancel()
    assert drain(operator) == {"FINISHED"}  # so that undo takes it back
    assert [entry.material.name for entry in ready.palette] == ["left"]
    assert operator.reports == ["Cancelled: 1 material finished before"]
    assert temporary_folders() == []


def test_cancel_into_a_folder_writes_what_is_finished(stepwise, ready, tmp_path):
    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    operator = stepwise()
    assert not (tmp_path / "out").exists()
    bpy.ops.material_palette.cancel()
    drain(operator)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "left",
        "masks",
        "palette.json",
        "palette.png",
    ]
    for image in (node.image for node in ready.palette[0].material.node_tree.nodes if hasattr(node, "image")):
        assert Path(image.filepath_raw).is_file()


def textures_of(settings):
    """{name: whether it is packed or its file is there} of the pictures of the palette's materials."""
    images = [image for entry in settings.palette for image in images_in(entry.material)]
    return {i.name: bool(i.packed_file) or Path(bpy.path.abspath(i.filepath_raw)).is_file() for i in images}


def test_cancel_while_a_folder_is_written_keeps_all(ready, instant, tmp_path, monkeypatch):
    from material_palette.core import sheet
    from material_palette.operators import background

    draw = sheet.contact_sheet

    def cancelled(palette):
        background.cancel()
        return draw(palette)

    monkeypatch.setattr(sheet, "contact_sheet", cancelled)
    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    assert drain(Modal().start()) == {"FINISHED"}
    assert (tmp_path / "out" / "palette.json").is_file()
    assert textures_of(ready) == {"left_basecolor": True, "right_basecolor": True}


def test_a_folder_that_fails_at_the_end_leaves_materials_whole(ready, instant, tmp_path):
    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    bpy.ops.material_palette.extract()
    old = [entry.material for entry in ready.palette]
    (tmp_path / "out" / "mine").mkdir()
    (tmp_path / "out" / "mine" / "mine_basecolor.png").write_bytes(b"a file of the user's")
    ready.regions[0].name, ready.overwrite = "mine", True
    operator = Modal().start()
    assert drain(operator) == {"CANCELLED"} and "in the way" in operator.reports[-1]
    assert all(textures_of(ready).values())
    for entry, before in zip(ready.palette, old, strict=True):
        assert before in (entry.material, entry.previous)
        assert all(Path(image.filepath_raw).is_file() for image in images_in(before))


def test_a_run_that_is_stopped_leaves_materials_whole(stepwise, ready, tmp_path):
    from material_palette.operators import background

    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    stepwise()
    background.stop()
    assert textures_of(ready) == {"left_basecolor": True} and not (tmp_path / "out").exists()


def test_undo_during_a_run_loses_nothing_of_it(stepwise, ready):
    bpy.context.preferences.edit.use_global_undo = True
    bpy.ops.ed.undo_push(message="before")
    bpy.data.meshes.new("cube")
    bpy.ops.ed.undo_push(message="cube")
    operator = stepwise()
    bpy.ops.ed.undo()
    assert len(bpy.data.materials) == 0
    stepwise.go.set()
    assert drain(operator) == {"FINISHED"}
    palette = bpy.context.scene.material_palette.palette
    assert sorted(entry.material.name for entry in palette) == ["left", "right"]
    assert all(image.size[0] == 64 for entry in palette for image in images_in(entry.material))


def images_in(material):
    return [node.image for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage"]


def test_loading_another_file_with_some_finished_leaves_nothing(stepwise, ready, tmp_path, temporary_folders):
    ready.pack, ready.output_folder = False, str(tmp_path / "out")
    stepwise()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert not (tmp_path / "out").exists()
    assert len(bpy.data.materials) == 0
    assert temporary_folders() == []


def test_loading_another_file_stops_the_run(running, endless, tmp_path, temporary_folders):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert endless.ended.is_set()
    assert not run_state().running
    assert len(bpy.data.materials) == 0
    assert temporary_folders() == []


def test_disabling_the_extension_stops_the_run(running, endless, extension, temporary_folders):
    extension.unregister()
    try:
        assert endless.ended.is_set()
        assert temporary_folders() == []
        assert not [thread for thread in threading.enumerate() if thread.name == "material_palette"]
    finally:
        extension.register()
    assert not run_state().running


def test_blender_taking_the_operator_away_stops_the_run(running, endless, temporary_folders):
    running.cancel(bpy.context)
    assert endless.ended.is_set()
    assert temporary_folders() == []
    assert not run_state().running


def test_a_result_for_a_removed_scene_is_thrown_away(ready, instant, data_blocks, temporary_folders):
    operator = Modal().start()
    scene = bpy.context.scene
    bpy.context.window.scene = bpy.data.scenes.new("other")
    bpy.data.scenes.remove(scene)
    before = data_blocks()
    while (result := operator._drain(bpy.context)) is None:
        time.sleep(0.01)
    assert result == {"CANCELLED"}
    assert "scene" in operator.reports[-1]
    assert data_blocks() == before
    assert temporary_folders() == []


def test_segment_replaces_what_it_found_before_and_keeps_the_rest(ready):
    ready.auto_regions = 3
    ready.active_region = 1
    bpy.ops.material_palette.remove_region()
    assert bpy.ops.material_palette.segment() == {"FINISHED"}
    found = [region.name for region in ready.regions][1:]
    assert ready.regions[0].name == "left"
    assert 1 <= len(found) <= 3
    assert all(tuple(region.mask.size) == (160, 96) for region in ready.regions)
    assert bpy.ops.material_palette.segment() == {"FINISHED"}
    assert [region.name for region in ready.regions] == ["left", *found]


def test_segment_leaves_out_what_is_the_artists_already(ready, monkeypatch, capfd):
    """Here the photo is seen at half its size, as a huge one is."""
    from material_palette.core import segmentation
    from material_palette.core.region import Region
    from material_palette.operators.regions import read_mask_image

    bpy.ops.material_palette.remove_region()
    (own,) = ready.regions
    mine = read_mask_image(own)
    same, other = mine[::2, ::2].copy(), ~mine[::2, ::2]
    same[:4] = True  # most of it is painted already
    other[-8:] = True  # some of it is

    def segment(pixels, engine, count, seed, progress, warn, weights):
        warn("The sky is left out")
        return [Region("region_1", same), Region("region_2", other)]

    monkeypatch.setattr(segmentation, "segment", segment)
    assert bpy.ops.material_palette.segment() == {"FINISHED"}
    assert [region.name for region in ready.regions] == [own.name, "region_2"]
    found = read_mask_image(ready.regions[1])
    assert found.shape == mine.shape and (read_mask_image(own) == mine).all()
    assert not (found & mine).any() and found[~mine].mean() > 0.95
    assert "1 regions found, 1 are yours already. The sky is left out" in capfd.readouterr().out


def test_segment_adds_nothing_to_a_photo_that_was_chosen_meanwhile(ready, monkeypatch):
    from material_palette.core import segmentation
    from material_palette.core.region import Region

    other = bpy.data.images.new("other", 30, 20)

    def segment(pixels, *_args):
        ready.photo = other
        return [Region("found", np.ones(pixels.shape[:2], bool))]

    monkeypatch.setattr(segmentation, "segment", segment)
    with pytest.raises(RuntimeError, match="Another photo was chosen meanwhile"):
        bpy.ops.material_palette.segment()
    assert [region.name for region in ready.regions] == ["left", "right"]


def test_segment_by_weights_says_which_it_needs(ready):
    ready.segmentation = "sam"
    assert "Pick With" in refused(bpy.ops.material_palette.segment)


def add_object(name, content):
    obj = bpy.data.objects.new(name, content)
    bpy.context.collection.objects.link(obj)
    obj.select_set(True)
    return obj


@pytest.fixture
def palette(settings):
    """A palette of one material that needs no photo."""
    entry = settings.palette.add()
    entry.name = "stone"
    entry.material = bpy.data.materials.new("stone")
    if entry.material.node_tree is None:
        entry.material.use_nodes = True
    return settings


def test_assign_gives_every_selected_object_the_material(palette, capfd):
    mesh = bpy.data.meshes.new("wall")
    wall, curve = add_object("wall", mesh), add_object("path", bpy.data.curves.new("path", "CURVE"))
    light = add_object("sun", bpy.data.lights.new("sun", "SUN"))
    other = add_object("floor", bpy.data.meshes.new("floor"))
    other.select_set(False)
    assert bpy.ops.material_palette.assign() == {"FINISHED"}
    assert wall.active_material == curve.active_material == palette.palette[0].material
    assert other.active_material is None
    assert "'sun' can't hold a material" in capfd.readouterr().out
    assert light.data is not None


def test_assign_replaces_the_active_slot_only(palette):
    mesh = bpy.data.meshes.new("wall")
    old = [bpy.data.materials.new(name) for name in ("a", "b")]
    for material in old:
        mesh.materials.append(material)
    wall = add_object("wall", mesh)
    wall.active_material_index = 1
    bpy.ops.material_palette.assign()
    assert list(mesh.materials) == [old[0], palette.palette[0].material]


def test_assign_says_when_a_texture_can_not_be_seen(palette, capfd):
    palette.palette[0].material.node_tree.nodes.new("ShaderNodeTexImage")
    add_object("wall", bpy.data.meshes.new("wall"))
    bpy.ops.material_palette.assign()
    assert "'wall' has no UV map" in capfd.readouterr().out


def test_assign_refuses_with_the_reason(palette):
    assert "No object is selected" in refused(bpy.ops.material_palette.assign)
    light = add_object("sun", bpy.data.lights.new("sun", "SUN"))
    assert "'sun' can't hold a material" in refused(bpy.ops.material_palette.assign)
    bpy.data.objects.remove(light)
    add_object("wall", bpy.data.meshes.new("wall"))
    bpy.data.materials.remove(palette.palette[0].material)
    assert "was deleted" in refused(bpy.ops.material_palette.assign)
    palette.palette.clear()
    assert not bpy.ops.material_palette.assign.poll()


def test_undo_takes_a_palette_back_in_one_step(ready, instant):
    bpy.context.preferences.edit.use_global_undo = True
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.material_palette.extract()
    bpy.ops.ed.undo_push(message="Extract Palette")  # background mode pushes none by itself
    assert len(bpy.data.materials) == 2
    bpy.ops.ed.undo()
    assert len(bpy.data.materials) == 0
    assert len(bpy.context.scene.material_palette.palette) == 0
    assert len(bpy.context.scene.material_palette.regions) == 2
    bpy.ops.ed.redo()
    assert len(bpy.context.scene.material_palette.palette) == 2
    assert Path(bpy.app.tempdir).is_dir()
