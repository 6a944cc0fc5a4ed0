"""barchan's outputs against programs nobody here wrote. `make peers` runs this.

Trains for a moment on a rendered traverse, exports, infers, tracks and maps, and holds every file
against ONNX Runtime, onnx, evo, GDAL, OpenCV, plyfile, laspy, pypcd4, Open3D, small_gicp, mcap and a browser.
Real images and published trajectories join where ../shared/data has them. Exits 1 when a figure is out of
bounds or a check fails to run.
"""

import argparse
import shutil
from pathlib import Path

import clouds
import features
import files
import matching
import network
import page
import rasters
import recordings
import speed
import trajectory
from common import Barchan, Table

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--barchan", type=Path, required=True, help="the built program")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "peers", help="folder for what is made")
    options = parser.parse_args()
    barchan, work, shared = Barchan(options.barchan), options.work, ROOT.parent / "shared" / "data"

    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    data, run, model = work / "data", work / "train", work / "model.onnx"
    if not shared.is_dir():
        print(f"skipped: real images and published trajectories (no {shared})")

    def prepare(table: Table) -> None:
        barchan("data", "synth", "synth:seed=5,frames=12", "--out", data)
        barchan("train", "--data", f"folder:{data}", "--preset", "tiny", "--steps", 40, "--out", run)
        barchan("export", run, "--out", model)
        barchan("infer", "--data", f"folder:{data}", "--model", model, "--out", work / "infer")
        barchan("slam", "--data", f"folder:{data}", "--model", model, "--out", work / "slam")
        barchan("map", work / "slam", "--pcd", "--out", work / "map")

    def exported(table: Table) -> None:
        network.check_file(table, model)

    def engines(table: Table) -> None:
        (weights,) = run.glob("*.safetensors")
        cases = network.cases(data, shared, work)
        network.check_disparity(table, barchan, model, weights, cases, work)

    def matchers(table: Table) -> None:
        matching.check(table, barchan, shared, work)

    def key_points(table: Table) -> None:
        features.check(table, barchan, shared, work)

    def trajectories(table: Table) -> None:
        cases = {
            "made up": trajectory.made_up_case(work),
            "synth": (work / "slam" / "trajectory.tum", data / "groundtruth.tum"),
            **trajectory.kitti_cases(shared, work),
        }
        for name, (estimate, truth) in cases.items():
            trajectory.check(table, barchan, name, estimate, truth)

    def terrain(table: Table) -> None:
        rasters.check(table, work / "map")
        rasters.check_round_trip(table, barchan, shared, work)

    def formats(table: Table) -> None:
        files.check_disparity(table, work / "infer")
        files.check_frame_clouds(table, work / "infer", data)
        files.check_cloud(table, work / "slam" / "map.ply")
        files.check_cloud(table, work / "map" / "cloud.ply")
        clouds.check_files(table, work / "map")

    def registration(table: Table) -> None:
        clouds.check_registration(table, barchan, work)

    def browser(table: Table) -> None:
        page.check(table, barchan, work / "slam", work / "map", work)

    def viewers(table: Table) -> None:
        recordings.check(table, barchan, work / "slam", work / "map", work)

    def timings(table: Table) -> None:
        speed.report(barchan, work)

    checks = [exported, engines, matchers, key_points, trajectories, terrain, formats, registration, browser, viewers]
    Table().run([prepare, *checks, timings])


if __name__ == "__main__":
    main()
