"""AKAZE against OpenCV's: key points, what they are worth for stereo, and time."""

import os
import shutil
import time
from pathlib import Path

import cv2
import numpy as np

from common import Barchan, Table, read_pfm

THRESHOLDS = (1e-3, 1e-4, 1e-5)
RUNS = 7
"""Repetitions of each timing."""
NEAR = 1.5
"""Key points at most so many pixels apart are of one thing."""
RATIO = 0.75
"""Of the nearest to the second nearest descriptor, below which a match is accepted."""

PAIRS = {
    "arena": ("arena-run1", "left/*", "right/*", None),
    "devon1": ("devon1", "left/*", "right/*", None),
    "Motorcycle": ("middlebury2014/trainingQ/Motorcycle", "im0.png", "im1.png", "disp0GT.pfm"),
}


def check(table: Table, barchan: Barchan, shared: Path, work: Path) -> None:
    for name, (folder, left, right, truth) in PAIRS.items():
        if not (shared / folder).is_dir():
            continue
        paths = [sorted((shared / folder).glob(side))[0] for side in (left, right)]
        disparity = read_pfm(shared / folder / truth) if truth else None
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
        for threshold in THRESHOLDS:
            title = f"{name} {images[0].shape[1]}x{images[0].shape[0]} akaze {threshold:g}"
            out = work / "features" / f"{name}-{threshold:g}"
            for side, path in zip(("left", "right"), paths):
                out.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, out / f"{side}{path.suffix}")
            copies = [out / f"{side}{path.suffix}" for side, path in zip(("left", "right"), paths)]
            barchan("features", *copies, "--threshold", threshold, "--out", out / "ours")
            ours = [read_csv(out / "ours" / f"{side}.csv") for side in ("left", "right")]
            theirs = [opencv_akaze(image, threshold) for image in images]

            found = share_near(theirs[0][0], ours[0][0])
            table.at_least(f"{title}: OpenCV's key points with one of ours near, %", found, 90)
            ours_in, theirs_in = (inliers(pair, disparity) for pair in (ours, theirs))
            table.at_least(f"{title}: stereo inliers against OpenCV's {theirs_in}", ours_in / theirs_in, 0.9)
            print(f"  {title}: {len(ours[0][0])} key points, OpenCV {len(theirs[0][0])}; {ours_in} inliers, OpenCV {theirs_in}")
            for threads in (1, 2):
                own = own_milliseconds(barchan, copies[0], threshold, threads, out)
                opencv = opencv_milliseconds(images[0], threshold, threads)
                print(f"  {title}: {threads} threads {own:.1f} ms, {own / opencv:.2f} times OpenCV's {opencv:.1f} ms")


def opencv_akaze(image: np.ndarray, threshold: float) -> tuple:
    """Places and descriptors."""
    keypoints, descriptors = cv2.AKAZE_create(threshold=threshold).detectAndCompute(image, None)
    return np.array([k.pt for k in keypoints]), descriptors


def read_csv(path: Path) -> tuple:
    """Places and descriptors of `barchan features`."""
    lines = [line.split(",") for line in path.read_text().splitlines()[1:]]
    places = np.array([[float(u), float(v)] for u, v, *_ in lines])
    descriptors = np.array([list(bytes.fromhex(line[-1])) for line in lines], dtype=np.uint8)
    return places, descriptors


def share_near(of: np.ndarray, to: np.ndarray) -> float:
    """Percent of the places with one of the others near."""
    distances = [np.min(np.hypot(*(to - place).T)) for place in of]
    return 100 * float(np.mean(np.array(distances) <= NEAR))


def inliers(pair: list, disparity: np.ndarray | None) -> int:
    """Matches by the distance ratio that are true: by disparity where it is known, else by rows."""
    (left, left_looks), (right, right_looks) = pair
    count = 0
    for best, second in cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(left_looks, right_looks, k=2):
        if best.distance >= RATIO * second.distance:
            continue
        a, b = left[best.queryIdx], right[best.trainIdx]
        if disparity is None:
            count += abs(a[1] - b[1]) <= 1.5
        else:
            known = disparity[int(round(a[1])), int(round(a[0]))]
            count += np.hypot(a[0] - known - b[0], a[1] - b[1]) <= 3
    return int(count)


def own_milliseconds(barchan: Barchan, image: Path, threshold: float, threads: int, work: Path) -> float:
    copies = [work / f"copy{k}{image.suffix}" for k in range(RUNS)]
    for copy in copies:
        shutil.copy(image, copy)
    os.environ["RAYON_NUM_THREADS"] = str(threads)
    try:
        summary = barchan.json("features", *copies, "--threshold", threshold, "--out", work / "timed")
    finally:
        del os.environ["RAYON_NUM_THREADS"]
    return summary["ms_median"]


def opencv_milliseconds(image: np.ndarray, threshold: float, threads: int) -> float:
    cv2.setNumThreads(threads)
    akaze = cv2.AKAZE_create(threshold=threshold)
    times = []
    for _ in range(RUNS):
        started = time.perf_counter()
        akaze.detectAndCompute(image, None)
        times.append(1e3 * (time.perf_counter() - started))
    return float(np.median(times))
