"""The network against a definition in pure PyTorch. `make peers-torch` runs this.

Weights go both ways between barchan and PyTorch; disparity, standard deviation, confidence, losses and
gradients of all presets must agree. At the end the time of a training step in both, side by side; on a machine
with other work set OMP_WAIT_POLICY=passive, or PyTorch's threads wait for one another at full load. Exits 1
when a figure is out of bounds or a check fails to run.
"""

import argparse
import json
import os
import resource
import shutil
from pathlib import Path
from time import perf_counter, process_time

import cv2
import numpy as np
import onnxruntime
import torch

import torch_network
from common import Barchan, Table, crop_folder, image_size, read_pfm, read_rgb
from torch_training import Trainer

ROOT = Path(__file__).resolve().parents[2]
PRESETS = ["tiny", "rover", "paper"]
SIZES = [(320, 192), (253, 121), (129, 97), (97, 65), (49, 33)]
"""Whole, no multiples of anything, and narrower than the search."""
PLAIN = ["--noise", 0, "--brightness", 0, "--contrast", 0, "--channel", 0, "--add-disparity", 0, "--no-check"]
"""Options of `barchan train` that leave the images as they are."""


def steps_of(run: Path) -> list:
    """The steps of a run's log, without its looks at held-out pairs."""
    lines = (run / "log.jsonl").read_text().splitlines()
    return [line for line in map(json.loads, lines) if "loss" in line]


def pairs(folder: Path) -> dict:
    """Left and right images [1, 3, H, W] of a `folder` data set, by name."""
    return {
        left.stem: tuple(
            torch.from_numpy(np.ascontiguousarray(read_rgb(folder / side / left.name).transpose(2, 0, 1)))[None]
            for side in ("left", "right")
        )
        for left in sorted((folder / "left").iterdir())
    }


def weights_by_pytorch(config: dict, path: Path) -> Path:
    """Random ones as PyTorch draws them, so that every layer speaks as loudly as any."""
    torch.manual_seed(7)
    torch_network.save(torch_network.StereoNet(config), config, path)
    return path


def check_outputs(table: Table, barchan: Barchan, label: str, weights: Path, folders: list, work: Path) -> None:
    """Burn by `barchan infer`, and the exported file, which also tells sigma, by ONNX Runtime; the worst of all sizes."""
    net, _ = torch_network.load(weights)
    net.eval()
    model = work / f"{label.replace(' ', '-')}.onnx"
    barchan("export", weights, "--out", model)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    names = ["disparity", "sigma", "confidence"]
    difference = {what: [] for what in ("barchan infer: disparity, px", *names)}
    for folder in folders:
        out = work / f"{model.stem}-{folder.name}"
        barchan("infer", "--data", f"folder:{folder}", "--model", weights, "--no-reject", "--no-check",
                "--outlines", 0, "--out", out)
        for stem, (left, right) in pairs(folder).items():
            with torch.no_grad():
                truth = [x[0, 0].numpy() for x in net(left, right)]
            infer = read_pfm(out / "disparity" / f"{stem}.pfm")
            difference["barchan infer: disparity, px"].append(np.abs(infer - truth[0]))
            exported = session.run(names, {"left": left.numpy(), "right": right.numpy()})
            for name, ours, theirs in zip(names, exported, truth):
                difference[name].append(np.abs(ours[0, 0] - theirs))
    for what, found in difference.items():
        what = f"{label}, {what if ':' in what else 'exported: ' + what}"
        # A pixel left unknown makes both figures NaN, which is out of bounds.
        table.at_most(f"{what}, median", np.max([np.median(x) for x in found]), 1e-3)
        table.at_most(f"{what}, largest", np.max([np.max(x) for x in found]), 1e-2)


def check_training(
    table: Table, barchan: Barchan, label: str, weights: Path, data: Path, truth: bool, work: Path
) -> None:
    """The same pair, untouched, a few steps over: losses, and the direction that the first step takes."""
    steps, rate = 5, 1e-3
    ((name, pair),) = pairs(data).items()
    known = None
    if truth:
        stored = cv2.imread(str(data / "disparity" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        known = torch.from_numpy(np.where(stored == 0, np.nan, stored / 256).astype(np.float32))[None, None]
    width, height = image_size(data)
    common = ["--data", f"folder:{data}", "--init", weights, "--crop", height, width, "--lr", rate, *PLAIN]
    common += ["--supervised"] if truth else []

    net, config = torch_network.load(weights)
    before = {key: p.detach().clone() for key, p in net.named_parameters()}
    trainer = Trainer(net, rate)
    losses, gradient = [], {}
    for step in range(steps):
        losses.append(trainer.step(*pair, known))
        if step == 0:
            gradient = {key: p.grad.clone() for key, p in net.named_parameters()}

    def ours(steps: int) -> Path:
        out = work / f"{label.replace(' ', '-')}-{steps}"
        barchan("train", *common, "--epochs", steps, "--steps", steps, "--out", out)
        return out

    log = steps_of(ours(steps))
    first = max(abs(log[0][term] - value) / abs(value) for term, value in losses[0].items())
    table.at_most(f"{label}: losses of the first step, relative", first, 1e-4)
    later = max(abs(a["loss"] - b["loss"]) / abs(b["loss"]) for a, b in zip(log, losses, strict=True))
    table.at_most(f"{label}: loss over {steps} steps of Adam, relative", later, 1e-3)

    # The first step of Adam goes one rate against the sign of each gradient: signs that differ, each counted
    # as its gradient's share of its tensor's. A single bias, the same for all bins, has none.
    after, _ = torch_network.load(ours(1) / "weights.safetensors")
    after = dict(after.named_parameters())
    wrong = {
        key: float((g.abs() * ((before[key] - after[key]).sign() != g.sign())).sum() / g.abs().sum())
        for key, g in gradient.items()
        if g.numel() > 1 and g.any()
    }
    worst = max(wrong, key=wrong.get)
    table.at_most(f"{label}: gradients of the other sign, {worst}", wrong[worst], 1e-2)
    table.at_most(f"{label}: gradients of the other sign, mean", float(np.mean(list(wrong.values()))), 1e-3)


def time_steps(
    barchan: Barchan, weights: Path, data: Path, device: str, threads: int, rounds: int, work: Path
) -> None:
    """Seconds of a self-supervised training step, both programs taking turns, the first step of each turn left
    out. CPU seconds, of all threads together, still compare the two when the machine has other work."""
    steps = 6
    ((_, pair),) = pairs(data).items()
    width, height = image_size(data)
    net, _ = torch_network.load(weights)
    trainer = Trainer(net, 1e-3)

    def train(steps: int) -> tuple:
        """Seconds of each step, and CPU seconds of the whole program."""
        out = work / f"time-{height}x{width}"
        shutil.rmtree(out, ignore_errors=True)
        options = ["--init", weights, "--crop", height, width, "--epochs", steps, "--device", device, *PLAIN]
        before = children_cpu()
        barchan("train", "--data", f"folder:{data}", *options, "--out", out)
        return [step["seconds"] for step in steps_of(out)], children_cpu() - before

    ours, theirs, our_cpu, their_cpu = [], [], [], []
    for _ in range(rounds):
        _, start = train(1)
        seconds, all_steps = train(steps)
        ours += seconds[1:]
        our_cpu.append((all_steps - start) / (steps - 1))
        for step in range(steps):
            started, cpu = perf_counter(), process_time()
            trainer.step(*pair)
            if step > 0:
                theirs.append(perf_counter() - started)
                their_cpu.append(process_time() - cpu)
    print(f"  rover, a training step {height}x{width} (height x width), barchan {device} and PyTorch, {threads} threads:")
    for what, a, b in (
        ("seconds, median", np.median(ours), np.median(theirs)),
        ("seconds, least", min(ours), min(theirs)),
        ("CPU seconds, median", np.median(our_cpu), np.median(their_cpu)),
    ):
        print(f"    {what:<20} {a:8.3f} {b:8.3f}   {a / b:.2f} times", flush=True)


def children_cpu() -> float:
    """CPU seconds of the programs run so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--barchan", type=Path, required=True, help="the built program")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "peers-torch", help="folder for what is made")
    parser.add_argument("--device", default="flex", help="barchan's device whose training step is timed")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each program in the timing; 0 leaves it out")
    parser.add_argument("--threads", type=int, default=2, help="of both programs")
    parser.add_argument("--timing-only", action="store_true", help="no checks")
    options = parser.parse_args()
    barchan, work = Barchan(options.barchan), options.work
    torch.set_num_threads(options.threads)
    os.environ["RAYON_NUM_THREADS"] = str(options.threads)

    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    weights = {}

    def rendered(width: int, height: int, frames: int) -> Path:
        out = work / f"rendered-{width}x{height}"
        source = f"synth:seed=5,frames={frames},width={width},height={height}"
        barchan("data", "synth", source, "--out", out)
        return out

    def prepare(table: Table) -> None:
        for preset in PRESETS:
            run = work / f"{preset}-run"
            learn = ["--supervised", "--crop", 64, 128, "--epochs", 9, "--steps", 8]
            barchan("train", "--data", "synth:seed=5,frames=4,width=256,height=128", "--preset", preset, *learn, "--out", run)
            weights[preset] = run / "weights.safetensors"

    def outputs(table: Table) -> None:
        data = rendered(*SIZES[0], 1)
        folders = [crop_folder(data, work / f"{w}x{h}", 1, w, h) for w, h in SIZES]
        for preset in PRESETS:
            check_outputs(table, barchan, f"{preset} by barchan", weights[preset], folders, work)
            _, config = torch_network.load(weights[preset])
            drawn = weights_by_pytorch(config, work / f"{preset}-pytorch.safetensors")
            check_outputs(table, barchan, f"{preset} by PyTorch", drawn, folders, work)

    def training(table: Table) -> None:
        data = rendered(160, 96, 1)
        for preset in PRESETS:
            for truth in (False, True):
                label = f"{preset}, {'' if truth else 'self-'}supervised"
                check_training(table, barchan, label, weights[preset], data, truth, work)

    def timing(table: Table) -> None:
        for width, height in ((256, 128), (384, 320)):
            data = rendered(width, height, 1)
            time_steps(barchan, weights["rover"], data, options.device, options.threads, options.rounds, work)

    parts = [prepare, timing] if options.timing_only else [prepare, outputs, training, timing]
    Table().run(parts if options.rounds else parts[:-1])


if __name__ == "__main__":
    main()
