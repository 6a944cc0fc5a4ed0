"""Disparity images and clouds as other programs read them: OpenCV, plyfile."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
from plyfile import PlyData

from common import Table, read_pfm


def check_disparity(table: Table, folder: Path) -> None:
    """`folder` is the output of `barchan infer`, with rejection."""
    paths = sorted((folder / "disparity").glob("*.png"))
    table.at_least("infer: disparity PNG files", len(paths), 1)
    worst, masks, opencv = 0.0, 0, 0.0
    for path in paths:
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16 and stored.ndim == 2, f"{path}: not 16-bit grey"
        exact = read_pfm(path.with_suffix(".pfm"))
        known = np.isfinite(exact)
        masks += int((known != (stored != 0)).sum())
        # 0 says unknown, so a disparity nearer than 1/512 to 0 is stored as 1.
        both = known & (stored > 1)
        worst = max(worst, np.abs(stored / 256.0 - exact)[both].max())
        by_opencv = cv2.imread(str(path.with_suffix(".pfm")), cv2.IMREAD_UNCHANGED)
        opencv = max(opencv, np.abs(by_opencv[known] - exact[known]).max())
    table.at_most("disparity PNG by OpenCV against PFM, largest, px", worst, 1 / 512 + 1e-6)
    table.at_most("disparity PNG: pixels known in one file only", masks, 0)
    table.at_most("disparity PFM by OpenCV against a plain reader, px", opencv, 0)


def check_frame_clouds(table: Table, folder: Path, data: Path) -> None:
    """Every point of a frame's cloud, seen by the left camera, lies on a pixel at its disparity."""
    rig = tomllib.loads((data / "rig.toml").read_text())
    left, right = rig["left"], rig.get("right", rig["left"])
    doffs = right["cx"] - left["cx"]
    paths = sorted(folder.rglob("*.ply"))
    table.at_least("infer: clouds", len(paths), 1)
    off_pixel = off_disparity = 0.0
    for path in paths:
        exact = read_pfm(folder / "disparity" / f"{path.stem}.pfm")
        x, y, z = coordinates(path)
        u, v = left["fx"] * x / z + left["cx"], left["fy"] * y / z + left["cy"]
        column, row = np.rint(u).astype(int), np.rint(v).astype(int)
        off_pixel = max(off_pixel, np.abs(u - column).max(), np.abs(v - row).max())
        disparity = left["fx"] * rig["baseline"] / z - doffs
        off_disparity = max(off_disparity, np.abs(disparity - exact[row, column]).max())
    table.at_most("clouds by plyfile: largest distance to a pixel, px", off_pixel, 1e-2)
    table.at_most("clouds by plyfile: largest difference of disparity, px", off_disparity, 1e-2)


def check_cloud(table: Table, path: Path) -> None:
    x, y, z = coordinates(path)
    table.at_least(f"{path.parent.name}/{path.name} by plyfile: points", len(z), 1000)
    finite = np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(z).all()
    table.equal(f"{path.parent.name}/{path.name}: coordinates finite", bool(finite), True)


def coordinates(path: Path) -> tuple:
    """Coordinates of a coloured cloud."""
    vertex = PlyData.read(str(path))["vertex"]
    for colour in ("red", "green", "blue"):
        assert vertex[colour].dtype == np.uint8, f"{path}: {colour} is not 8-bit"
    return tuple(np.asarray(vertex[axis], dtype=float) for axis in "xyz")
