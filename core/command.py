"""The command line: `blender -b --command material_palette extract PHOTO... -o DIR`, and the same outside Blender."""

import argparse
import contextlib
import signal
import sys
import threading
import time
from dataclasses import fields, replace
from pathlib import Path

from .dependencies import install_command, missing
from .errors import PaletteError, explain

DONE, BAD_INPUT, SOME_FAILED = 0, 2, 3


def main(argv: list[str]) -> int:
    """Run one command; returns the exit code.

    0: all materials were made. 2: bad input, said on standard error, nothing written for that photo. 3: some regions
    failed, the others were written. 130: interrupted, nothing written for that photo; 143 and 129: by SIGTERM, SIGHUP.
    """
    parser = _parser()
    try:
        arguments = parser.parse_args(argv)
    except SystemExit as end:  # argparse has said why
        return int(end.code or 0)
    lacking = missing()
    if lacking:
        for entry in lacking:
            print(f"{entry.package} is missing: it {entry.reason}", file=sys.stderr)
        print(f"Install it with:\n  {install_command(lacking)}", file=sys.stderr)
        return BAD_INPUT
    codes = [0]
    try:
        with _signals_interrupt():
            if arguments.command == "resample":
                return _resample(arguments)
            if arguments.command == "fit":
                return _fit(arguments)
            for photo, masks, folder in _jobs(arguments):
                try:
                    codes.append(_extract(photo, masks, folder, arguments))
                except Exception as error:  # the other photos go on
                    _complain(error)
                    codes.append(BAD_INPUT)
    except PaletteError as error:
        _complain(error)
        return BAD_INPUT
    except KeyboardInterrupt as end:
        with contextlib.suppress(OSError):  # the terminal may be gone
            print("interrupted; nothing was written for this photo", file=sys.stderr, flush=True)
        return 128 + (end.args[0] if end.args else signal.SIGINT)
    return BAD_INPUT if BAD_INPUT in codes else max(codes)


@contextlib.contextmanager
def _signals_interrupt():
    """What asks a program to end, SIGTERM and SIGHUP, raises KeyboardInterrupt of its number, as Ctrl-C does of none,
    so that nothing half-made is left. Not on another thread, and not where somebody else sees to it."""
    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [
        number for number in map(signal.Signals.__getitem__, names) if signal.getsignal(number) == signal.SIG_DFL
    ]
    if threading.current_thread() is not threading.main_thread():
        numbers = []

    def interrupt(number, frame):
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)  # cleaning up is not to be interrupted
        raise KeyboardInterrupt(number)

    try:
        for number in numbers:
            signal.signal(number, interrupt)
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("material_palette", description="Tileable PBR materials from a photo's regions.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="extract | resample | fit")
    extract = commands.add_parser("extract", help="make a palette of each photo")
    extract.add_argument("photos", nargs="+", type=Path, metavar="PHOTO", help="image file; several make a folder each")
    where = extract.add_mutually_exclusive_group(required=True)
    where.add_argument(
        "--masks",
        type=Path,
        metavar="DIR|FILE",
        help="one mask image per material, named as the material; for several photos DIR/<photo's name>/. "
        "Or one image of colours or indices, or COCO's JSON",
    )
    where.add_argument(
        "--segment", metavar="ENGINE", help="find the regions: auto; sam or materialistic with --weights"
    )
    extract.add_argument(
        "--weights", type=Path, metavar="PATH", help="weights of sam (a folder) or materialistic (a file)"
    )
    extract.add_argument("--regions", type=int, metavar="N", help="at most N found regions (8)")
    extract.add_argument("--engine", default="patch", help="texture engine: patch or diffusion (%(default)s)")
    extract.add_argument("--keep-concepts", action="store_true", help="keep what was learnt, for `resample`")
    extract.add_argument("--metres-per-tile", type=float, default=1.0, metavar="M", help="size of a repeat (1)")
    extract.add_argument(
        "--rectify", default="auto", help="slanted regions: auto, quad (only by corners) or off (auto)"
    )
    extract.add_argument(
        "--corners",
        action="append",
        default=[],
        metavar="NAME:X,Y*4",
        help="a rectangle on a region's surface in photo px, clockwise from top left: 'floor:10,20 90,20 99,80 2,85'",
    )
    extract.add_argument(
        "--measure",
        action="append",
        default=[],
        metavar="NAME:X,Y*2=M",
        help="metres between two photo px on a region's surface: 'floor:10,20 90,20=0.6'",
    )
    extract.add_argument(
        "--merge-alike",
        nargs="?",
        type=float,
        const=True,  # merging.MOST
        metavar="D",
        help="one material of regions that are at most D apart in texture and colour (0.2)",
    )
    extract.add_argument(
        "--target-error", type=float, metavar="E", help="the cheapest quality predicted to meet it, by region (0.1)"
    )
    extract.add_argument("--no-flatten", action="store_true", help="keep the illumination and all sides of a solid")
    extract.add_argument("--white-balance", default="off", help="off, or region: the region is grey on average (off)")
    extract.add_argument(
        "--grey-card",
        metavar="[PHOTO:]X,Y X,Y",
        help="a rectangle in px on an 18 %% grey card, in each photo or in one of the same light and exposure: tells "
        "how bright base colours are",
    )
    # what is not given is not in the result: DiffusionSettings has the defaults
    diffusion = extract.add_argument_group("engine diffusion (docs/diffusion.md)", argument_default=argparse.SUPPRESS)
    diffusion.add_argument("--model", help="folder in diffusers' format, .safetensors checkpoint or hub id")
    diffusion.add_argument("--online", action="store_true", help="fetch the model from the hub if it is not here")
    diffusion.add_argument("--concepts", metavar="DIR", help="keep learnt concepts here, to use them again")
    diffusion.add_argument("--device", help="cuda, mps or cpu (the best there is)")
    diffusion.add_argument("--precision", help="fp32, fp16 or bf16 (by device)")
    diffusion.add_argument("--tuning-steps", type=int, metavar="N", help="at most (800)")
    diffusion.add_argument("--prompt", help="with S* for the region (one of the paper's)")
    diffusion.add_argument("--steps", type=int, metavar="N", help="denoising steps (by quality: 25, 50, 50)")
    diffusion.add_argument("--guidance", type=float, metavar="W", help="1 for none (7.5)")
    diffusion.add_argument("--scheduler", metavar="NAME", help="a scheduler of diffusers (the model's own)")
    diffusion.add_argument("--prediction", help="epsilon or v_prediction (the model's own)")
    diffusion.add_argument("--roll", help="noise, feature (few steps) or none (noise)")
    diffusion.add_argument("--roll-from", type=float, metavar="F", help="fraction of the steps (0)")
    diffusion.add_argument("--candidates", type=int, metavar="K", help="samples; the best is kept (1; at best: 4)")
    resample = commands.add_parser("resample", help="other textures of materials extracted with --keep-concepts")
    resample.add_argument(
        "concepts", nargs="+", type=Path, metavar="CONCEPT", help="NAME/NAME_concept.json in a palette's folder"
    )
    fit = commands.add_parser("fit", help="leave in a palette what a scene's cameras show of it")
    fit.add_argument("palette", type=Path, metavar="DIR", help="a palette's folder; it stays as it is")
    fit.add_argument("--scene", type=Path, required=True, metavar="FILE", help=".blend that uses its materials")
    extract.add_argument("--fit-scene", type=Path, metavar="FILE", help=".blend that will use them: `fit` at once")
    for each in (extract, resample, fit):
        each.add_argument("--pack", action="store_true", help="pack the textures into palette.blend")
        each.add_argument("--overwrite", action="store_true", help="replace an earlier palette in DIR")
        each.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder to write")
    for each in (extract, resample):
        each.add_argument(
            "--decomposer", default="unet", help="unet (a network), analytic, or resnet101=FILE (%(default)s)"
        )
        each.add_argument("--quality", default="balanced", help="draft, balanced or best (%(default)s)")
        each.add_argument("--resolution", type=int, default=1024, metavar="PX", help="side of the maps (%(default)s)")
        each.add_argument("--seed", type=int, default=0, metavar="N", help="another seed, another variation")
        each.add_argument("--scale", type=float, default=1.0, metavar="S", help="enlarge the texture S times (1)")
        each.add_argument("--full-maps", action="store_true", help="reduce nothing: no value, no smaller map")
    return parser


def _fit(arguments: argparse.Namespace) -> int:
    from . import nodes
    from .output import staged
    from .palette import Palette, read_palette, write_palette
    from .region import file_name

    folder, output = arguments.palette, arguments.output
    if output.resolve() == folder.resolve():
        raise PaletteError(f"'{folder}' holds the full maps, which would be replaced; name another folder with -o")
    content, materials, settings = read_palette(folder)
    seen = _look(arguments.scene, [material.name for material in materials])
    line = _Line(arguments.scene.name)
    with staged(output, arguments.overwrite) as staging:
        palette = Palette(None, content["photo"], [], settings, materials)
        for material in materials:
            if material.svbrdf is not None:
                concept = folder / file_name(material.name) / f"{file_name(material.name)}_concept.json"
                _fit_one(material, seen.get(material.name), line, concept, settings)
        written = write_palette(palette, staging)
        previews = {material.name: material.preview for material in materials if material.svbrdf is not None}
        nodes.write_blend(staging / "palette.blend", written, staging, previews, pack=arguments.pack)
    line.say(f"{_count(len(previews), 'material')} written to {output}")
    return DONE


def _look(path: Path, names: list[str]) -> dict:
    """What the cameras of the scene in a .blend, which is opened, see of the materials of these names."""
    import bpy

    from .scene import look

    if not path.is_file():
        raise PaletteError(f"there is no scene '{path}'")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.resolve()), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        raise PaletteError(f"'{path}' can't be opened: {error}") from None
    materials = [bpy.data.materials[name] for name in names if name in bpy.data.materials]
    if not materials:
        raise PaletteError(f"'{path}' has none of the materials {', '.join(names)}; append or link palette.blend there")
    return look(bpy.context.scene, materials, _Line(path.name).progress)


def _fit_one(material, seen, line, concept: Path | None, settings) -> None:
    from .palette import fit_material, resample_material
    from .reduction import largest

    if seen is None or seen.why:
        line.say(f"{material.name}: kept as it is: {seen.why if seen else 'the scene does not have it'}")
        return
    have, pixels = largest(material.svbrdf), seen.texels
    if pixels > have and have < settings.resolution and concept is not None and concept.is_file():
        quality = material.target["quality"] if material.target else settings.quality
        again = resample_material(concept, replace(settings, quality=quality, full_maps=True), line.progress)
        # a tile of which a part was kept is whole again
        pixels *= again.metres_per_tile / material.metres_per_tile
        material.svbrdf, material.reduced, material.bits = again.svbrdf, again.reduced, again.bits
        material.metres_per_tile, have = again.metres_per_tile, largest(again.svbrdf)
        line.say(f"{material.name}: sampled again from its concept")
    fit_material(material, pixels, line.progress, seen.displaced)
    line.say(
        f"{material.name}: a tile is at most {pixels:.0f} px long and covers {seen.share:.1%} of a picture"
        + (f"; its {have} px are fewer" if pixels > have else "")
    )
    line.ledger(material.name, material.reduced)


def _resample(arguments: argparse.Namespace) -> int:
    from . import nodes
    from .output import staged
    from .palette import Palette, Settings, resample_material, write_palette
    from .region import file_name

    settings = Settings(**_sampling(arguments))
    settings.check()
    for path in arguments.concepts:
        if path.resolve().is_relative_to(arguments.output.resolve()):
            raise PaletteError(f"'{path}' lies in the output folder, which would be replaced; name another folder")
    with staged(arguments.output, arguments.overwrite) as staging:
        palette = Palette(None, "saved concepts", [], settings, [])
        for path in arguments.concepts:
            line = _Line(path.name)
            material = resample_material(path, settings, line.progress)
            if file_name(material.name).casefold() in (file_name(other.name).casefold() for other in palette.materials):
                raise PaletteError(f"two concepts are named '{material.name}'; resample them into separate folders")
            palette.materials.append(material)
            line.say(f"{material.name}: {sum(material.seconds.values()):.1f} s")
            line.ledger(material.name, material.reduced)
            for warning in material.warnings:
                line.say(f"{material.name}: warning: {warning}")
        content = write_palette(palette, staging)
        previews = {material.name: material.preview for material in palette.materials}
        nodes.write_blend(staging / "palette.blend", content, staging, previews, pack=arguments.pack)
    print(f"{_count(len(palette.materials), 'material')} written to {arguments.output}", flush=True)
    return DONE


def _sampling(arguments: argparse.Namespace) -> dict:
    """The settings that both commands take."""
    taken = ("decomposer", "quality", "resolution", "seed", "scale", "full_maps")
    return {name: getattr(arguments, name) for name in taken}


def _jobs(arguments: argparse.Namespace) -> list[tuple[Path, Path | None, Path]]:
    """(photo, folder of its masks, output folder) per photo."""
    photos = arguments.photos
    if len(photos) == 1:
        return [(photos[0], arguments.masks, arguments.output)]
    stems = [photo.stem for photo in photos]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice:
        raise PaletteError(f"two photos are named '{twice}' and would share an output folder; extract them separately")
    masks = arguments.masks
    one_file = masks is None or masks.is_file()  # COCO's JSON speaks of several photos
    return [(p, masks if one_file else masks / p.stem, arguments.output / p.stem) for p in photos]


def _extract(photo_path: Path, masks: Path | None, folder: Path, arguments: argparse.Namespace) -> int:
    from . import nodes
    from .annotations import read_annotations
    from .exemplar import card_colour
    from .image import read_photo
    from .output import staged
    from .palette import Material, Settings, extract_palette, write_concept, write_material, write_palette
    from .region import add_geometry, file_name, parse_card, parse_corners, parse_measure, read_regions

    settings = Settings(
        **_sampling(arguments),
        engine=arguments.engine,
        rectify=arguments.rectify,
        flatten=not arguments.no_flatten,
        white_balance=arguments.white_balance,
        metres_per_tile=arguments.metres_per_tile,
        diffusion=_diffusion(arguments),
        keep_concepts=arguments.keep_concepts,
        target_error=arguments.target_error,
    )
    settings.check()
    _check_segmentation(arguments)
    card = parse_card(arguments.grey_card) if arguments.grey_card else None
    if card and settings.white_balance != "off":
        raise PaletteError("--grey-card and --white-balance both tell the light's colour; leave one out")
    if arguments.merge_alike is not None and not arguments.merge_alike >= 0:
        raise PaletteError(f"--merge-alike {arguments.merge_alike:g} is no distance; choose 0 or more, such as 0.2")
    corners = dict(parse_corners(text) for text in arguments.corners)
    measures = dict(parse_measure(text) for text in arguments.measure)
    line = _Line(photo_path.name)
    with staged(folder, arguments.overwrite) as staging:
        start = time.perf_counter()
        photo = read_photo(photo_path)
        for warning in photo.warnings:
            line.say(f"warning: {warning}")
        if card:
            shown = read_photo(card[0]) if card[0] else photo
            colour = card_colour(shown.pixels, *(card[1] * shown.scale))
            settings = replace(settings, white_balance="card", grey_card=colour)
        seconds = {"photo": time.perf_counter() - start}
        start = time.perf_counter()
        if masks is not None:
            shape = photo.pixels.shape[:2]
            if masks.is_file():
                regions = read_annotations(masks, shape, photo_path.name)
            else:
                regions = read_regions(masks, shape, photo.scale)
        else:
            from .segmentation import REGIONS, segment

            def warn(text: str) -> None:
                photo.warnings.append(text)
                line.say(f"warning: {text}")

            chosen = arguments.segment, REGIONS if arguments.regions is None else arguments.regions, settings.seed
            regions = segment(photo.pixels, *chosen, line.progress, warn, arguments.weights)
        add_geometry(regions, corners, measures, photo.scale)
        if arguments.merge_alike is not None:
            regions = _merged(photo, regions, arguments.merge_alike, line)
        seen = _look(arguments.fit_scene, [region.name for region in regions]) if arguments.fit_scene else {}
        seconds["regions"] = time.perf_counter() - start

        written = {}

        def on_material(material: Material) -> None:
            if material.error:
                line.say(f"{material.name}: FAILED: {material.error}")
            else:
                if not arguments.fit_scene:
                    written[material.name] = write_material(material, staging / file_name(material.name))
                line.say(f"{material.name}: {sum(material.seconds.values()):.1f} s")
                if material.target is not None:
                    unknown = "nothing: region or texture is too small to be judged"
                    said = ", ".join(f"{k} {unknown if v is None else v}" for k, v in material.target.items())
                    line.say(f"{material.name}: error {said}")
                line.ledger(material.name, material.reduced)
                for warning in material.warnings:
                    line.say(f"{material.name}: warning: {warning}")

        palette = extract_palette(
            photo.pixels, regions, settings, line.progress, on_material, photo_path.name, photo.focal
        )
        palette.warnings[:0] = photo.warnings
        palette.scale = photo.scale
        palette.seconds = seconds | palette.seconds
        failed = [material for material in palette.materials if material.error]
        for material in palette.materials:
            if arguments.fit_scene and not material.error:
                concept = write_concept(material, staging / file_name(material.name)) if material.concept else None
                _fit_one(material, seen.get(material.name), line, concept, settings)
        if len(failed) == len(regions):
            raise PaletteError("no material could be made: " + "; ".join(material.error for material in failed))
        content = write_palette(palette, staging, line.progress, written, referred=False)
        previews = {material.name: material.preview for material in palette.materials if not material.error}
        nodes.write_blend(staging / "palette.blend", content, staging, previews, pack=arguments.pack)
    line.say(f"{len(regions) - len(failed)} of {_count(len(regions), 'material')} written to {folder}")
    return SOME_FAILED if failed else DONE


def _merged(photo, regions: list, most: float | bool, line) -> list:
    """The regions of which those that are one material are merged; what was done goes into the photo's warnings."""
    from . import merging

    most = merging.MOST if most is True else most
    groups, distances = merging.find_alike(photo.pixels, regions, most)
    for (i, j), apart in sorted(distances.items(), key=lambda item: item[1]):
        names = f"{regions[i].name} and {regions[j].name}"
        if any(i in group and j in group for group in groups):
            photo.warnings.append(f"{names} are one material: {apart:.2f} apart, at most {most:g}")
            line.say(photo.warnings[-1])
        else:
            line.say(f"{names} are {apart:.2f} apart")
    line.say(f"{_count(len(groups), 'material')} of {_count(len(regions), 'region')}")
    return merging.merge(regions, groups)


def _diffusion(arguments: argparse.Namespace):
    """What was given of the engine's settings; PaletteError where another engine would leave it unread."""
    from .engines.diffusion import DiffusionSettings

    given = {
        field.name: getattr(arguments, field.name) for field in fields(DiffusionSettings) if field.name in arguments
    }
    if arguments.engine == "diffusion":
        return DiffusionSettings(**given)
    if given:
        names = ", ".join("--" + name.replace("_", "-") for name in given)
        raise PaletteError(f"engine '{arguments.engine}' has no {names}; add --engine diffusion or leave it out")
    return None


def _check_segmentation(arguments: argparse.Namespace) -> None:
    """PaletteError for what only another way to regions would read."""
    if arguments.masks is not None and arguments.regions is not None:
        raise PaletteError("--regions tells how many regions are found; --masks names them. Leave one out")
    if arguments.weights is not None and arguments.segment in (None, "auto"):
        way = "--masks" if arguments.segment is None else "--segment auto"
        raise PaletteError(f"{way} needs no --weights; add --segment sam or --segment materialistic, or leave it out")


class _Line:
    """Progress of one photo: a line that is rewritten on a terminal, nothing but results in a log. For any thread."""

    def __init__(self, name: str):
        self._name, self._shown, self._start, self._lock = name, 0.0, time.monotonic(), threading.Lock()
        self._terminal = sys.stderr.isatty()

    def progress(self, fraction: float, message: str) -> None:
        now = time.monotonic()
        if not self._terminal or now - self._shown < 0.2:
            return
        self._shown = now
        elapsed = now - self._start
        left = f"{elapsed * (1 - fraction) / fraction:.0f} s left" if fraction > 0.03 else ""
        with self._lock:
            print(f"\r{self._name} {fraction:4.0%} {left:11} {message[:60]:60}", end="", file=sys.stderr, flush=True)

    def say(self, text: str) -> None:
        with self._lock:
            if self._terminal:
                print("\r" + " " * 110 + "\r", end="", file=sys.stderr, flush=True)
            print(f"{self._name}: {text}", flush=True)

    def ledger(self, name: str, reduced: list[dict]) -> None:
        """What the material does without, what it would have cost and what error it makes."""
        for e in reduced:
            cost = f"saves {e['bytes'] / 1e6:.2f} MB, " if e["bytes"] else ""
            self.say(f"{name}: reduced: {e['map']} {e['change']} ({cost}FLIP {e['flip']:.3f})")


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _complain(error: Exception) -> None:
    print(f"error: {explain(error)}", file=sys.stderr)
