"""A material for other programs: maps with the artist's adjustments in them, glTF's packing, MaterialX documents."""

from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np

from .image import srgb_from_linear, write_image
from .torus import resize


def adjust_colour(albedo: np.ndarray, hue: float, saturation: float, brightness: float) -> np.ndarray:
    """(..., 3) linear float32 as Blender's Hue/Saturation/Value node has it: HSV of the linear colour."""
    if (hue, saturation, brightness) == (0.5, 1.0, 1.0):
        return albedo
    hsv = cv2.cvtColor(np.asarray(albedo, np.float32).reshape(1, -1, 3), cv2.COLOR_RGB2HSV)  # hue in degrees
    hsv[..., 0] = (hsv[..., 0] + 360.0 * (hue - 0.5)) % 360.0
    hsv[..., 1] = np.clip(hsv[..., 1] * saturation, 0.0, 1.0)
    hsv[..., 2] *= brightness
    return np.maximum(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), 0.0).reshape(albedo.shape)


def adjust_normal(normal: np.ndarray, strength: float, rotation: float) -> np.ndarray:
    """(..., 3) unit vectors with their slope times `strength`, turned as the picture is whose coordinates are turned by
    `rotation` radians."""
    x, y, z = np.moveaxis(np.asarray(normal, np.float32), -1, 0)
    cosine, sine = np.cos(-rotation), np.sin(-rotation)
    turned = np.stack([strength * (cosine * x - sine * y), strength * (sine * x + cosine * y), np.maximum(z, 1e-3)], -1)
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def write_gltf_maps(folder: Path, name: str, maps: dict, bits: dict | None = None) -> list[str]:
    """Write glTF's set of a material into `folder`; return the names of its files.

    maps: "basecolor" (H, W, 3) linear or (3,), "normal" (H, W, 3) or None, "roughness" and "metallic" (H, W) or float.
    bits: those of a map where they aren't 8. `<name>_orm.png` holds occlusion (none: 1), roughness and metallic in red,
    green and blue.
    """
    bits = {"basecolor": 8, "normal": 8, "roughness": 8} | (bits or {})
    shapes = [value.shape[:2] for kind, value in maps.items() if np.ndim(value) > 1 and kind != "height"]
    height, width = max(shapes) if shapes else (4, 4)

    def full(value):
        value = np.asarray(value, np.float32)
        if value.ndim and value.shape != (height, width):  # maps have no more texels than they need
            value = resize(value[..., None], (height, width))[..., 0]
        return np.broadcast_to(value, (height, width))

    base = np.asarray(maps["basecolor"], np.float32)
    pictures = {
        "basecolor": np.clip(srgb_from_linear(base if base.ndim > 1 else np.broadcast_to(base, (4, 4, 3))), 0, 1),
        "orm": np.stack([full(1.0), full(maps["roughness"]), full(maps["metallic"])], -1),
    }
    if maps.get("normal") is not None:
        pictures["normal"] = (maps["normal"] + 1) / 2
    for kind, picture in pictures.items():
        depth = bits["roughness" if kind == "orm" else kind]
        write_image(folder / f"{name}_{kind}.png", np.ascontiguousarray(picture, dtype=np.float32), depth)
    return [f"{name}_{kind}.png" for kind in pictures]


def write_materialx(path: Path, name: str, maps: dict, tile_size: float | None, rotation: float = 0.0) -> None:
    """Write a MaterialX 1.38 document: a standard_surface from image files and values.

    maps: "basecolor", "roughness", "metallic", "normal" and "height" to a file name relative to the document, or to a
    value: a colour (3,) linear, a number. "normal" and "height" may be missing; "height_scale" is the relief that the
    height's range spans, in metres, around its middle. tile_size: metres that one repeat covers
    where a UV unit is a metre. rotation: of the UV coordinates, in radians.
    """
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    name = name if name[:1].isalpha() else f"m_{name}"
    root = ElementTree.Element("materialx", version="1.38", colorspace="lin_rec709")
    graph = ElementTree.SubElement(root, "nodegraph", name=f"NG_{name}")
    shader = ElementTree.Element("standard_surface", name=f"SR_{name}", type="surfaceshader")
    displacement = None
    uses_files = any(isinstance(value, str) for value in maps.values())
    if uses_files and rotation:
        _node(graph, "texcoord", "uv", "vector2")
        _node(graph, "rotate2d", "turned", "vector2", {"in": ("vector2", "uv", "nodename")}).append(
            _input("amount", "float", f"{np.degrees(rotation):.6g}")
        )

    def image(kind, type_, colorspace=None):
        node = _node(graph, "tiledimage", f"image_{kind}", type_)
        node.append(_input("file", "filename", maps[kind], colorspace=colorspace))
        node.append(_input("uvtiling", "vector2", ", ".join([f"{1.0 / (tile_size or 1.0):.6g}"] * 2)))
        if rotation:
            node.append(_input("texcoord", "vector2", "turned", "nodename"))
        return node.get("name")

    def output(kind, type_, nodename):
        ElementTree.SubElement(graph, "output", name=f"out_{kind}", type=type_, nodename=nodename)

    for kind, socket, type_ in (
        ("basecolor", "base_color", "color3"),
        ("roughness", "specular_roughness", "float"),
        ("metallic", "metalness", "float"),
    ):
        value = maps[kind]
        if isinstance(value, str):
            output(kind, type_, image(kind, type_, "srgb_texture" if kind == "basecolor" else None))
            shader.append(_input(socket, type_, f"out_{kind}", "output", nodegraph=graph.get("name")))
        else:
            shader.append(_input(socket, type_, ", ".join(f"{v:.6g}" for v in np.atleast_1d(value))))
    shader.append(_input("base", "float", "1"))
    if isinstance(maps.get("normal"), str):
        inputs = {"in": ("vector3", image("normal", "vector3"), "nodename")}
        output("normal", "vector3", _node(graph, "normalmap", "bend", "vector3", inputs).get("name"))
        shader.append(_input("normal", "vector3", "out_normal", "output", nodegraph=graph.get("name")))
    if isinstance(maps.get("height"), str):
        middle = {"in1": ("float", image("height", "float"), "nodename"), "in2": ("float", "0.5", "value")}
        output("height", "float", _node(graph, "subtract", "centred", "float", middle).get("name"))
        displacement = ElementTree.Element("displacement", name=f"DS_{name}", type="displacementshader")
        displacement.append(_input("displacement", "float", "out_height", "output", nodegraph=graph.get("name")))
        displacement.append(_input("scale", "float", f"{maps['height_scale']:.6g}"))
    if len(graph) == 0:
        root.remove(graph)
    root.append(shader)
    material = ElementTree.Element("surfacematerial", name=name, type="material")
    material.append(_input("surfaceshader", "surfaceshader", shader.get("name"), "nodename"))
    if displacement is not None:
        root.append(displacement)
        material.append(_input("displacementshader", "displacementshader", displacement.get("name"), "nodename"))
    root.append(material)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _node(graph, category, name, type_, inputs=None):
    node = ElementTree.SubElement(graph, category, name=name, type=type_)
    for key, (input_type, value, how) in (inputs or {}).items():
        node.append(_input(key, input_type, value, how))
    return node


def _input(name, type_, value, how="value", **more):
    return ElementTree.Element(
        "input", {"name": name, "type": type_, how: value} | {key: text for key, text in more.items() if text}
    )
