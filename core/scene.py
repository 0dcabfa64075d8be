"""How many texels of each material a scene's cameras can show: rays through the picture, and the density they find.

Per camera and frame a grid of rays is cast into the evaluated scene, so that occlusion, modifiers and instances count.
Where one meets a material of ours, the Jacobian of pixels by tiles is that of the projection times that of the face's
UV map and the material's Mapping node; its larger singular value is the pixels that a tile is long there. Beside
nodes.py the only module of core that touches Blender; it runs on the main thread.
"""

from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Vector

from .errors import PaletteError
from .nodes import Controls

ACROSS = 96  # rays along the picture's longer side
FRAMES = 16  # looked at, at most, of the frame range
WITHIN = 95  # percent of a material's pixels in a picture get a texel each; the rest are its nearest
THROUGH = 4  # panes that a ray passes
_SEE_THROUGH = {"ShaderNodeBsdfGlass", "ShaderNodeBsdfTransparent", "ShaderNodeBsdfRefraction"}

Progress = Callable[[float, str], None]


@dataclass
class Seen:
    """texels: along a tile's side that the nearest camera shows, 0 where none sees it. share: of a picture that it
    covers, at most. displaced: its relief is bump or displacement. why: it can't be told, and the maps have to stay;
    else empty."""

    texels: float = 0.0
    share: float = 0.0
    displaced: bool = False
    why: str = ""


def look(scene, materials, progress: Progress = lambda fraction, message: None) -> dict[str, Seen]:
    """What the cameras of `scene`, which is the window's, see of each of the materials, by name.

    All its cameras, over its frame range, at its render resolution. What is seen only in a mirror counts as not seen.
    The frame is as before afterwards. Raises PaletteError for a scene without camera.
    """
    found = {}
    for material in materials:
        displaced = bool(Controls(material)) and Controls(material).relief != "NORMAL"
        found[material.name] = Seen(displaced=displaced, why=_unjudged(scene, material))
    cameras = [obj for obj in scene.objects if obj.type == "CAMERA"]
    if not cameras:
        raise PaletteError(f"scene '{scene.name}' has no camera; add one where the palette will be seen from")
    render = scene.render
    size = [max(1, n * render.resolution_percentage // 100) for n in (render.resolution_x, render.resolution_y)]
    first, last, before = scene.frame_start, scene.frame_end, scene.frame_current
    frames = np.unique(np.linspace(first, last, min(FRAMES, last - first + 1)).round().astype(int))
    if not _moves(scene):
        frames = frames[:1]
    try:
        for i, frame in enumerate(frames):
            scene.frame_set(int(frame))
            depsgraph = bpy.context.evaluated_depsgraph_get()
            for k, camera in enumerate(cameras):
                progress((i + k / len(cameras)) / len(frames), f"looking through {camera.name}")
                evaluated = camera.evaluated_get(depsgraph)
                for name, lengths, share in _from_camera(scene, depsgraph, evaluated, size, found):
                    one = found[name]
                    one.texels = max(one.texels, float(np.percentile(lengths, WITHIN)) if lengths else 0.0)
                    one.share = max(one.share, share)
    finally:
        scene.frame_set(before)
    return found


def _moves(scene) -> bool:
    """Whether anything may change from frame to frame."""
    blocks = (bpy.data.actions, bpy.data.cache_files, bpy.data.movieclips)
    return any(map(len, blocks)) or scene.rigidbody_world is not None or any(obj.modifiers for obj in scene.objects)


def _unjudged(scene, material) -> str:
    controls = Controls(material)
    mapping = controls.node("mapping") if controls else None
    if not controls:
        return "its nodes were taken apart"
    if mapping is None:
        return ""  # constants
    vector, scale = mapping.inputs["Vector"], mapping.inputs["Scale"]
    if scale.is_linked or not vector.is_linked or vector.links[0].from_socket.name != "UV":
        return "it is not mapped by UV coordinates"
    for obj in scene.objects:
        has_it = any(slot.material == material for slot in obj.material_slots)
        if has_it and not obj.hide_render and not obj.visible_get():
            return f"'{obj.name}' has it, and is hidden in the viewport"
    return ""


def _from_camera(scene, depsgraph, camera, size, wanted):
    """(name, pixels per tile of each ray that meets it, share of the picture) of the materials that a camera sees."""
    aspect = scene.render.pixel_aspect_x, scene.render.pixel_aspect_y
    projection = camera.calc_matrix_camera(depsgraph, x=size[0], y=size[1], scale_x=aspect[0], scale_y=aspect[1])
    whole = np.array(projection @ camera.matrix_world.inverted())
    back = np.linalg.inv(whole)
    step = max(size) / ACROSS
    columns, rows = (np.arange(max(1, round(n / step))) for n in size)
    columns, rows = (2 * (n + 0.5) / len(n) - 1 for n in (columns, rows))
    hits = {}
    for y in rows:
        for x in columns:
            near, far = (_dehomogenised(back @ (x, y, z, 1)) for z in (-1.0, 1.0))
            start, way = Vector(near), Vector(far - near)
            length = way.length
            way.normalize()
            for _ in range(THROUGH):
                hit, place, _, index, obj, matrix = scene.ray_cast(depsgraph, start, way, distance=length)
                if not hit:
                    break
                obj = obj.evaluated_get(depsgraph)  # with its modifiers, which the face's number counts
                name, passes = _material(obj, index)
                if name in wanted:
                    hits.setdefault((name, obj, tuple(map(tuple, matrix))), []).append((index, *place))
                if not passes:
                    break
                start, length = place + way * (1e-4 * max(1.0, place.length)), length - (place - start).length
    lengths, counts = {}, {}
    for (name, obj, matrix), met in hits.items():
        counts[name] = counts.get(name, 0) + len(met)
        mapping = Controls(bpy.data.materials[name]).node("mapping")
        if mapping is not None:
            scale = np.array(mapping.inputs["Scale"].default_value[:2])
            found = _pixels_per_tile(obj.data, np.array(matrix), scale, met, whole, size)
            lengths.setdefault(name, []).extend(found)
    return [(name, lengths.get(name, []), count / (len(rows) * len(columns))) for name, count in counts.items()]


def _dehomogenised(point):
    return point[:3] / point[3]


def _material(obj, index):
    """The name of the face's material, and whether a ray may pass it."""
    if obj.type != "MESH" or index < 0 or index >= len(obj.data.polygons) or not obj.material_slots:
        return None, obj.display_type in {"WIRE", "BOUNDS"} or obj.type == "VOLUME"
    slot = min(obj.data.polygons[index].material_index, len(obj.material_slots) - 1)
    material = obj.material_slots[slot].material
    if material is None:
        return None, False
    return material.original.name, _lets_through(material)


def _lets_through(material) -> bool:
    for node in material.node_tree.nodes if material.node_tree else ():
        if node.bl_idname in _SEE_THROUGH:
            return True
        if node.bl_idname == "ShaderNodeBsdfPrincipled":
            alpha, transmission = node.inputs["Alpha"], node.inputs["Transmission Weight"]
            if alpha.is_linked or alpha.default_value < 1 or transmission.is_linked or transmission.default_value > 0:
                return True
    return False


def _pixels_per_tile(mesh, matrix, scale, met, whole, size) -> list[float]:
    """Pixels that a tile is long, the longer way, where rays have met a mesh: (face, x, y, z) each."""
    layer = next((layer for layer in mesh.uv_layers if layer.active_render), None)
    if layer is None:
        return []  # without UV map the surface shows one texel
    lengths = []
    jacobians = {}
    for face, *place in met:
        if face not in jacobians:
            polygon = mesh.polygons[face]
            uv = np.array([layer.uv[i].vector for i in polygon.loop_indices]) * scale
            points = np.array([mesh.vertices[i].co for i in polygon.vertices]) @ matrix[:3, :3].T
            uv, points = uv - uv.mean(0), points - points.mean(0)
            square = uv.T @ uv
            flat = np.linalg.det(square) < 1e-12 * max(np.trace(square), 1e-12) ** 2
            jacobians[face] = None if flat else points.T @ uv @ np.linalg.inv(square)
        if jacobians[face] is None:
            continue
        x, y, _, w = whole @ (*place, 1)
        moved = whole[:, :3] @ jacobians[face]  # (4, 2): clip coordinates by tiles
        pixels = (moved[:2] * w - np.array([[x], [y]]) * moved[3]) / w**2 * np.array(size)[:, None] / 2
        lengths.append(float(np.linalg.norm(pixels, 2)))
    return lengths
