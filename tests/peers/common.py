"""What the checks share: running barchan, the table of figures, plain readers and writers."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
import traceback
from pathlib import Path

import cv2
import numpy as np


class Barchan:
    """The built program."""

    def __init__(self, program: Path):
        self.program = program

    def __call__(self, *arguments) -> str:
        """Runs one command and gives what it printed."""
        words = [str(self.program), *map(str, arguments)]
        result = subprocess.run(words, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if result.returncode != 0:
            raise RuntimeError(f"{' '.join(words)}\nexit {result.returncode}: {result.stderr.strip()}")
        return result.stdout

    def json(self, *arguments) -> dict:
        return json.loads(self(*arguments, "--json"))


class Table:
    """Figures against bounds, one line each, printed as they come."""

    def __init__(self):
        self.bad = 0
        self.rows = 0
        print(f"{'check':<64} {'figure':>12}   {'bound':<10}")

    def line(self, name: str, figure: str, bound: str, good: bool) -> None:
        self.rows += 1
        self.bad += not good
        print(f"{name:<64} {figure:>12}   {bound:<10} {'ok' if good else 'NOT OK'}", flush=True)

    def run(self, parts: list) -> None:
        """Runs the parts of a check, prints the sum, and ends the program: with 1 where a figure is bad."""
        for part in parts:
            try:
                part(self)
            except Exception as error:  # One part that cannot run must not hide the others' figures.
                traceback.print_exc()
                self.line(f"{part.__name__} could not run", type(error).__name__, "", False)
        print(f"{self.rows - self.bad} passed, {self.bad} failed")
        sys.exit(1 if self.bad else 0)

    def at_most(self, name: str, figure: float, bound: float) -> None:
        # Written so that a figure that is not a number is not good.
        self.line(name, f"{figure:.3g}", f"<= {bound:g}", bool(figure <= bound))

    def at_least(self, name: str, figure: float, bound: float) -> None:
        self.line(name, f"{figure:.4g}", f">= {bound:g}", bool(figure >= bound))

    def equal(self, name: str, figure, wanted) -> None:
        self.line(name, str(figure), f"= {wanted}", figure == wanted)


def read_pfm(path: Path) -> np.ndarray:
    """A grey PFM as float32, top row first, NaN where not known. Reads by the format, not by OpenCV."""
    with open(path, "rb") as file:
        assert file.readline().strip() == b"Pf", f"{path}: not a grey PFM"
        width, height = map(int, file.readline().split())
        little = float(file.readline()) < 0
        values = np.frombuffer(file.read(), "<f4" if little else ">f4").reshape(height, width)
    values = np.flipud(values).astype(np.float32)
    return np.where(np.isfinite(values), values, np.nan)


def read_rgb(path: Path) -> np.ndarray:
    """An image as float32 RGB in 0..1, rows by columns by 3, by OpenCV."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert image is not None, f"{path}: OpenCV cannot read it"
    return image[:, :, ::-1].astype(np.float32) / 255


def crop_folder(source: Path, out: Path, frames: int, width: int, height: int) -> Path:
    """The first frames of a `folder` data set, the top left `width` by `height` of each."""
    shutil.rmtree(out, ignore_errors=True)
    for side in ("left", "right"):
        (out / side).mkdir(parents=True)
        for path in sorted((source / side).iterdir())[:frames]:
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(out / side / f"{path.stem}.png"), image[:height, :width])
    rig = (source / "rig.toml").read_text()
    for key, value in (("width", width), ("height", height)):
        rig = re.sub(rf"^{key} *=.*$", f"{key} = {value}", rig, flags=re.MULTILINE)
    (out / "rig.toml").write_text(rig)
    return out


def image_size(folder: Path) -> tuple:
    """Width and height of the images of a `folder` data set."""
    rig = tomllib.loads((folder / "rig.toml").read_text())
    return rig["width"], rig["height"]
