"""Enabling adds the extension's parts, disabling leaves nothing of them."""

import gc
import sys
from types import SimpleNamespace

import bpy
import pytest

HANDLERS = [name for name in dir(bpy.app.handlers) if isinstance(getattr(bpy.app.handlers, name), list)]


def registered():
    """Everything that an extension can leave behind, by place."""
    found = {
        "types": set(dir(bpy.types)),
        "scene": set(bpy.types.Scene.bl_rna.properties.keys()),
        "window manager": set(bpy.types.WindowManager.bl_rna.properties.keys()),
        "image": set(bpy.types.Image.bl_rna.properties.keys()),
        "material": set(bpy.types.Material.bl_rna.properties.keys()),
        "operators": {f"{module}.{name}" for module in dir(bpy.ops) for name in dir(getattr(bpy.ops, module))},
    }
    for name in HANDLERS:
        found[name] = list(getattr(bpy.app.handlers, name))
    for name in (
        "TOPBAR_MT_editor_menus",
        "STATUSBAR_HT_header",
        "IMAGE_MT_image",
        "VIEW3D_MT_object",
        "VIEW3D_MT_edit_mesh",
    ):
        draw = getattr(bpy.types, name).draw
        ours = (function.__module__ for function in getattr(draw, "_draw_funcs", ()))
        found[name] = [module for module in ours if not module.startswith("bl_ui")]
    return found


@pytest.mark.parametrize("times", [1, 3])
def test_disabling_leaves_nothing(times):
    package = sys.modules["material_palette"]
    before = registered()
    for _ in range(times):
        package.register()
        package.unregister()
    gc.collect()
    assert registered() == before
    assert not hasattr(bpy.types.Scene, "material_palette")
    assert not hasattr(bpy.types.WindowManager, "material_palette_run")


def test_disabling_takes_the_command_back(monkeypatch):
    package = sys.modules["material_palette"]
    commands = {}

    def register(name, execute):
        commands[handle := object()] = name
        return handle

    monkeypatch.setattr(bpy.utils, "register_cli_command", register)
    monkeypatch.setattr(bpy.utils, "unregister_cli_command", commands.pop)
    package.register()
    assert list(commands.values()) == ["material_palette"]
    package.unregister()
    assert commands == {}


def test_panels_are_in_both_editors(extension):
    panels = {name for name in dir(bpy.types) if name.startswith("MATERIAL_PALETTE_PT_")}
    sections = ("photo", "regions", "extract", "options", "palette", "adjust")
    spaces = ("image_editor", "view_3d")
    sidebar = {f"MATERIAL_PALETTE_PT_{section}_{space}" for section in sections for space in spaces}
    assert panels == sidebar | {"MATERIAL_PALETTE_PT_material"}
    assert bpy.context.scene.material_palette.resolution == 1024
    assert not bpy.context.window_manager.material_palette_run.running


def test_every_operator_and_setting_says_what_it_does(extension):
    operators = [getattr(bpy.ops.material_palette, name) for name in dir(bpy.ops.material_palette)]
    types = [operator.get_rna_type() for operator in operators]
    assert len(types) > 15
    groups = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("MATERIAL_PALETTE_PG_")]
    for rna in types:
        assert len(rna.description.split()) > 3 and rna.name != rna.identifier, rna.identifier
    for group in groups:
        for prop in group.bl_rna.properties:
            if prop.identifier not in {"rna_type", "name"} and not prop.is_hidden:
                said = prop.description or prop.type in {"COLLECTION", "POINTER"}
                assert said or prop.identifier in {"running", "progress", "message"}, (group, prop.identifier)


def test_search_finds_every_verb(extension):
    """Blender's search looks through menus: each operator of the artist's stands in one, or is the panel's alone."""
    from material_palette.panels import menus

    listed = set()

    class Layout:
        def operator(self, idname, *_, **_more):
            listed.add(idname)
            return self

        operator_menu_enum = operator

        def menu(self, idname, **_):
            getattr(bpy.types, idname).draw(SimpleNamespace(layout=self), bpy.context)

        def separator(self):
            pass

    for place in ("IMAGE_MT_image", "VIEW3D_MT_object", "VIEW3D_MT_edit_mesh"):
        assert menus._draw in getattr(bpy.types, place).draw._draw_funcs
    menus._draw(SimpleNamespace(layout=Layout()), bpy.context)
    verbs = {
        cls.bl_idname
        for cls in bpy.types.Operator.__subclasses__()
        if cls.__name__.startswith("MATERIAL_PALETTE_OT_") and "INTERNAL" not in getattr(cls, "bl_options", ())
    }
    assert len(verbs) > 30
    assert verbs - listed <= {"material_palette.copy_install_command"}


def test_choices_are_those_of_the_pipeline(extension):
    pytest.importorskip("torch")
    from material_palette import properties
    from material_palette.core import engines, palette, segmentation

    assert {identifier for identifier, *_ in properties.ENGINES} == set(engines.ENGINES)
    assert {identifier for identifier, *_ in properties.SEGMENTATIONS} == set(segmentation.SEGMENTERS)
    number = properties.MATERIAL_PALETTE_PG_settings.bl_rna.properties["auto_regions"]
    assert (number.default, number.hard_max) == (segmentation.REGIONS, segmentation.MOST_REGIONS)
    assert tuple(identifier for identifier, *_ in properties.QUALITIES) == tuple(palette.QUALITIES)
    assert tuple(identifier for identifier, *_ in properties.WHITE_BALANCES) == palette.WHITE_BALANCES
    assert tuple(properties.RESOLUTION_RANGE) == tuple(palette.RESOLUTION_RANGE)
    assert tuple(properties.SCALE_RANGE) == tuple(palette.SCALE_RANGE)


def test_a_scene_keeps_its_settings_in_the_file(settings, tmp_path):
    settings.resolution = 2048
    settings.quality = "best"
    path = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=path)
    settings = bpy.context.scene.material_palette
    assert (settings.resolution, settings.quality) == (2048, "best")
