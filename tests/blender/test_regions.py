"""Edits of regions as the operators do them, and what the list says of a region."""

import os

import bpy
import cv2
import numpy as np
import pytest
from material_palette.core.errors import PaletteError


@pytest.fixture
def regions(settings, photo_and_masks):
    photo, masks = photo_and_masks
    bpy.ops.material_palette.open_photo(filepath=str(photo))
    bpy.ops.material_palette.import_masks(directory=str(masks))
    return settings.regions


def mask_of(region):
    from material_palette.operators.regions import read_mask_image

    return read_mask_image(region)


def test_grow_and_shrink_from_the_menu(regions):
    before = mask_of(regions[0])
    bpy.ops.material_palette.grow_region(distance=4)
    grown = mask_of(regions[0])
    assert grown.sum() > before.sum() and (grown >= before).all()
    bpy.ops.material_palette.grow_region(distance=-6)
    assert (mask_of(regions[0]) < grown).any() and not (mask_of(regions[0]) > grown).any()
    with pytest.raises(RuntimeError, match="Nothing of 'left'"):
        bpy.ops.material_palette.grow_region(distance=-500)
    assert mask_of(regions[0]).any()


def test_merge_and_split_undo_each_other(settings, regions):
    left, right = mask_of(regions[0]), mask_of(regions[1])
    key = regions[0].key
    images = len(bpy.data.images)
    bpy.ops.material_palette.merge_region(other=str(regions[1].key))
    assert [region.key for region in regions] == [key] and (mask_of(regions[0]) == left | right).all()
    assert len(bpy.data.images) == images - 1
    bpy.ops.material_palette.split_region()
    assert [region.name for region in regions] == ["left", "left 2"] and regions[0].key == key
    assert {mask_of(region).sum() for region in regions} == {left.sum(), right.sum()}


def test_importing_new_masks_with_known_ones_updates_those(regions, tmp_path):
    """Each new region may move the others in memory before a known one gets its mask."""
    from material_palette.core.image import write_image

    more = tmp_path / "more"
    more.mkdir()
    masks = {name: np.zeros((96, 160), np.float32) for name in [*(f"a{i:03}" for i in range(300)), "right", "z"]}
    for row, (name, mask) in enumerate(masks.items()):
        mask[row % 60 : row % 60 + 30, 20:90] = 1.0
        write_image(more / f"{name}.png", mask)
    bpy.ops.material_palette.import_masks(directory=str(more))
    assert [region.name for region in regions] == ["left", "right", *list(masks)[:-2], "z"]
    for name, mask in masks.items():
        assert (mask_of(regions[name]) == mask.astype(bool)).all()


def test_outline_adds_takes_away_and_begins(settings, regions):
    from material_palette.operators.draw_region import apply_outline

    before = mask_of(regions[0])
    box = [(0, 80), (60, 80), (60, 96), (0, 96)]
    apply_outline(settings, box)
    assert mask_of(regions[0])[85:95, 5:55].all() and mask_of(regions[0]).sum() > before.sum()
    apply_outline(settings, box, take_away=True)
    assert not mask_of(regions[0])[81:, :59].any()
    bpy.ops.material_palette.remove_all_regions()
    apply_outline(settings, box)
    assert len(regions) == 1 and mask_of(regions[0]).sum() == pytest.approx(60 * 16, rel=0.1)


def test_an_edited_region_is_no_longer_automatic(settings, regions):
    regions[0].automatic = True
    bpy.ops.material_palette.smooth_region(radius=2)
    assert not regions[0].automatic


def test_the_list_says_what_is_wrong(settings, regions):
    from material_palette.operators.draw_region import apply_outline
    from material_palette.operators.examine import examine

    examined, thumbnail = examine(settings, regions[0])
    assert examined.warning == "" and examined.area == pytest.approx(mask_of(regions[0]).mean())
    inside = thumbnail[..., 3] > 0
    assert inside.any() and thumbnail[inside][:, :3].std() > 0.05
    bpy.ops.material_palette.add_region(name="sky")
    assert "empty" in examine(settings, regions[2])[0].warning
    apply_outline(settings, [(0, 0), (5, 0), (5, 5), (0, 5)])
    assert "too small" in examine(settings, regions[2])[0].warning
    settings.photo = bpy.data.images.new("grey", 160, 96)
    assert "constant" in examine(settings, regions[0])[0].warning
    settings.photo = bpy.data.images.new("larger", 200, 96)
    assert "paint it anew" in examine(settings, regions[0])[0].warning


def test_a_mask_of_another_size_is_not_drawn_on(settings, regions):
    from material_palette.operators.draw_region import apply_outline

    settings.photo = bpy.data.images.new("larger", 200, 96)
    with pytest.raises(PaletteError, match="paint it anew"):
        apply_outline(settings, [(0, 0), (50, 0), (50, 50)])


def test_defaults_are_restored_and_nothing_else(settings, regions):
    settings.quality, settings.resolution, settings.seed, settings.pack = "best", 256, 9, False
    bpy.ops.material_palette.restore_defaults()
    assert (settings.quality, settings.resolution, settings.seed, settings.pack) == ("balanced", 1024, 0, True)
    assert settings.photo is not None and len(regions) == 2


def test_defaults_of_the_preferences_are_those_restored(settings, regions, monkeypatch):
    from types import SimpleNamespace

    from material_palette.operators import preferences

    chosen = SimpleNamespace(quality="draft", resolution=512, author="Me", licence="CC0")
    monkeypatch.setattr(preferences, "preferences", lambda context: chosen)
    settings.quality, settings.author = "best", "Another"
    bpy.ops.material_palette.restore_defaults()
    assert (settings.quality, settings.resolution, settings.author) == ("draft", 512, "Another")


def test_the_warning_sign_says_the_reason_and_chooses_the_region(settings, regions):
    from types import SimpleNamespace

    from material_palette.operators.regions import MATERIAL_PALETTE_OT_explain_region as Explain

    regions[1].error = "Region 'right' is empty"
    settings.active_region = 0
    assert Explain.description(bpy.context, SimpleNamespace(index=1)) == "Region 'right' is empty"
    assert Explain.description(bpy.context, SimpleNamespace(index=7)) == Explain.__doc__
    assert bpy.ops.material_palette.explain_region(index=1) == {"FINISHED"}
    assert settings.active_region == 1


def test_tools_of_the_mouse_say_that_they_need_one(settings, regions):
    with pytest.raises(RuntimeError, match="needs a window"):
        bpy.ops.material_palette.draw_region(shape="BOX")


@pytest.mark.parametrize("press", ["PRESS", "DOUBLE_CLICK"])
def test_a_press_begins_a_box_even_as_a_double_click(press):
    from types import SimpleNamespace

    from material_palette.operators.draw_region import MATERIAL_PALETTE_OT_draw_region as Draw

    tool = SimpleNamespace(shape="BOX", drawing=False, mouse=lambda event: ((3, 4), True))
    event = SimpleNamespace(type="LEFTMOUSE", value=press, ctrl=False)
    assert Draw.handle(tool, bpy.context, event) == {"RUNNING_MODAL"}
    assert tool.drawing and tool.points == [(3, 4)]


@pytest.mark.parametrize("closed", [False, True])
def test_a_failing_tool_of_the_mouse_leaves_nothing_behind(closed):
    """Even where its editor was closed by what failed: Blender's object of it can't be used then."""
    from types import SimpleNamespace

    from material_palette.operators.draw_region import OverPhoto, _handlers

    class Area:
        type = "IMAGE_EDITOR"

        def tag_redraw(self):
            if closed:
                raise ReferenceError("StructRNA of type Area has been removed")
            done.append("redraw")

    class Tool(OverPhoto):
        def handle(self, context, event):
            if closed:
                areas.clear()
            raise KeyError("a bug")

    done, tool = [], Tool()
    tool.area = Area()
    areas = [tool.area]
    tool.handler = bpy.types.SpaceImageEditor.draw_handler_add(lambda: None, (), "WINDOW", "POST_PIXEL")
    _handlers.add(tool.handler)
    window = SimpleNamespace(screen=SimpleNamespace(areas=areas), cursor_modal_restore=lambda: done.append("cursor"))
    context = SimpleNamespace(window=window, workspace=SimpleNamespace(status_text_set=lambda text: done.append(text)))
    with pytest.raises(KeyError, match="a bug"):
        tool.modal(context, SimpleNamespace(type="LEFTMOUSE", value="PRESS"))
    assert not _handlers and done == ["cursor", None] + ["redraw"] * (not closed)


class Layout:
    """Stands for the sidebar: refuses what Blender's would only print, and remembers what is said."""

    def __init__(self, said):
        self.__dict__["said"] = said

    def __setattr__(self, name, value):
        pass

    def __getattr__(self, name):
        def call(*arguments, **keywords):
            if name in {"prop", "template_list"}:
                data, field = arguments[:2] if name == "prop" else arguments[2:4]
                assert field in data.bl_rna.properties, field
                if name == "prop":
                    self.said.append(keywords.get("text", field))
            if name == "icon":
                return 1
            if name == "operator":
                module, operator = arguments[0].split(".")
                rna = getattr(getattr(bpy.ops, module), operator).get_rna_type()
                self.said.append(keywords.get("text", rna.name))
                return type("Properties", (), {})()
            if name == "label":
                self.said.append(keywords["text"])
            return Layout(self.said)

        return call


@pytest.fixture
def draw(settings):
    """draw(): what all panels of the sidebar say now."""
    from types import SimpleNamespace

    from material_palette.panels import sidebar

    def drawn():
        said = []
        context = SimpleNamespace(
            scene=bpy.context.scene,
            window_manager=bpy.context.window_manager,
            preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0), addons={}),
            region=SimpleNamespace(width=300),
            space_data=SimpleNamespace(type="VIEW_3D", bl_rna=bpy.types.SpaceView3D.bl_rna),
        )
        for section in sidebar._SECTIONS:
            if not hasattr(section, "poll") or section.poll(context):
                section.draw(SimpleNamespace(layout=Layout(said)), context)
        return said

    return drawn


def test_the_sidebar_shows_what_there_is(draw, settings, photo_and_masks, make_record, write_maps, tmp_path):
    from material_palette.core import nodes
    from material_palette.operators.palette import put_in_palette

    assert "Open Photo" in draw() and "Materials appear here" in draw()
    photo, masks = photo_and_masks
    bpy.ops.material_palette.open_photo(filepath=str(photo))
    bpy.ops.material_palette.import_masks(directory=str(masks))
    assert any(text.startswith("2 regions: about") and text.endswith("a guess") for text in draw())
    settings.regions[0].error = "Region 'left' is empty"
    assert "Region 'left' is empty" in draw()
    material = nodes.build_material(make_record(write_maps()), tmp_path, pack=True)
    put_in_palette(settings, settings.regions[0].key, material).warnings = "over-exposed"
    for view in ("GRID", "LIST"):
        settings.palette_view = view
        said = draw()
        assert {"Assign", "Assign and Map", "Variation", "tile_size", "Roughness ±", "relief"} <= set(said)
        assert "Compare" not in said and "Over-exposed" in said
    bpy.data.materials.remove(material)
    assert "Remove from Palette" in draw()


def test_pick_selects_the_clicked_half(settings, regions):
    """Of a photo whose halves differ in colour a click finds its own one; it is looked at once."""
    from material_palette.operators import pick

    image = bpy.data.images.new("halves", 160, 96)
    pixels = np.random.default_rng(0).normal(0.4, 0.02, (96, 160, 4)).astype(np.float32)
    pixels[:, 80:, 1:] *= 0.3
    image.pixels.foreach_set(pixels.ravel())
    for x in (40, 120):
        mask = pick.select(image, [(x, 40, True)], 0.5)
        inside = (np.arange(160) < 80) == (x < 80)
        assert mask.shape == (96, 160)
        assert mask[:, inside].mean() > 0.8 and mask[:, ~inside].mean() < 0.1
    assert not pick.select(image, [(40, 40, True), (40, 80, False)], 0.5)[80, 40]
    assert len(pick._features) == 1
    pick.forget()


def test_a_photo_that_was_written_anew_is_looked_at_again(settings, tmp_path):
    """Its name and size stay; the halves change places."""
    from material_palette.operators import examine, pick

    path = tmp_path / "halves.png"

    def write(bright):
        pixels = np.random.default_rng(0).normal(90, 4, (96, 160, 3))
        pixels[:, bright, 0] += 100
        cv2.imwrite(str(path), pixels.clip(0, 255).astype(np.uint8))

    write(slice(0, 80))
    image = bpy.data.images.load(str(path))
    first = pick.select(image, [(20, 40, True)], 0.5), examine._photo(image).astype(int)
    write(slice(40, 160))
    os.utime(path, ns=(0, 10**18))
    image.reload()
    second = pick.select(image, [(20, 40, True)], 0.5), examine._photo(image).astype(int)
    assert first[0][:, 50:70].mean() > 0.8 and second[0][:, 50:70].mean() < 0.1
    assert abs(first[1] - second[1])[:, :30, 2].min() > 30
    pick.forget()
    examine.forget()


def test_pick_by_weights_of_the_preferences_gets_clicks_and_box_in_px_of_what_it_saw(settings, monkeypatch):
    """A photo that was reduced for the model: what is clicked and dragged on the large one has to be scaled."""
    from material_palette.core import segmentation
    from material_palette.operators import pick

    seen = []

    class Model:
        takes_box = True
        shape = (48, 80)

        def look(self, pixels):
            seen.append(pixels.shape)

        def select(self, clicks, tolerance, box=None):
            seen.append(([(click.x, click.y, click.positive) for click in clicks], tolerance, box))
            mask = np.zeros(self.shape, bool)
            mask[:, :40] = True
            return mask

    monkeypatch.setattr(segmentation, "picker", lambda weights: seen.append(weights) or Model())
    image = bpy.data.images.new("large", 160, 96)
    mask = pick.select(image, [(40, 20, True), (150, 90, False)], 0.3, "/weights", box=(10, 20, 100, 90))
    assert seen == ["/weights", (96, 160, 3), ([(20, 10, True), (75, 45, False)], 0.3, (5, 10, 50, 45))]
    assert mask.shape == (96, 160) and mask[:, :80].all() and not mask[:, 80:].any()
    pick.select(image, [(40, 20, True)], 0.3, "/weights")
    assert seen[-1][2] is None and len(seen) == 4  # looked at once
    pick.forget()
