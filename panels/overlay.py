"""The regions over the photo in the Image Editor: tinted, outlined at any zoom, and while one is painted, the photo."""

import bpy

from ..operators import examine

_VERTEX = """
void main() {
  uv = corner;
  gl_Position = ModelViewProjectionMatrix * vec4(mix(low, high, corner), 0.0, 1.0);
}
"""

# The frame buffer is sRGB and encodes what is written: photo (linear after sampling) and tint are mixed as linear.
_PHOTO = """
void main() {
  float inside = step(0.001, texture(mask, uv).r);
  colour = vec4(texture(photo, uv).rgb * mix(0.3, 1.0, inside), 1.0);
}
"""

# Inside a tint; where the mask changes within `width` pixels of the screen, a line.
_REGION = """
void main() {
  vec2 pixel = 1.0 / (high - low);
  float inside = step(0.001, texture(mask, uv).r);
  float least = inside, most = inside;
  for (int i = 0; i < 4; i++) {
    vec2 corner = vec2(i & 1, i >> 1) * 2.0 - 1.0;
    float there = step(0.001, texture(mask, uv + 0.85 * width * pixel * corner).r);
    least = min(least, there);
    most = max(most, there);
  }
  float line = most - least;
  colour = vec4(pow(tint, vec3(2.2)), max(line, inside * fill));
}
"""

_handle = None
_shaders = {}


def register():
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister():
    global _handle
    if _handle is not None:
        bpy.types.SpaceImageEditor.draw_handler_remove(_handle, "WINDOW")
    _handle = None
    _shaders.clear()


def _draw():
    import gpu

    context = bpy.context
    settings = context.scene.material_palette
    image = context.space_data.image
    if image is None or settings.photo is None:
        return
    view = context.region.view2d
    painted = next((region for region in settings.regions if region.mask == image), None)
    if painted is not None:
        examine.changed(image)
        _draw_square("photo", _PHOTO, view, photo=settings.photo, mask=image)
    elif image != settings.photo or not settings.show_regions:
        return
    active = settings.regions[settings.active_region] if settings.active_region < len(settings.regions) else None
    others = (
        [region for region in settings.regions if region.visible and region != active] if settings.show_regions else []
    )
    gpu.state.blend_set("ALPHA")
    for region in [*others, *([active] if active and (active.visible or painted) else [])]:
        if region.mask is not None and all(region.mask.size):
            width, fill = (2.0, 0.2) if region == active else (1.0, 0.07)
            values = {"tint": region.colour, "width": width, "fill": 0.15 if painted == region else fill}
            _draw_square("region", _REGION, view, mask=region.mask, **values)
    gpu.state.blend_set("NONE")


def _draw_square(name, fragment, view, **values):
    """Draw the image's place in the editor with a shader; images become samplers, other values push constants."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    images = [key for key, value in values.items() if isinstance(value, bpy.types.Image)]
    if name not in _shaders:
        shader = _make_shader(gpu, fragment, images)
        _shaders[name] = shader, batch_for_shader(shader, "TRI_FAN", {"corner": ((0, 0), (1, 0), (1, 1), (0, 1))})
    shader, batch = _shaders[name]
    shader.bind()
    shader.uniform_float("low", view.view_to_region(0.0, 0.0, clip=False))
    shader.uniform_float("high", view.view_to_region(1.0, 1.0, clip=False))
    matrix = gpu.matrix.get_projection_matrix() @ gpu.matrix.get_model_view_matrix()
    shader.uniform_float("ModelViewProjectionMatrix", matrix)
    for key, value in values.items():
        if key in images:
            shader.uniform_sampler(key, gpu.texture.from_image(value))
        else:
            shader.uniform_float(key, value)
    batch.draw(shader)


def _make_shader(gpu, fragment, images):
    link = gpu.types.GPUStageInterfaceInfo("material_palette_link")
    link.smooth("VEC2", "uv")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "ModelViewProjectionMatrix")
    info.push_constant("VEC2", "low")
    info.push_constant("VEC2", "high")
    if "tint" in fragment:
        info.push_constant("VEC3", "tint")
        info.push_constant("FLOAT", "width")
        info.push_constant("FLOAT", "fill")
    for slot, name in enumerate(images):
        info.sampler(slot, "FLOAT_2D", name)
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(link)
    info.fragment_out(0, "VEC4", "colour")
    info.vertex_source(_VERTEX)
    info.fragment_source(fragment)
    return gpu.shader.create_from_info(info)
