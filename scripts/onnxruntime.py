#!/usr/bin/env python3
"""Puts ONNX Runtime's shared library where `barchan` looks for it, out of its pinned wheel."""

import hashlib
import os
from pathlib import Path

import wheels

VERSION = "1.31.1"
WHEEL_SHA256 = "5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f"
LIBRARY_SHA256 = "fc44112fbe06d7d689c57e11d3862031f64711007e4ee020f8eed5185fd2c1d3"
TAGS = {
    "python-version": "3.11",
    "implementation": "cp",
    "abi": "cp311",
    "platform": "manylinux_2_28_x86_64",
}


def main() -> None:
    own = os.environ.get("BARCHAN_ONNXRUNTIME")
    if own:
        print(f"ONNX Runtime: {own} (from BARCHAN_ONNXRUNTIME)")
        return
    library = wheels.cache() / "onnxruntime" / VERSION / "libonnxruntime.so"
    if not is_intact(library):
        wheels.require_linux_x86_64(
            "ONNX Runtime",
            "install ONNX Runtime 1.17 or newer and set BARCHAN_ONNXRUNTIME to its shared library",
        )
        with wheels.workspace(library) as work:
            with wheels.wheel(work, f"onnxruntime=={VERSION}", WHEEL_SHA256, TAGS) as archive:
                member = f"onnxruntime/capi/libonnxruntime.so.{VERSION}"
                wheels.extract(archive, member, work / library.name)
            os.replace(work / library.name, library)
    print(f"ONNX Runtime: {library}")


def is_intact(library: Path) -> bool:
    """Whether the library is there, whole: a changed or truncated one is fetched anew."""
    if not library.is_file():
        return False
    return hashlib.sha256(library.read_bytes()).hexdigest() == LIBRARY_SHA256


if __name__ == "__main__":
    main()
