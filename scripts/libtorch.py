#!/usr/bin/env python3
"""libtorch for the optional `tch` device, out of pinned wheels: the CPU part of PyTorch, no Python.

PyTorch's wheel is built for CUDA, and its CPU library names two CUDA libraries: they come out of
two small wheels. Its own libtorch.so links the CUDA part (1 GB); a stub takes its place.
"""

import subprocess
import sys
from pathlib import Path

import wheels

VERSION = "2.9.1"
CPYTHON = {
    "python-version": "3.11",
    "implementation": "cp",
    "abi": "cp311",
    "platform": "manylinux_2_28_x86_64",
}
NVIDIA = {"python-version": "3.11", "platform": "manylinux2014_x86_64"}

# requirement, sha256 of the wheel, tags, the folder in it whose files go to lib/, which of them
PARTS = [
    (
        f"torch=={VERSION}",
        "d033ff0ac3f5400df862a51bdde9bad83561f3739ea0046e68f5401ebfa67c1b",
        CPYTHON,
        "torch/lib/",
        ["libtorch_cpu.so", "libc10.so", "libgomp.so.1", "libshm.so"],
    ),
    (
        "nvidia-cuda-cupti-cu12==12.8.90",
        "ea0cb07ebda26bb9b29ba82cda34849e73c166c18162d3913575b0c9db9a6182",
        NVIDIA,
        "nvidia/cuda_cupti/lib/",
        ["libcupti.so.12"],
    ),
    (
        "nvidia-cuda-runtime-cu12==12.8.90",
        "adade8dcbd0edf427b7204d480d6066d33902cab2a4707dcfc48a2d0fd44ab90",
        NVIDIA,
        "nvidia/cuda_runtime/lib/",
        ["libcudart.so.12"],
    ),
]
INCLUDE = "torch/include/"

# A 2x2x2 window of ones over ones sums to 8. The cost volume lives on conv3d and its gradient.
TRIAL = r"""
#include <torch/torch.h>
#include <iostream>
int main() {
  auto x = torch::ones({1, 1, 4, 4, 4}, torch::requires_grad());
  auto y = torch::conv3d(x, torch::ones({1, 1, 2, 2, 2}));
  y.sum().backward();
  auto ok = torch::equal(y.detach(), torch::full({1, 1, 3, 3, 3}, 8.0f)) && x.grad().max().item<float>() == 8.0f;
  std::cout << (ok ? "ok" : "wrong") << std::endl;
  return ok ? 0 : 1;
}
"""


def main() -> None:
    final = wheels.cache() / "libtorch" / VERSION
    # No file build-version, as PyTorch's own archives have: by it torch-sys 0.22 would refuse
    # everything but 2.9.0, and 2.9.1 serves it as well.
    if not final.is_dir():
        wheels.require_linux_x86_64("libtorch", "unpack PyTorch's own and set LIBTORCH to it")
        with wheels.workspace(final) as work:
            wheels.require_space(work, 2.5)
            torch = work / "libtorch"
            for requirement, sha256, tags, folder, names in PARTS:
                with wheels.wheel(work, requirement, sha256, tags) as archive:
                    for name in names:
                        wheels.extract(archive, folder + name, torch / "lib" / name)
                    for member in archive.namelist():
                        if member.startswith(INCLUDE) and not member.endswith("/"):
                            to = torch / "include" / member.removeprefix(INCLUDE)
                            wheels.extract(archive, member, to)
            link_stub(torch / "lib")
            try_out(torch, work)
            wheels.replace_folder(torch, final)
    print(f"libtorch {VERSION}. To build with the tch device and run it:")
    print(f"export LIBTORCH={final} LD_LIBRARY_PATH={final / 'lib'}")


def link_stub(lib: Path) -> None:
    """libtorch.so: nothing of its own, the CPU libraries only."""
    run(
        ["gcc", "-shared", "-o", "libtorch.so", "-Wl,--no-as-needed", "-Wl,-rpath,$ORIGIN"]
        + ["-L.", "-ltorch_cpu", "-lc10", "-Wl,--allow-shlib-undefined"],
        lib,
    )


def try_out(torch: Path, work: Path) -> None:
    """Compiles, links and runs a convolution, as torch-sys will."""
    print("trying it: a C++ program with a conv3d and its gradient", flush=True)
    (work / "trial.cpp").write_text(TRIAL)
    include = torch / "include"
    run(
        ["g++", "-std=c++17", "trial.cpp", "-o", "trial", f"-I{include}"]
        + [f"-I{include / 'torch/csrc/api/include'}", f"-L{torch / 'lib'}"]
        + [f"-Wl,-rpath,{torch / 'lib'}", "-ltorch", "-ltorch_cpu", "-lc10"],
        work,
    )
    run(["./trial"], work)


def run(command: list, folder: Path) -> None:
    try:
        result = subprocess.run(command, cwd=folder)
    except FileNotFoundError:
        sys.exit(f"{command[0]} not found: a C and C++ compiler (gcc, g++) is needed")
    if result.returncode != 0:
        sys.exit(f"failed (see above): {' '.join(command)}")


if __name__ == "__main__":
    main()
