#!/usr/bin/env python3
"""Middlebury's Motorcycle, a real stereo pair with true disparity, out of a pinned wheel.

Written twice: as Middlebury publishes it (`middlebury` layout) and as a `folder`. The images are
Middlebury's (Scharstein et al., GCPR 2014), shipped within scikit-image at a quarter of their size.
"""

import argparse
import array
import io
import re
import struct
import sys
import tempfile
import zipfile
from pathlib import Path

import wheels

REQUIREMENT = "scikit-image==0.16.2"
SHA256 = "41e28db0136f29ecd305bef0408fdfc64be9d415e54f5099a95555c65f5c1865"
TAGS = {
    "python-version": "3.8",
    "implementation": "cp",
    "abi": "cp38",
    "platform": "manylinux1_x86_64",
}

# Calibration of these quarter-size images, as skimage.data.stereo_motorcycle documents it. Depth is
# FOCAL * BASELINE / (disparity + DOFFS): the right camera's principal point lies DOFFS further right.
FOCAL, CX, CY, DOFFS = 994.978, 311.193, 254.877, 31.086
BASELINE_MM = 193.001
# Middlebury's own search range for this scene at full size is 280.
NDISP = 70

CALIB = """\
cam0=[{f} 0 {cx}; 0 {f} {cy}; 0 0 1]
cam1=[{f} 0 {cx1}; 0 {f} {cy}; 0 0 1]
doffs={doffs}
baseline={baseline}
width={width}
height={height}
ndisp={ndisp}
isint=0
vmin={vmin}
vmax={vmax}
"""

RIG = """\
# Middlebury 2014 Motorcycle, quarter size. Disparity 0 is not at infinity here: the right camera's
# principal point lies {doffs} px further right (Middlebury's doffs).
rectified = true
width = {width}
height = {height}
baseline = {baseline_m}

[left]
fx = {f}
fy = {f}
cx = {cx}
cy = {cy}
model = "pinhole"

[right]
fx = {f}
fy = {f}
cx = {cx1}
cy = {cy}
model = "pinhole"
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to write into")
    out = parser.parse_args().out

    with tempfile.TemporaryDirectory() as work:
        with wheels.wheel(Path(work), REQUIREMENT, SHA256, TAGS) as archive:
            left = archive.read("skimage/data/motorcycle_left.png")
            right = archive.read("skimage/data/motorcycle_right.png")
            npz = archive.read("skimage/data/motorcycle_disp.npz")
    width, height, disparity = read_disparity(npz)
    for image in (left, right):
        if struct.unpack(">II", image[16:24]) != (width, height):
            sys.exit(f"{REQUIREMENT}: images and disparity differ in size")

    # Unknown is infinite, here as in Middlebury's own files.
    known = [d for d in disparity if d != float("inf")]
    facts = {
        "f": FOCAL,
        "cx": CX,
        "cy": CY,
        "cx1": round(CX + DOFFS, 3),
        "doffs": DOFFS,
        "baseline": BASELINE_MM,
        "baseline_m": round(BASELINE_MM / 1000, 6),
        "width": width,
        "height": height,
        "ndisp": NDISP,
        "vmin": int(min(known)),
        "vmax": int(max(known)) + 1,
    }
    pfm = write_pfm(width, height, disparity)

    official = out / "middlebury2014" / "trainingQ" / "Motorcycle"
    write(official / "im0.png", left)
    write(official / "im1.png", right)
    write(official / "disp0GT.pfm", pfm)
    write(official / "calib.txt", CALIB.format(**facts).encode())

    folder = out / "motorcycle"
    write(folder / "left" / "000000.png", left)
    write(folder / "right" / "000000.png", right)
    write(folder / "disparity" / "000000.pfm", pfm)
    write(folder / "rig.toml", RIG.format(**facts).encode())

    print(f"Motorcycle, {width}x{height}, true disparity for {len(known) / len(disparity):.1%}:")
    print(f"  middlebury:{official}")
    print(f"  folder:{folder}")


def read_disparity(npz: bytes) -> tuple:
    """Width, height and the rows, top first, of the one float32 array in a NumPy archive."""
    raw = zipfile.ZipFile(io.BytesIO(npz)).read("arr_0.npy")
    # NumPy's format 1.0: magic, version, length of the header, the header, the values.
    (length,) = struct.unpack("<H", raw[8:10])
    header = raw[10 : 10 + length].decode("latin-1")
    shape = re.search(r"'shape': \((\d+), (\d+)\)", header)
    if raw[:8] != b"\x93NUMPY\x01\x00" or "'<f4', 'fortran_order': False" not in header or not shape:
        sys.exit(f"{REQUIREMENT}: the disparity is not a float32 array: {header}")
    height, width = int(shape[1]), int(shape[2])
    values = array.array("f", raw[10 + length :])
    if sys.byteorder == "big":
        values.byteswap()
    return width, height, values


def write_pfm(width: int, height: int, values: array.array) -> bytes:
    """A grey PFM: rows bottom first, a negative scale for little-endian values."""
    rows = (values[y * width : (y + 1) * width] for y in reversed(range(height)))
    body = b"".join(struct.pack(f"<{width}f", *row) for row in rows)
    return f"Pf\n{width} {height}\n-1\n".encode() + body


def write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


if __name__ == "__main__":
    main()
