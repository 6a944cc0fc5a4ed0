"""How good weights are on pairs they never saw, beside OpenCV's SGBM. `make accuracy` runs this.

Photographs come from ../shared/data where that is there; everything else is rendered, four kinds of scenes
and ground, each from a seed of its own. Every pixel of known disparity counts, and where the network's sigma is
judged, every one too. Exits 1 where a target is missed.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from common import Barchan, Table, read_pfm

ROOT = Path(__file__).resolve().parents[2]

PHOTOGRAPHS = {
    # Folder, left, right, truth; range; targets of bad2 at full density, %.
    "cones": ("middlebury2003/cones", "im2.png", "im6.png", "disp2.pfm", 96, 8),
    "Motorcycle": ("middlebury2014/trainingQ/Motorcycle", "im0.png", "im1.png", "disp0GT.pfm", 96, 9),
    "SceneFlow": (
        "sceneflow-sample",
        "RGB_cleanpass/left/A-0032-0006.png",
        "RGB_cleanpass/right/A-0032-0006.png",
        "disparity/left/A-0032-0006.pfm",
        192,
        25,
    ),
}
RENDERED = {
    "scenes": lambda k: f"scenes,seed={9000 + k}",
    "low sun": lambda k: f"seed={9100 + k},sun={14 * k}:{6 + k % 8}",
    "blooming": lambda k: f"seed={9200 + k},look=arena,texture=low,bloom=0.4",
    "homogeneous sand": lambda k: f"seed={9300 + k},look=devon,texture=low,sun=40:12,noise=2",
}
SEEDS = 25
SIZE = "width=384,height=288"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--barchan", type=Path, required=True, help="the built program")
    parser.add_argument("--model", default="rover", help="weights, as barchan takes them")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "accuracy", help="folder; renders in it are kept")
    options = parser.parse_args()
    barchan, shared = Barchan(options.barchan), ROOT.parent / "shared" / "data"
    options.work.mkdir(parents=True, exist_ok=True)

    def network(reach: int, images: list) -> tuple:
        """Disparity, sigma, confidence, as the program answers."""
        out = options.work / "answer"
        left, right = images
        barchan("infer", "--left", left, "--right", right, "--model", f"{options.model}:{reach}", "--no-reject", "--out", out)
        return tuple(read_pfm(out / what / f"{left.stem}.pfm") for what in ("disparity", "sigma", "confidence"))

    def photographs(table: Table) -> None:
        for name, (folder, left, right, truth, reach, target) in PHOTOGRAPHS.items():
            if not (shared / folder).is_dir():
                continue
            images = [shared / folder / image for image in (left, right)]
            true = np.abs(read_pfm(shared / folder / truth))
            disparity, _, confidence = network(reach, images)
            own, filled = sgbm(images, reach)
            error = np.abs(disparity - true)
            table.at_most(f"{name}: bad2 at full density, % (SGBM filled {share(filled, true):.1f})", share(disparity, true), target)
            # As many of the surest pixels as SGBM has at all.
            known = np.isfinite(true)
            count = int((np.isfinite(own) & known).sum())
            surest = np.argsort(-confidence[known], kind="stable")[:count]
            table.at_most(
                f"{name}: bad2 at SGBM's density of {count / known.sum():.2f}, %",
                100 * float((error[known][surest] > 2).mean()),
                share(np.where(np.isfinite(own), own, np.nan), np.where(np.isfinite(own), true, np.nan)),
            )
            outlines(name, disparity, true)

    def rendered(table: Table) -> None:
        everything = []
        for kind, spec in RENDERED.items():
            ours, theirs = [], []
            for seed in range(SEEDS):
                data = options.work / f"{kind}-{seed}".replace(" ", "-")
                if not (data / "rig.toml").is_file():
                    barchan("data", "synth", f"synth:{spec(seed)},frames=1,{SIZE}", "--out", data)
                (left,) = (data / "left").iterdir()
                images = [data / side / left.name for side in ("left", "right")]
                true = cv2.imread(str(data / "disparity" / left.name), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
                # What lies beyond the range nobody was asked to find.
                known = (true > 0) & (true < 94)
                disparity, sigma, confidence = network(96, images)
                ours.append((disparity - true)[known])
                theirs.append((sgbm(images, 96)[1] - true)[known])
                everything.append((np.abs(disparity - true)[known], sigma[known], confidence[known]))
            a, b = (np.abs(np.concatenate(x)) for x in (ours, theirs))
            table.at_most(f"{kind}, {SEEDS} seeds: EPE, px (half of SGBM filled)", float(a.mean()), float(b.mean()) / 2)
            table.at_most(f"{kind}, {SEEDS} seeds: bad3, % (half of SGBM filled)", 100 * float((a > 3).mean()), 50 * float((b > 3).mean()))
        error, sigma, confidence = (np.concatenate(x) for x in zip(*everything))
        for deviations, low, high in ((1, 60, 76), (1.96, 92, 98)):
            held = 100 * float((error <= deviations * sigma).mean())
            table.line(f"errors within {deviations} sigma, %", f"{held:.1f}", f"{low}..{high}", low <= held <= high)
        table.at_most("area under the sparsification curve over the oracle's", sparsification(error, -confidence), 1.5)
        table.at_most("the same by sigma", sparsification(error, sigma), 1.5)

    Table().run([photographs, rendered])


def sgbm(images: list, reach: int) -> tuple:
    """OpenCV's disparity, NaN where it has none; and filled: the left border padded by the range, holes taken
    from the lower of the two neighbours in the row."""
    matcher = cv2.StereoSGBM_create(0, reach, 5, 200, 800, 1, 0, 10, 100, 2)
    left, right = (cv2.imread(str(image), cv2.IMREAD_GRAYSCALE) for image in images)

    def match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        disparity = matcher.compute(left, right).astype(np.float32) / 16
        return np.where(disparity < 0, np.nan, disparity)

    padded = (cv2.copyMakeBorder(x, 0, 0, reach, 0, cv2.BORDER_REPLICATE) for x in (left, right))
    filled = match(*padded)[:, reach:]
    before, after = filled.copy(), filled.copy()
    width = filled.shape[1]
    for x in range(1, width):
        hole = np.isnan(before[:, x])
        before[hole, x] = before[hole, x - 1]
        hole = np.isnan(after[:, width - 1 - x])
        after[hole, width - 1 - x] = after[hole, width - x]
    filled = np.where(np.isnan(filled), np.fmin(before, after), filled)
    return match(left, right), np.nan_to_num(filled)


def share(disparity: np.ndarray, true: np.ndarray) -> float:
    """Percent of the pixels of known truth that are off by more than two pixels, or not there."""
    known = np.isfinite(true)
    return 100 * float(1 - (np.abs(disparity - true)[known] <= 2).mean())


def outlines(name: str, disparity: np.ndarray, true: np.ndarray) -> None:
    """Prints where the errors are."""
    known = np.isfinite(true)
    outside = known & (true > np.arange(true.shape[1]))
    window = np.ones((9, 9), np.uint8)
    far = cv2.erode(np.where(known, true, 1e4).astype(np.float32), window)
    near = cv2.dilate(np.where(known, true, 0).astype(np.float32), window)
    edge = known & ~outside & (near - far > 3)
    parts = {"outside the right image": outside, "within 4 px of an outline": edge, "elsewhere": known & ~outside & ~edge}
    told = (f"{share(disparity, np.where(part, true, np.nan)):.1f} % {what} ({100 * part.sum() / known.sum():.0f} % of all)"
            for what, part in parts.items() if part.any())
    print(f"  {name}: bad2 {', '.join(told)}")


def sparsification(error: np.ndarray, doubt: np.ndarray) -> float:
    """Mean error of what is left when the most doubtful pixels go first, averaged over all densities, over the same
    when the most wrong go first."""

    def area(order: np.ndarray) -> float:
        left = np.cumsum(error[order], dtype=np.float64) / np.arange(1, len(order) + 1)
        return float(left.mean())

    return area(np.argsort(doubt, kind="stable")) / area(np.argsort(error, kind="stable"))


if __name__ == "__main__":
    main()
