"""Planes and cameras for tests that look at a scene."""

import bpy
import numpy as np


def plane(name, material, size, height=0.0):
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / 2
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(x, y, height) for x, y in corners], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new().data.foreach_set("uv", corners.astype(np.float32).ravel())
    if material is not None:
        mesh.materials.append(material)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def camera(name, place, kind="ORTHO", scale=4.0):
    lens = bpy.data.cameras.new(name)
    lens.type, lens.ortho_scale = kind, scale
    obj = bpy.data.objects.new(name, lens)
    obj.location = place
    bpy.context.scene.collection.objects.link(obj)
    return obj
