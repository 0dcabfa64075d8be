"""Cook-Torrance GGX, the model that the maps mean and Principled BSDF renders.

Against Cycles on spheres under a sun, roughness 0.2 to 1 (`tests/blender/test_brdf_cycles.py`): the light of
dielectrics and metals is within 3 % with Blender's single-scattering GGX. Blender's default adds the light scattered
several times between facets, which makes rough metals brighter than here: a golden one by 12 % at roughness 0.6.
"""

import math

import numpy as np
import torch

F0 = 0.04  # normal reflectance of a dielectric of index 1.5


def shade(albedo, normal, roughness, light, view, metallic=0.0):
    """Light reflected towards the viewer per unit of irradiance at normal incidence, times pi.

    albedo (..., 3) linear; normal, light, view (..., 3) unit vectors; roughness (...) perceptual, alpha = roughness^2;
    metallic (...). Returns (..., 3): a white matt surface facing the light would give 1, here it gives 0.96, and the
    rest is reflected. Light and viewer can be exchanged; differentiable in everything.
    Source: Walter et al. 2007 (GGX), Smith's separable masking, Schlick 1994 (Fresnel).
    """
    half = light + view
    half = half / half.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-6)
    nl = (normal * light).sum(-1, keepdim=True).clamp_min(0)
    nv = (normal * view).sum(-1, keepdim=True).clamp_min(1e-4)
    # rounded up above 1 it would divide by zero where a surface is a mirror
    nh = (normal * half).sum(-1, keepdim=True).clamp(0, 1)
    vh = (view * half).sum(-1, keepdim=True).clamp_min(0)
    alpha2 = torch.as_tensor(roughness)[..., None].clamp_min(0.02) ** 4
    metallic = torch.as_tensor(metallic, dtype=albedo.dtype)[..., None]
    distribution = alpha2 / (math.pi * (nh**2 * (alpha2 - 1) + 1) ** 2)

    def smith(cosine):
        return 2 * cosine / (cosine + torch.sqrt(alpha2 + (1 - alpha2) * cosine**2))

    f0 = F0 * (1 - metallic) + albedo * metallic
    fresnel = f0 + (1 - f0) * (1 - vh) ** 5
    specular = distribution * smith(nl) * smith(nv) * fresnel / (4 * nl * nv).clamp_min(1e-4)
    # what the surface reflects does not get in
    diffuse = (1 - metallic) * (1 - fresnel) * albedo / math.pi
    return math.pi * nl * (diffuse + specular)


def plane(height: int, width: int) -> torch.Tensor:
    """Places (height, width, 3) of the pixels of a picture 1 wide around the origin, x to the right, y up, z = 0."""
    x = (torch.arange(width) + 0.5) / width - 0.5
    y = (0.5 - (torch.arange(height) + 0.5) / height) * height / width
    return torch.stack([x.expand(height, width), y[:, None].expand(-1, width), torch.zeros(height, width)], -1)


def towards(point: torch.Tensor, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit vectors (..., 3) from places to a point (..., 3), a lamp or the eye, and how its light falls off (..., 1).

    The falloff is 1 at as far from the point as the origin is.
    """
    way = point - places
    squared = way.square().sum(-1, keepdim=True)
    return way / squared.sqrt(), point.square().sum(-1, keepdim=True) / squared


def sky(count: int) -> torch.Tensor:
    """Unit vectors (count, 3) spread evenly over the hemisphere above z = 0: an environment is a sum of such lights.

    With intensity 2 / count each they are a sky of radiance 1. Source: Fibonacci lattice, Gonzalez 2010.
    """
    i = torch.arange(count) + 0.5
    z, angle = 1 - i / count, i * (math.pi * (1 + 5**0.5))
    flat = torch.sqrt(1 - z**2)
    return torch.stack([flat * torch.cos(angle), flat * torch.sin(angle), z], -1)


def render(albedo, normal, roughness, lights, intensity, view, metallic=0.0) -> torch.Tensor:
    """Light (..., H, W, 3) from a material under several lights.

    Maps as in `shade`, (..., H, W, 3) and (..., H, W); lights (L, ..., 3) unit vectors and intensity (L, ..., 3 or 1),
    the rest of each broadcast against the maps: (L, 1, 1, 3) is L suns; for lamps take both from `towards`. view is
    shaped as one light.
    """
    return sum(
        shade(albedo, normal, roughness, light, view, metallic) * strength
        for light, strength in zip(lights, intensity, strict=True)
    )


def render_sphere(svbrdf, size: int = 256, tiles: float = 2.0, rotation: float = 0.0) -> np.ndarray:
    """Picture of a sphere of the material, (size, size, 4) float32 linear RGBA, lit by a key light and a soft sky.

    tiles is how often the texture repeats across the sphere's visible half; its coordinates are turned by `rotation`
    radians, the directions that its normals hold are not.
    """
    axis = (torch.arange(size) + 0.5) / size * 2.2 - 1.1
    x, y = axis[None].expand(size, -1), -axis[:, None].expand(-1, size)
    r2 = x**2 + y**2
    z = torch.sqrt((1 - r2).clamp_min(0))
    geometric = torch.stack([x, y, z], -1)
    longitude, latitude = torch.atan2(x, z), torch.asin(y.clamp(-1, 1))
    u, v = longitude / math.pi * tiles, -latitude / math.pi * tiles
    u, v = math.cos(rotation) * u + math.sin(rotation) * v, math.cos(rotation) * v - math.sin(rotation) * u

    def look_up(value, channels):
        value = torch.as_tensor(np.asarray(value, np.float32))
        if value.ndim < 2:
            return value.expand(size, size, channels) if channels > 1 else value.expand(size, size)
        # the texture is averaged down to the sphere's own resolution first, as a renderer's mipmap does
        step = max(1, int(value.shape[1] * tiles / math.pi * 2.2 / size))
        h, w = value.shape[0] // step, value.shape[1] // step
        value = value[: h * step, : w * step].reshape(h, step, w, step, -1).mean((1, 3))
        picked = value[(v * h).long() % h, (u * w).long() % w]
        return picked if channels > 1 else picked[..., 0]

    albedo, roughness = look_up(svbrdf.albedo, 3), look_up(svbrdf.roughness, 1)
    mapped = torch.nn.functional.normalize(look_up(svbrdf.normal, 3), dim=-1)
    metallic = 0.0 if svbrdf.metallic is None else look_up(svbrdf.metallic, 1)
    tangent = torch.stack([torch.cos(longitude), torch.zeros_like(x), -torch.sin(longitude)], -1)
    bitangent = torch.linalg.cross(geometric, tangent, dim=-1)
    normal = mapped[..., :1] * tangent + mapped[..., 1:2] * bitangent + mapped[..., 2:] * geometric
    normal = torch.nn.functional.normalize(normal, dim=-1)
    view = torch.tensor([0.0, 0.0, 1.0]).expand_as(normal)
    key = torch.nn.functional.normalize(torch.tensor([-0.5, 0.6, 0.65]), dim=0).expand_as(normal)
    sky = 0.35 + 0.25 * normal[..., 1:2]
    colour = 0.9 * shade(albedo, normal, roughness, key, view, metallic) + sky * albedo
    alpha = ((1.0 - torch.sqrt(r2)) * size / 2.2 + 0.5).clamp(0, 1)
    return torch.cat([colour.clamp(0, 1), alpha[..., None]], -1).numpy().astype(np.float32)
