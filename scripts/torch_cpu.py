#!/usr/bin/env python3
"""PyTorch without CUDA into the virtual environment that runs this, out of pinned wheels.

The wheels of the Python package registry are built for CUDA: with all they depend on, 3 GB to fetch and
7 GB on disk, of which training on a CPU runs nothing. Here the CUDA part (1.2 GB) stays in the wheel, and a
stub takes its place that only has the names which PyTorch's Python bindings look up when they are loaded.
`torch.cuda.is_available()` is False; what asks for CUDA all the same ends the process.
"""

import ctypes
import subprocess
import sys
import sysconfig
from pathlib import Path

import libtorch
import wheels

# sha256 of the wheel by the version of CPython.
TORCH = {
    "3.11": "d033ff0ac3f5400df862a51bdde9bad83561f3739ea0046e68f5401ebfa67c1b",
    "3.12": "27331cd902fb4322252657f3902adf1c4f6acad9dcad81d8df3ae14c7c4f07c4",
    "3.13": "524de44cd13931208ba2c4bde9ec7741fd4ae6bfd06409a604fc32f6520c2bc9",
}
LEFT_OUT = ("torch/include/", "torch/share/", "torch/bin/protoc")
LEFT_OUT_LIBRARIES = ["libtorch_cuda.so", "libtorch_cuda_linalg.so", "libtorch_nvshmem.so"]
# What the bindings link besides libtorch_cuda.so, and these wheels do not hold.
EMPTY = ["libcudnn.so.9", "libcusparseLt.so.0", "libcufile.so.0"]
# Called when the bindings are loaded: a reference to a null function pointer.
GIL_CHECKER = "_ZN4c10d15get_gil_checkerEv"

TRIAL = """
import torch
x = torch.ones(1, 1, 4, 4, 4, requires_grad=True)
y = torch.conv3d(x, torch.ones(1, 1, 2, 2, 2))
y.sum().backward()
assert torch.equal(y, torch.full((1, 1, 3, 3, 3), 8.0)) and x.grad.max() == 8 and not torch.cuda.is_available()
"""


def main() -> None:
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    wheels.require_linux_x86_64("PyTorch", "install PyTorch from its own site")
    if version not in TORCH:
        sys.exit(f"PyTorch {libtorch.VERSION}: pinned for CPython {', '.join(TORCH)}, this is {version}; give one with PYTHON=")
    if sys.prefix == sys.base_prefix:
        sys.exit("run this with the Python of a virtual environment, which it installs into")
    final = Path(sysconfig.get_paths()["purelib"])
    if not (final / "torch").is_dir():
        with wheels.workspace(final / "torch") as work:
            wheels.require_space(work, 2.5)
            unpack(work, version)
            link_stubs(work / "torch" / "lib")
            libtorch.run([sys.executable, "-c", TRIAL], work)
            for package in ("torchgen", "functorch", "torch"):
                wheels.replace_folder(work / package, final / package)
    print(f"PyTorch {libtorch.VERSION} for CPU in {final}")


def unpack(work: Path, version: str) -> None:
    """The wheel but for its CUDA part, and two small libraries of CUDA that its CPU part links."""
    tag = "cp" + version.replace(".", "")
    tags = {**libtorch.CPYTHON, "python-version": version, "abi": tag}
    left_out = LEFT_OUT + tuple(f"torch/lib/{name}" for name in LEFT_OUT_LIBRARIES)
    with wheels.wheel(work, f"torch=={libtorch.VERSION}", TORCH[version], tags) as archive:
        for member in archive.namelist():
            ours = member.startswith(("torch/", "torchgen/", "functorch/")) and not member.endswith("/")
            if ours and not member.startswith(left_out):
                wheels.extract(archive, member, work / member)
    (work / "torch" / "bin" / "torch_shm_manager").chmod(0o755)
    for requirement, sha256, tags, folder, names in libtorch.PARTS[1:]:
        with wheels.wheel(work, requirement, sha256, tags) as archive:
            for name in names:
                wheels.extract(archive, folder + name, work / "torch" / "lib" / name)


def link_stubs(lib: Path) -> None:
    """libtorch_cuda.so with every name that the bindings want and nobody else has, the others empty."""
    missing = symbols(lib / "libtorch_python.so", "--undefined-only", "U")
    for path in lib.glob("*.so*"):
        missing -= symbols(path, "--defined-only")
    for system in (ctypes.CDLL(None), ctypes.CDLL("libstdc++.so.6")):  # the first is Python
        missing = {name for name in missing if not hasattr(system, name)}
    functions = sorted(name for name in missing if not name.startswith("_ZT"))
    lines = [".text"]
    lines += [f".globl {name}\n{name}:" for name in functions if name != GIL_CHECKER]
    lines += ["ud2", f".globl {GIL_CHECKER}\n{GIL_CHECKER}:", "lea nothing(%rip), %rax", "ret"]
    # Type information has to be true, as types are registered by name; tables of methods are never used.
    lines += [".data", ".balign 8"]
    for name in sorted(name for name in missing if name.startswith("_ZTI")):
        kind = "_ZTVN10__cxxabiv117__class_type_infoE"
        lines += [f".globl {name}\n{name}: .quad {kind} + 16, name{name}"]
        lines += [f'.section .rodata\nname{name}: .asciz "{name.removeprefix("_ZTI")}"\n.data']
    lines += [".bss"]
    lines += [f".globl {name}\n{name}:" for name in sorted(missing) if name.startswith("_ZTV")]
    lines += ["nothing: .zero 4096", '.section .note.GNU-stack,"",@progbits', ""]
    source = lib / "stub.s"
    source.write_text("\n".join(lines))
    link = ["gcc", "-shared", "-nostdlib", "-Wl,--no-as-needed"]
    libtorch.run([*link, "-Wl,-soname,libtorch_cuda.so", "-o", "libtorch_cuda.so", source.name, "-lstdc++"], lib)
    source.write_text("")
    for name in EMPTY:
        libtorch.run([*link, f"-Wl,-soname,{name}", "-o", name, source.name], lib)
    source.unlink()


def symbols(path: Path, which: str, kind: str = "") -> set:
    """Names of dynamic symbols of a library; `kind` is the letter that nm gives them."""
    try:
        result = subprocess.run(["nm", "-D", which, str(path)], capture_output=True, text=True)
    except FileNotFoundError:
        sys.exit("nm not found: the binutils that come with gcc are needed")
    found = [line.split()[-2:] for line in result.stdout.splitlines()]
    return {name.split("@")[0] for letter, name in found if letter.startswith(kind)}


if __name__ == "__main__":
    main()
