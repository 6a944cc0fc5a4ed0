"""Semi-global matching against OpenCV's, on pairs with true disparity."""

import shutil
import time
from pathlib import Path

import cv2
import numpy as np

from common import Barchan, Table, read_pfm

RANGE = 64
"""Disparities searched by both."""
RUNS = 10
"""Repetitions of each timing."""

SCENES = {
    "cones": ("middlebury2003/cones", "im2.png", "im6.png", "disp2.pfm"),
    "Motorcycle": ("middlebury2014/trainingQ/Motorcycle", "im0.png", "im1.png", "disp0GT.pfm"),
}


def check(table: Table, barchan: Barchan, shared: Path, work: Path) -> None:
    for name, (folder, left, right, truth) in SCENES.items():
        scene = shared / folder
        if not scene.is_dir():
            continue
        # The same pair many times over, as a folder of scenes, so that one run gives a median.
        copies = work / "matching" / name
        for k in range(RUNS):
            shutil.copytree(scene, copies / f"{k:02}")
        out = work / "matching" / f"{name}-out"
        summary = barchan.json("infer", "--data", f"middlebury:{copies}", "--model", f"sgm:{RANGE}", "--no-reject", "--out", out)
        ours = read_pfm(out / "disparity" / "00.pfm")
        milliseconds = summary["ms_median"]

        images = [cv2.imread(str(scene / image), cv2.IMREAD_GRAYSCALE) for image in (left, right)]
        theirs, opencv_milliseconds = opencv_hh(*images)
        known = read_pfm(scene / truth)
        own, opencv_own = bad2(ours, known), bad2(theirs, known)
        table.at_most(f"{name}: sgm, bad2 over its own pixels against OpenCV MODE_HH's, %", own, opencv_own)
        table.at_most(f"{name}: sgm, bad2 over all pixels, %", bad2_over_all(ours, known), 18)
        ratio = milliseconds / opencv_milliseconds
        print(f"  {name}: {milliseconds:.1f} ms, {ratio:.2f} times MODE_HH's {opencv_milliseconds:.1f} ms")


def opencv_hh(left: np.ndarray, right: np.ndarray) -> tuple:
    """Disparity, NaN where OpenCV has none, and the median time, milliseconds."""
    cv2.setNumThreads(2)
    block = 5
    matcher = cv2.StereoSGBM_create(
        0, RANGE, block, 8 * block**2, 32 * block**2, 1, 63, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH
    )
    times = []
    for _ in range(RUNS):
        started = time.perf_counter()
        disparity = matcher.compute(left, right)
        times.append(1e3 * (time.perf_counter() - started))
    disparity = disparity.astype(np.float32) / 16
    disparity[disparity < 0] = np.nan
    return disparity, float(np.median(times))


def bad2(disparity: np.ndarray, truth: np.ndarray) -> float:
    """Share of pixels off by more than 2 px among those known in both, percent."""
    both = np.isfinite(disparity) & np.isfinite(truth)
    return float(100 * np.mean(np.abs(disparity - truth)[both] > 2))


def bad2_over_all(disparity: np.ndarray, truth: np.ndarray) -> float:
    """The same over all known truth, a missing disparity counting as off."""
    known = np.isfinite(truth)
    error = np.abs(np.where(np.isfinite(disparity), disparity, np.inf) - truth)
    return float(100 * np.mean(error[known] > 2))
