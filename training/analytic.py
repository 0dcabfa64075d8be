"""How the constants of `core/decomposition/analytic.py` were found: a search on training materials, checked on others.

    .venv/bin/python training/analytic.py DATA

DATA is a folder with pbr/<set>/<material>/{basecolor,normal,roughness}.jpg. Held out are the set `polyhaven` and every
fourth material of the other sets; sets whose normals were derived from a height of unknown scale are left out. Each
material is rendered once under a directional light over a soft sky; printed are the mean squared errors of the maps
beside those of doing nothing, and of roughness predicted by ridge regression beside one constant. About 4 minutes.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.core import brdf  # noqa: E402
from material_palette.core.decomposition import analytic  # noqa: E402
from material_palette.core.image import linear_from_srgb  # noqa: E402
from material_palette.core.torus import blur  # noqa: E402

SIZE = 512
FLAT = torch.tensor([0.0, 0.0, 1.0])


def materials(data: Path) -> tuple[list[Path], list[Path]]:
    training, held_out = [], []
    for collection in sorted((data / "pbr").iterdir()):
        if collection.name.endswith("-derived"):
            continue
        for i, folder in enumerate(sorted(collection.iterdir())):
            if all((folder / f"{name}.jpg").exists() for name in ("basecolor", "normal", "roughness")):
                (held_out if collection.name == "polyhaven" or i % 4 == 3 else training).append(folder)
    return training, held_out


def rendering(folder: Path, seed: int) -> dict[str, torch.Tensor]:
    def read(name):
        pixels = cv2.imread(str(folder / f"{name}.jpg"))[..., ::-1].astype(np.float32) / 255
        return cv2.resize(pixels, (SIZE, SIZE), interpolation=cv2.INTER_AREA)

    generator = torch.Generator().manual_seed(seed)
    albedo = torch.from_numpy(linear_from_srgb(read("basecolor")))
    normal = torch.nn.functional.normalize(torch.from_numpy(read("normal")) * 2 - 1, dim=-1)
    roughness = torch.from_numpy(read("roughness")[..., 0].copy())
    azimuth, height, sky = torch.rand(3, generator=generator).tolist()
    azimuth, height, sky = azimuth * 2 * np.pi, 0.5 + 0.5 * height, 0.3 + 0.5 * sky
    flat = np.sqrt(1 - height**2)
    light = torch.tensor([np.cos(azimuth) * flat, np.sin(azimuth) * flat, height], dtype=torch.float32)
    direct = brdf.shade(albedo, normal, roughness, light.expand_as(normal), FLAT.expand_as(normal)) / height
    pixels = (1 - sky) * direct + sky * albedo * (0.5 + 0.5 * normal[..., 2:])
    return {"albedo": albedo, "normal": normal, "roughness": roughness, "pixels": pixels.clamp(0, 1)}


def errors(renderings) -> tuple[float, float]:
    albedo, normal = [], []
    for r in renderings:
        found = analytic.decompose(r["pixels"].numpy(), lambda fraction, message: None)
        albedo.append((torch.from_numpy(found.albedo) - r["albedo"]).square().mean())
        normal.append((torch.from_numpy(found.normal) - r["normal"]).square().mean())
    return float(np.mean(albedo)), float(np.mean(normal))


def statistics(pixels: torch.Tensor) -> torch.Tensor:
    """What roughness might be read from, per pixel (N, 7): of the whole texture and around the pixel."""
    luminance = torch.log(pixels @ torch.tensor([0.2126, 0.7152, 0.0722]) + 0.02)
    saturation = (pixels.amax(-1) - pixels.amin(-1)) / (pixels.amax(-1) + 0.02)
    deviation = luminance - luminance.mean()
    whole = [luminance.mean(), saturation.mean(), luminance.std()]
    around = [deviation, deviation - blur(deviation, 8), (luminance - blur(luminance, 2)).abs(), saturation]
    columns = [x.expand(SIZE, SIZE) for x in whole] + around
    return torch.stack(columns, -1)[::8, ::8].reshape(-1, len(columns))


def roughness_errors(training, held_out) -> None:
    train = [(statistics(r["pixels"]), r["roughness"][::8, ::8].flatten()) for r in training]
    test = [(statistics(r["pixels"]), r["roughness"][::8, ::8].flatten()) for r in held_out]
    x, y = torch.cat([s for s, _ in train]), torch.cat([r for _, r in train])
    mean, spread = x.mean(0), x.std(0)
    for ridge in (0.01, 0.3, 1.0, 1e6):
        z = torch.cat([(x - mean) / spread, torch.ones(len(x), 1)], 1)
        damping = ridge * torch.eye(z.shape[1])
        damping[-1, -1] = 0
        weights = torch.linalg.solve(z.T @ z / len(z) + damping, z.T @ y / len(z))
        found = [
            np.mean(
                [
                    float((torch.cat([(s - mean) / spread, torch.ones(len(s), 1)], 1) @ weights - r).square().mean())
                    for s, r in part
                ]
            )
            for part in (train, test)
        ]
        kind = f"constant {weights[-1]:.3f}" if ridge > 1e3 else f"regression, ridge {ridge}"
        print(f"roughness  {kind:24} training {found[0]:.4f}  held out {found[1]:.4f}")


def main() -> None:
    torch.set_num_threads(1)
    training, held_out = ([rendering(f, i) for i, f in enumerate(part)] for part in materials(Path(sys.argv[1])))
    print(f"{len(training)} training, {len(held_out)} held-out materials")
    for name, part in (("training", training), ("held out", held_out)):
        albedo = np.mean([float((r["pixels"] - r["albedo"]).square().mean()) for r in part])
        normal = np.mean([float((FLAT - r["normal"]).square().mean()) for r in part])
        print(f"nothing    {name}: albedo {albedo:.5f} normal {normal:.5f}")
    shipped = {name: getattr(analytic, name) for name in ("CHROMA", "SHADING", "RELIEF")}
    trials = {"CHROMA": (0.03, 0.1, 0.3), "SHADING": (0.0, 0.2, 0.3, 0.5), "RELIEF": (0.1, 0.2, 0.4, 0.8)}
    for name, values in trials.items():
        for value in values:
            setattr(analytic, name, value)
            albedo, normal = errors(training)
            mark = "  <- shipped" if value == shipped[name] else ""
            print(f"{name:8} {value:4}  training: albedo {albedo:.5f} normal {normal:.5f}{mark}", flush=True)
        setattr(analytic, name, shipped[name])
    albedo, normal = errors(held_out)
    print(f"shipped    held out: albedo {albedo:.5f} normal {normal:.5f}")
    roughness_errors(training, held_out)


if __name__ == "__main__":
    main()
