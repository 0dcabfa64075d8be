"""While an Image Editor shows a region's mask, show the photo there: tinted within the region, dim outside."""

import bpy

_VERTEX = """
void main() {
  uv = corner;
  gl_Position = ModelViewProjectionMatrix * vec4(mix(low, high, corner), 0.0, 1.0);
}
"""

# The frame buffer is sRGB and encodes what is written: photo (linear after sampling) and tint are mixed as linear.
_FRAGMENT = """
void main() {
  vec3 shown = texture(photo, uv).rgb;
  float inside = step(0.001, texture(mask, uv).r);
  shown = mix(shown * 0.25, mix(shown, pow(tint, vec3(2.2)), 0.35), inside);
  colour = vec4(shown, 1.0);
}
"""

_handle = None
_shader = None


def register():
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister():
    global _handle, _shader
    if _handle is not None:
        bpy.types.SpaceImageEditor.draw_handler_remove(_handle, "WINDOW")
    _handle = _shader = None


def _draw():
    context = bpy.context
    settings = context.scene.material_palette
    image = context.space_data.image
    if image is None or settings.photo is None:
        return
    region = next((region for region in settings.regions if region.mask == image), None)
    if region is not None:
        _draw_region(context.region.view2d, settings.photo, image, region.colour)


def _draw_region(view, photo, mask, colour):
    import gpu
    from gpu_extras.batch import batch_for_shader

    global _shader
    if _shader is None:
        _shader = _make_shader(gpu)
    square = ((0, 0), (1, 0), (1, 1), (0, 1))
    batch = batch_for_shader(_shader, "TRI_FAN", {"corner": square})
    _shader.bind()
    _shader.uniform_float("low", view.view_to_region(0.0, 0.0, clip=False))
    _shader.uniform_float("high", view.view_to_region(1.0, 1.0, clip=False))
    _shader.uniform_float("tint", colour)
    matrix = gpu.matrix.get_projection_matrix() @ gpu.matrix.get_model_view_matrix()
    _shader.uniform_float("ModelViewProjectionMatrix", matrix)
    _shader.uniform_sampler("photo", gpu.texture.from_image(photo))
    _shader.uniform_sampler("mask", gpu.texture.from_image(mask))
    batch.draw(_shader)


def _make_shader(gpu):
    link = gpu.types.GPUStageInterfaceInfo("material_palette_link")
    link.smooth("VEC2", "uv")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "ModelViewProjectionMatrix")
    info.push_constant("VEC2", "low")
    info.push_constant("VEC2", "high")
    info.push_constant("VEC3", "tint")
    info.sampler(0, "FLOAT_2D", "photo")
    info.sampler(1, "FLOAT_2D", "mask")
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(link)
    info.fragment_out(0, "VEC4", "colour")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return gpu.shader.create_from_info(info)
