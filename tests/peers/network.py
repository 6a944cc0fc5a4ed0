"""The exported network: valid ONNX, and the same disparity in Python's ONNX Runtime as in barchan."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from common import Barchan, Table, crop_folder, image_size, read_pfm, read_rgb


def check_file(table: Table, model: Path) -> None:
    network = onnx.load(str(model))
    onnx.checker.check_model(network, full_check=True)
    onnx.shape_inference.infer_shapes(network, check_type=True, strict_mode=True, data_prop=True)
    table.equal("onnx.checker with full shape inference", "passes", "passes")
    for value in [*network.graph.input, *network.graph.output]:
        shape = [d.dim_param or d.dim_value for d in value.type.tensor_type.shape.dim]
        dynamic = len(shape) == 4 and all(isinstance(shape[i], str) for i in (0, 2, 3))
        table.equal(f"{value.name}: batch, height and width dynamic", dynamic, True)


def check_disparity(
    table: Table, barchan: Barchan, model: Path, weights: Path, cases: dict, work: Path
) -> None:
    """On every case (name: `folder` data set), all pixels, both engines against Python."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    for name, folder in cases.items():
        width, height = image_size(folder)
        truth = {}
        for left in sorted((folder / "left").iterdir()):
            pair = {
                side: read_rgb(folder / side / left.name).transpose(2, 0, 1)[None]
                for side in ("left", "right")
            }
            truth[left.stem] = session.run(["disparity"], pair)[0][0, 0]
        for engine, file, median, largest in [
            ("ONNX Runtime", model, 1e-4, 1e-3),
            ("Burn", weights, 1e-3, 1e-2),
        ]:
            out = work / f"{name}-{file.suffix[1:]}"
            barchan("infer", "--data", f"folder:{folder}", "--model", file, "--no-reject",
                    "--outlines", 0, "--out", out)
            difference = np.concatenate(
                [np.abs(read_pfm(out / "disparity" / f"{stem}.pfm") - d).ravel() for stem, d in truth.items()]
            )
            # A pixel left unknown makes both figures NaN, which is out of bounds.
            label = f"{name} {width}x{height}, {engine}: disparity, px"
            table.at_most(f"{label}, median", np.median(difference), median)
            table.at_most(f"{label}, largest", np.max(difference), largest)


def cases(synth: Path, shared: Path, work: Path) -> dict:
    """`folder` data sets of several sizes: whole, and with no side a multiple of anything."""
    width, height = image_size(synth)
    sizes = [(width, height), (width - 3, height - 5), (width // 2 + 1, height // 2), (97, 65)]
    found = {f"synth-{w}": crop_folder(synth, work / f"synth-{w}", 2, w, h) for w, h in sizes}
    arena = shared / "arena-run1"
    if arena.is_dir():
        found["arena-run1"] = crop_folder(arena, work / "arena-run1", 2, *image_size(arena))
    return found
