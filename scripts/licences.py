#!/usr/bin/env python3
"""Licences of every crate that is part of the barchan program, a line each on standard output.

Wanted of them: one that lets anybody use and pass on the program. `deny.toml` says the same to
cargo-deny, where that is installed; this needs nothing but cargo.
"""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Crates that state no name of a licence but carry its text, which was read.
READ = {"cfg_block": "Apache-2.0"}


def crates():
    """The packages that are compiled into the program, by their edges in cargo's resolution."""
    host = re.search(r"^host: (.*)$", run("rustc", "-vV"), re.MULTILINE)[1]
    arguments = ["--format-version", "1", "--locked", "--filter-platform", host]
    metadata = json.loads(run("cargo", "metadata", *arguments))
    packages = {p["id"]: p for p in metadata["packages"]}
    nodes = {n["id"]: n for n in metadata["resolve"]["nodes"]}
    root = next(p["id"] for p in metadata["packages"] if p["name"] == "barchan")
    found, todo = set(), [root]
    while todo:
        package = todo.pop()
        if package in found:
            continue
        found.add(package)
        for dependency in nodes[package]["deps"]:
            if any(kind["kind"] is None for kind in dependency["dep_kinds"]):
                todo.append(dependency["pkg"])
    return sorted((packages[p] for p in found), key=lambda p: (p["name"], p["version"]))


def run(*command):
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def allowed(expression, licences):
    """Whether an SPDX expression is met: one name of each part that AND joins. Stricter than SPDX where
    an AND stands inside an OR."""
    parts = re.split(r"\s+AND\s+", expression.replace("/", " OR "))
    names = ([n.strip(" ()") for n in re.split(r"\s+OR\s+", part)] for part in parts)
    return all(any(name in licences for name in part) for part in names)


def main():
    licences = tomllib.loads((ROOT / "deny.toml").read_text())["licenses"]["allow"]
    refused = 0
    for crate in crates():
        licence = crate["license"] or READ.get(crate["name"], "none stated")
        print(f"{crate['name']} {crate['version']}: {licence}")
        if not allowed(licence, licences):
            print(f"error: {crate['name']}: {licence} is not in deny.toml", file=sys.stderr)
            refused += 1
    sys.exit(1 if refused else 0)


if __name__ == "__main__":
    main()
