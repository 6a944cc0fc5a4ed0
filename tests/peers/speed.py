"""How fast the network is: against OpenCV's semi-global matching, and against what the machine could do.

Prints ratios within one run; nothing here passes or fails, as a loaded machine would decide it.
"""

import time
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime

from common import Barchan, crop_folder

WIDTH, HEIGHT, RANGE = 484, 366, 64
"""Hong's images, and what is searched in them."""
RUNS = 20


def report(barchan: Barchan, work: Path) -> None:
    data = work / "speed" / "data"
    barchan("data", "synth", f"synth:seed=5,frames={RUNS},width={WIDTH},height={HEIGHT}", "--out", data)
    one = crop_folder(data, work / "speed" / "one", 2, 256, 128)
    sgbm, peak = opencv_sgbm(data), matrix_peak()
    print(f"  {WIDTH}x{HEIGHT}, {RANGE} disparities, 2 threads: OpenCV SGBM {sgbm:.1f} ms, matrix peak {peak:.0f} GFLOP/s")
    for preset in ("tiny", "rover", "paper"):
        run, model = work / "speed" / preset, work / "speed" / f"{preset}.onnx"
        barchan("train", "--data", f"folder:{one}", "--preset", preset, "--steps", 1, "--crop", 64, 96,
                "--max-disparity", RANGE, "--out", run)
        barchan("export", run, "--out", model)
        times = {}
        for engine, file in (("ONNX Runtime", model), ("Burn", run)):
            out = work / "speed" / f"{preset}-{engine[0]}"
            summary = barchan.json("infer", "--data", f"folder:{data}", "--no-check", "--no-reject",
                                   "--outlines", 0, "--threads", 2, "--model", file, "--out", out)
            times[engine] = summary["ms_median"]
        giga = operations(model) / 1e9
        ort, burn = times["ONNX Runtime"], times["Burn"]
        print(
            f"  {preset}: ONNX Runtime {ort:.1f} ms = {ort / sgbm:.2f} times SGBM = "
            f"{ort / (1e3 * giga / peak):.2f} times its {giga:.2f} GFLOP at peak; Burn {burn / ort:.2f} times ONNX Runtime"
        )


    # The weights above know nothing, and outlines of noise are all outlines.
    milliseconds = [
        barchan.json("infer", "--data", f"folder:{data}", "--no-check", "--no-reject", "--outlines", passes, "--threads", 2,
                     "--model", f"rover:{RANGE}", "--out", work / "speed" / f"shipped-{passes}")["ms_median"]
        for passes in (0, 2)
    ]
    print(f"  shipped rover: {milliseconds[0]:.1f} ms, with its outlines sharpened {milliseconds[1]:.1f} ms = "
          f"{milliseconds[1] / sgbm:.2f} times SGBM")


def opencv_sgbm(data: Path) -> float:
    """Median milliseconds of MODE_SGBM over the folder."""
    cv2.setNumThreads(2)
    matcher = cv2.StereoSGBM_create(0, RANGE, 5, 200, 800, 1, 0, 10, 100, 2)
    times = []
    for left in sorted((data / "left").iterdir()):
        pair = [cv2.imread(str(data / side / left.name), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")]
        started = time.perf_counter()
        matcher.compute(*pair)
        times.append(1e3 * (time.perf_counter() - started))
    return float(np.median(times))


def matrix_peak() -> float:
    """GFLOP/s of a large product of float matrices."""
    a = np.random.default_rng(0).standard_normal((2048, 2048), dtype=np.float32)
    times = []
    for _ in range(6):
        started = time.perf_counter()
        a @ a
        times.append(time.perf_counter() - started)
    return 2 * 2048**3 / min(times) / 1e9


def operations(model: Path) -> float:
    """Multiplications and additions of the convolutions and matrix products, for one pair."""
    network = onnx.load(str(model))
    heavy = [n for n in network.graph.node if n.op_type in ("Conv", "ConvTranspose", "MatMul")]
    names = {name for node in heavy for name in (node.input[0], node.output[0])}
    # Sizes are not in the file: a run with these values as outputs tells them.
    named = {output.name for output in network.graph.output}
    network.graph.output.extend(onnx.ValueInfoProto(name=name) for name in sorted(names - named))
    session = onnxruntime.InferenceSession(network.SerializeToString(), providers=["CPUExecutionProvider"])
    wanted = [output.name for output in session.get_outputs()]
    pair = {side: np.zeros((1, 3, HEIGHT, WIDTH), np.float32) for side in ("left", "right")}
    shapes = {name: value.shape for name, value in zip(wanted, session.run(wanted, pair))}
    weights = {i.name: list(i.dims) for i in network.graph.initializer}
    total = 0
    for node in heavy:
        out = np.prod(shapes[node.output[0]])
        if node.op_type == "Conv":
            total += 2 * out * np.prod(weights[node.input[1]][1:])
        elif node.op_type == "ConvTranspose":
            # Every input meets the whole kernel once.
            total += 2 * np.prod(shapes[node.input[0]]) * np.prod(weights[node.input[1]][1:])
        elif node.op_type == "MatMul":
            total += 2 * out * shapes[node.input[0]][-1]
    return float(total)
