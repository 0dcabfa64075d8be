"""Materials on objects and faces, at their real size."""

import bpy
import numpy as np
import pytest


@pytest.fixture
def stone(settings):
    """A palette of one textured material."""
    entry = settings.palette.add()
    entry.name = "stone"
    entry.material = bpy.data.materials.new("stone")
    if entry.material.node_tree is None:
        entry.material.use_nodes = True
    entry.material.node_tree.nodes.new("ShaderNodeTexImage")
    return entry.material


@pytest.fixture
def cube(stone):
    bpy.ops.mesh.primitive_cube_add(size=2)
    cube = bpy.context.object
    cube.data.uv_layers.remove(cube.data.uv_layers[0])
    return cube


def corners_of(mesh):
    """[(f, 4, 3) positions, (f, 4, 2) UVs] of a mesh of quadrilaterals."""
    uv = mesh.uv_layers.active.data
    faces = [polygon.loop_indices for polygon in mesh.polygons]
    points = [[mesh.vertices[mesh.loops[i].vertex_index].co[:] for i in face] for face in faces]
    return np.array(points), np.array([[uv[i].uv[:] for i in face] for face in faces])


def test_box_mapping_is_in_metres_and_not_mirrored(cube):
    cube.scale = (1.0, 2.0, 0.5)
    bpy.context.view_layer.update()
    assert bpy.ops.material_palette.assign(mapping="UNMAPPED") == {"FINISHED"}
    points, uv = corners_of(cube.data)
    world = points * (1.0, 2.0, 0.5)
    for face in range(6):
        for a in range(4):
            b = (a + 1) % 4
            length = np.linalg.norm(world[face, a] - world[face, b])
            assert np.linalg.norm(uv[face, a] - uv[face, b]) == pytest.approx(length, rel=1e-4)
        # corners run counter-clockwise seen from outside, so a map that isn't mirrored has a positive area
        x, y = uv[face].T
        assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() > 0


def test_box_mapping_is_upright_on_walls(cube):
    bpy.ops.material_palette.assign(mapping="UNMAPPED")
    points, uv = corners_of(cube.data)
    walls = [face for face in range(6) if np.ptp(points[face, :, 2]) > 1]
    assert len(walls) == 4
    for face in walls:
        np.testing.assert_allclose(uv[face, :, 1], points[face, :, 2], atol=1e-5)


def test_assign_keeps_a_uv_map_unless_told_otherwise(stone):
    bpy.ops.mesh.primitive_plane_add(size=10)
    plane = bpy.context.object
    bpy.ops.material_palette.assign(mapping="UNMAPPED")
    assert [layer.name for layer in plane.data.uv_layers] == ["UVMap"]
    bpy.ops.material_palette.assign(mapping="ALL")
    assert plane.data.uv_layers.active.name == "Palette Metres" and plane.data.uv_layers.active.active_render
    assert len(plane.data.uv_layers) == 2
    bpy.ops.material_palette.assign(mapping="ALL")
    assert len(plane.data.uv_layers) == 2


def test_selected_faces_alone_in_edit_mode(cube, stone):
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    with pytest.raises(RuntimeError, match="No face is selected"):
        bpy.ops.material_palette.assign()
    bpy.ops.object.mode_set(mode="OBJECT")
    cube.data.polygons[2].select = True
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.material_palette.assign(mapping="UNMAPPED")
    assert bpy.context.mode == "EDIT_MESH"
    bpy.ops.object.mode_set(mode="OBJECT")
    given = [cube.material_slots[polygon.material_index].material for polygon in cube.data.polygons]
    assert given == [None, None, stone, None, None, None]
    assert cube.data.uv_layers.active is not None


def test_replace_material_everywhere(stone):
    old = bpy.data.materials.new("old")
    other = bpy.data.materials.new("other")
    for name, material in (("a", old), ("b", other), ("c", old)):
        obj = bpy.data.objects.new(name, bpy.data.meshes.new(name))
        obj.data.materials.append(material)
        bpy.context.collection.objects.link(obj)
    assert bpy.ops.material_palette.replace_material(other="old") == {"FINISHED"}
    assert [bpy.data.objects[name].active_material for name in "abc"] == [stone, other, stone]


def test_one_mesh_of_two_objects_is_mapped_once(cube):
    twin = bpy.data.objects.new("twin", cube.data)
    bpy.context.collection.objects.link(twin)
    twin.select_set(True)
    bpy.ops.material_palette.assign(mapping="UNMAPPED")
    assert len(cube.data.uv_layers) == 1
