#!/usr/bin/env python3
"""What a scene needs: textures, file, seconds and memory of full and of fitted palettes, and how pictures differ.

    python3 dev.py bench needs --data DATA          # about 10 minutes of one core
    python3 dev.py bench needs --quick              # one small scene, from the bundled photo

Three scenes of `scenes.py`, each with the palette of the bundled photo as it is extracted with --full-maps, and with
materials of DATA (CC0, test split, in their own size). Each is rendered by Cycles with the full palette and with it
fitted to the scene for several errors that may be made; the product's own functions fit, write and build. Three suns
light it one after the other and together, without bounces, and a pixel is the mean of samples on a grid: pictures have
no noise, so that what differs is the textures. Seconds and memory are those of a process that opens the file and
renders it as a user would. Writes needs.csv, needs.json, the chart, and needs.jpg: the full palette's picture, the
fitted one's, and their FLIP.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import charts, records, scenes  # noqa: E402
from material_palette.core import palette, reduction  # noqa: E402
from material_palette.core.flip import flip  # noqa: E402
from material_palette.core.image import linear_from_srgb, read_photo, srgb_from_linear  # noqa: E402
from material_palette.core.material import SVBRDF  # noqa: E402
from material_palette.core.region import read_regions  # noqa: E402

SIZE, GRID = (960, 540), 8  # samples along a pixel's side
BORDER = (0.4375, 0.5625, 0.35, 0.5)  # what is rendered: from left to right and from below, whole pixels
SUNS = (((0.6, 0.2, 0.4), 2.5), ((0.9, 0.0, -0.9), 1.2), ((0.3, -0.9, 0.0), 0.8))  # rotation, strength
VISIBLE = (0.016, reduction.VISIBLE, 0.034)
EXAMPLE = ROOT / "examples" / "viaduct"
SHIPPED = f"fitted, {reduction.VISIBLE:g}"
COST_SAMPLES = 16
# opens a .blend, renders it, and tells its CPU seconds and its peak memory in MB after loading and at the end
RENDER = """
import bpy, json, resource, sys, time
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
start = time.process_time()
bpy.ops.render.render()
print(json.dumps([time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024]))
"""


def quiet(fraction: float, message: str) -> None:
    pass


def bundled(folder: Path, resolution: int) -> list[palette.Material]:
    """The bundled photo's palette with nothing reduced, extracted once into `folder`."""
    if not (folder / "palette.json").exists():
        photo = read_photo(EXAMPLE / "photo.jpg")
        regions = read_regions(EXAMPLE / "masks", photo.pixels.shape[:2], photo.scale)
        settings = palette.Settings(resolution=resolution, quality="draft", full_maps=True)
        folder.mkdir(parents=True)
        palette.write_palette(palette.extract_palette(photo.pixels, regions, settings, quiet), folder)
    return palette.read_palette(folder)[1]


def known(data: Path, number: int) -> list[palette.Material]:
    """Four materials of the data folder, square, at most 1024 px."""
    folders = sorted(p for p in (data / "pbr" / "polyhaven").iterdir() if (p / "roughness.jpg").exists())
    order = np.random.default_rng(0).permutation(len(folders))
    found = []
    for i in order[4 * number : 4 * number + 4]:
        maps = {kind: cv2.imread(str(folders[i] / f"{kind}.jpg")) for kind in reduction.KINDS}
        side = min(min(pixels.shape[:2]) for pixels in maps.values())
        maps = {kind: pixels[:side, :side, ::-1] / np.float32(255) for kind, pixels in maps.items()}
        normal = maps["normal"] * 2 - 1
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        albedo, roughness = linear_from_srgb(maps["basecolor"]), np.ascontiguousarray(maps["roughness"][..., 0])
        found.append(palette.Material(folders[i].name, svbrdf=SVBRDF(albedo, normal, roughness)))
    return found


def copy_of(material: palette.Material, svbrdf: SVBRDF, bits: dict | None = None) -> palette.Material:
    return palette.Material(
        material.name,
        svbrdf=svbrdf,
        bits=bits or dict.fromkeys(reduction.KINDS, 8),
        metres_per_tile=material.metres_per_tile,
    )


class Stage:
    """A scene, its parts dressed in a palette by the product's own node trees."""

    def __init__(self, kind: str, number: int, size, grid: int):
        import bpy

        self.bpy, self.grid = bpy, grid
        self.scene = scenes.Scene(kind, number, size)
        scene = bpy.context.scene
        scene.render.use_persistent_data, scene.frame_end = False, 1
        for obj in [obj for obj in scene.objects if obj.type == "LIGHT"]:
            bpy.data.objects.remove(obj)
        scene.world = None
        self.suns = []
        for i, (rotation, strength) in enumerate(SUNS):
            lamp = bpy.data.lights.new(f"sun {i}", "SUN")
            lamp.energy, lamp.angle = strength, 0
            obj = bpy.data.objects.new(lamp.name, lamp)
            obj.rotation_euler = rotation
            scene.collection.objects.link(obj)
            self.suns.append(obj)
        scene.cycles.max_bounces = 0
        scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
        render = scene.render
        render.use_border = render.use_crop_to_border = True
        render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = BORDER
        self.tiles = scenes.KINDS[kind]
        self.built = []

    def dress(self, materials: list[palette.Material], folder: Path) -> None:
        from material_palette.core import nodes

        for material in self.built:
            nodes.remove_material(material)
        self.built = []
        for (part, metres), material in zip(self.tiles.items(), materials, strict=True):
            record = palette.write_material(material, folder / material.name) | {"metres_per_tile": metres}
            self.built.append(nodes.build_material(record, folder, pack=True))
            self.scene.things[part].data.materials.clear()
            self.scene.things[part].data.materials.append(self.built[-1])
        self.bpy.context.view_layer.update()

    def look(self):
        from material_palette.core.scene import look

        seen = look(self.bpy.context.scene, self.built)
        return [seen[material.name] for material in self.built]

    def render(self, grid: int | None = None) -> list[np.ndarray]:
        """The pictures under each sun and under all, linear."""
        grid = grid or self.grid
        scene = self.bpy.context.scene
        scene.render.resolution_percentage, scene.cycles.samples, scene.cycles.filter_width = 100 * grid, 1, 0.01
        pictures = []
        for sun in self.suns:
            for other in self.suns:
                other.hide_render = other != sun
            with tempfile.TemporaryDirectory() as folder:
                scene.render.filepath = str(Path(folder) / "render.exr")
                self.bpy.ops.render.render(write_still=True)
                pictures.append(reduction.filtered(scenes._read(scene.render.filepath)[0], grid))
        return [*pictures, sum(pictures)]

    def cost(self, folder: Path) -> tuple[float, float]:
        """CPU seconds and peak memory in MB of a process that renders the scene as it is dressed."""
        scene, path = self.bpy.context.scene, folder / "scene.blend"
        scene.render.resolution_percentage, scene.cycles.samples = 100, COST_SAMPLES
        scene.cycles.filter_width = reduction.PIXEL
        for sun in self.suns:
            sun.hide_render = False
        self.bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, compress=False)
        said = subprocess.run([sys.executable, "-c", RENDER, str(path)], capture_output=True, text=True, check=True)
        path.unlink()
        return tuple(json.loads(next(line for line in said.stdout.splitlines() if line.startswith("["))))

    def file_bytes(self, folder: Path) -> int:
        """Size of a .blend that holds the materials, packed."""
        path = folder / "materials.blend"
        self.bpy.data.libraries.write(str(path), set(self.built), fake_user=True)
        size = path.stat().st_size
        path.unlink()
        return size


def measure(kind: str, number: int, name: str, materials, options, work: Path) -> list[dict]:
    """A row per version of the palette in one scene."""
    stage = Stage(kind, number, options.size, options.grid)
    full = [copy_of(material, material.svbrdf) for material in materials]
    stage.dress(full, work / "full")
    start = time.process_time()
    seen = stage.look()
    looking = time.process_time() - start
    versions, fitting = {"full": full}, {}
    print(kind, name, [round(one.texels) for one in seen], flush=True)
    for visible in options.visible:
        version = f"fitted, {visible:g}"
        start = time.process_time()
        versions[version] = [copy_of(material, material.svbrdf) for material in full]
        for material, one in zip(versions[version], seen, strict=True):
            palette.fit_material(material, one.texels, quiet, visible=visible)
        fitting[version] = (time.process_time() - start) / len(full)
    rows, reference, gains = [], None, []
    for version, made in versions.items():
        stage.dress(made, work / version.replace(" ", "_"))
        pictures = stage.render()
        gains = gains or [exposure(picture) for picture in pictures]
        pictures = [encoded(picture, gain) for picture, gain in zip(pictures, gains, strict=True)]
        reference = reference or pictures
        differences = [flip(a, b) for a, b in zip(reference, pictures, strict=True)]
        if version == SHIPPED:
            # FLIP 0.2 is white
            difference = np.repeat(5 * differences[-1][..., None], 3, -1).clip(0, 1)
            strip = np.concatenate([reference[-1], pictures[-1], difference], 1)
            cv2.imwrite(str(work / "pictures.png"), np.rint(strip[..., ::-1] * 255).astype(np.uint8))
        row = {
            "scene": kind,
            "palette": name,
            "version": version,
            "texture_bytes": sum(reduction.texture_bytes(reduction.maps_of(m.svbrdf), m.bits) for m in made),
            "blend_bytes": stage.file_bytes(work),
            "flip": float(np.mean(differences)),
            "flip_worst_light": float(max(difference.mean() for difference in differences)),
            "flip_98": float(np.percentile(differences, 98)),
            "sides": "; ".join(sides(m.svbrdf) for m in made),
            "pixels": " ".join(f"{one.texels:.0f}" for one in seen),
            "look_seconds": looking,
            "fit_seconds_per_material": fitting.get(version, 0.0),
        }
        if version in ("full", SHIPPED):
            row["render_seconds"], row["render_peak_mb"] = stage.cost(work)
        rows.append(row)
        print(row, flush=True)
    if kind == "room" and name == "bundled":
        # what is left of the grid in the pictures
        stage.dress(full, work / "full")
        finer = [encoded(p, gain) for p, gain in zip(stage.render(options.grid + 1), gains, strict=True)]
        floor = [float(flip(a, b).mean()) for a, b in zip(reference, finer, strict=True)]
        rows[0]["flip_to_finer_grid"] = float(np.mean(floor))
        print("to a finer grid", floor, flush=True)
    return rows


def sides(svbrdf: SVBRDF) -> str:
    """Texels of base colour, normal and roughness, a dash for values."""
    maps = reduction.maps_of(svbrdf)
    return " ".join(str(len(value)) if np.ndim(value) > 1 else "-" for value in maps.values())


def exposure(picture: np.ndarray) -> float:
    luminance = picture @ np.array([0.2126, 0.7152, 0.0722])
    lit = luminance[luminance > 0]
    return min(0.2 / np.exp(np.log(np.maximum(lit, 1e-4)).mean()), 0.95 / np.percentile(luminance, 98))


def encoded(picture: np.ndarray, gain: float) -> np.ndarray:
    return srgb_from_linear(np.clip(picture * gain, 0, 1).astype(np.float32))


def chart(rows: list[dict], path: Path) -> None:
    """FLIP against the share of the full palette's bytes, the chosen point marked."""
    pyplot = charts.plt()
    if pyplot is None:
        return
    figure, axes = pyplot.subplots(figsize=(5.4, 3.4))
    for i, key in enumerate(dict.fromkeys((row["palette"], row["scene"]) for row in rows)):
        own = [row for row in rows if (row["palette"], row["scene"]) == key]
        whole = own[0]["texture_bytes"]
        own = sorted(own[1:], key=lambda row: row["texture_bytes"])
        x, y = [whole / row["texture_bytes"] for row in own], [row["flip"] for row in own]
        colour = charts.COLOURS[i % len(charts.COLOURS)]
        axes.plot(x, y, "o-", color=colour, markersize=3, linewidth=1, label=f"{key[1]}, {key[0]}")
        chosen = [(a, b) for a, b, row in zip(x, y, own, strict=True) if row["version"] == SHIPPED]
        axes.plot(*zip(*chosen, strict=True), "o", color=colour, markersize=9, fillstyle="none")
    axes.axhline(0.02, color=charts.GREY, linewidth=0.8, linestyle=":")
    axes.axvline(4, color=charts.GREY, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_xticks([1, 2, 4, 8, 16], "1 2 4 8 16".split())
    axes.minorticks_off()
    axes.set_xlabel("texture memory, times less than full (rings: as `fit` does it)")
    axes.set_ylabel("mean FLIP to the full palette")
    axes.legend(frameon=False, fontsize=7)
    charts.save(figure, path)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with pbr/polyhaven/; without: the bundled photo only")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist" / "benchmarks" / "needs")
    parser.add_argument("--palette", type=Path, metavar="DIR", help="a palette in place of the bundled photo's")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no scene after so long; go on later")
    parser.add_argument("--quick", action="store_true", help="one small scene, one palette")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    options.size, options.grid = ((480, 270), 4) if options.quick else (SIZE, GRID)
    options.visible = (reduction.VISIBLE,) if options.quick else VISIBLE
    parts = records.Parts(options.output, options.quick, options.minutes)
    work = parts.folder / "work"
    kinds = list(scenes.KINDS)[:1] if options.quick else list(scenes.KINDS)
    rows = []
    for number, kind in enumerate(kinds):
        palettes = {"bundled": lambda: bundled(options.palette or work / "palette", 256 if options.quick else 1024)}
        if options.data and (options.data / "pbr" / "polyhaven").is_dir() and not options.quick:
            palettes["poly haven"] = lambda number=number: known(options.data, number)
        for name, read in palettes.items():
            folder = work / f"{kind} {name}"
            folder.mkdir(parents=True, exist_ok=True)
            given = kind, number, name
            make = lambda given=given, read=read, folder=folder: measure(*given, read(), options, folder)  # noqa: E731
            rows += parts.get(f"{kind}-{name}", make) or []
    if not rows:
        return 0
    full = {(row["scene"], row["palette"]): row for row in rows if row["version"] == "full"}
    pairs = [(row, full[row["scene"], row["palette"]]) for row in rows]
    summary = {}
    for version in dict.fromkeys(row["version"] for row in rows):
        own = [(row, full) for row, full in pairs if row["version"] == version]
        summary[version] = {
            "times_less_texture_memory": float(np.median([f["texture_bytes"] / r["texture_bytes"] for r, f in own])),
            "least_times": float(min(f["texture_bytes"] / r["texture_bytes"] for r, f in own)),
            "times_smaller_file": float(np.median([f["blend_bytes"] / r["blend_bytes"] for r, f in own])),
            "mean_flip": float(np.mean([r["flip"] for r, _ in own])),
            "largest_flip": float(max(r["flip"] for r, _ in own)),
            "largest_flip_of_a_light": float(max(r["flip_worst_light"] for r, _ in own)),
        }
        if "render_seconds" in own[0][0]:
            ratios = [r["render_seconds"] / f["render_seconds"] for r, f in own]
            summary[version]["render_seconds_ratio"] = float(np.median(ratios))
            less = [f["render_peak_mb"] - r["render_peak_mb"] for r, f in own]
            summary[version]["render_peak_mb_less"] = float(np.median(less))
        print(version, {k: round(v, 4) for k, v in summary[version].items()})
    records.write(options.output, "needs", rows, {"summary": summary, "grid": options.grid}, parts)
    strips = [cv2.imread(str(path)) for path in sorted(work.glob("*/pictures.png"))]
    across = 2 - len(strips) % 2
    sheet = np.concatenate([np.concatenate(strips[i : i + across], 1) for i in range(0, len(strips), across)])
    cv2.imwrite(str(options.output / "needs.jpg"), sheet, [cv2.IMWRITE_JPEG_QUALITY, 90])
    chart(rows, options.output / "needs")
    return 0


if __name__ == "__main__":
    sys.exit(main())
