"""`eval trajectory` against evo, on published estimates, a hostile made-up one and barchan's own."""

import copy
from pathlib import Path

import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from common import Barchan, Table

# As barchan's: the largest difference in time of two poses of one moment, seconds.
TOLERANCE = 0.02


def check(table: Table, barchan: Barchan, name: str, estimate: Path, truth: Path) -> None:
    ours = barchan.json("eval", "trajectory", "--est", estimate, "--gt", truth)
    reference = file_interface.read_tum_trajectory_file(str(truth))
    theirs = file_interface.read_tum_trajectory_file(str(estimate))
    reference, theirs = sync.associate_trajectories(reference, theirs, max_diff=TOLERANCE)

    def ate(with_scale: bool) -> float:
        aligned = copy.deepcopy(theirs)
        aligned.align(reference, correct_scale=with_scale)
        error = metrics.APE(metrics.PoseRelation.translation_part)
        error.process_data((reference, aligned))
        return error.get_statistic(metrics.StatisticsType.rmse)

    def rpe(relation: metrics.PoseRelation) -> np.ndarray:
        error = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
        error.process_data((reference, theirs))
        return error.error

    length = reference.path_length
    steps, turns = rpe(metrics.PoseRelation.translation_part), rpe(metrics.PoseRelation.rotation_angle_deg)
    table.equal(f"{name}: poses compared", ours["frames"], reference.num_poses)
    for key, value in {
        "length": length,
        "ate_rmse": ate(False),
        "ate_rmse_sim3": ate(True),
        "rpe_trans_rmse": np.sqrt(np.mean(steps**2)),
        "rpe_trans_percent": 100 * steps.sum() / length,
        "rpe_rot_rmse_deg": np.sqrt(np.mean(turns**2)),
        "rpe_rot_deg_per_m": turns.sum() / length,
    }.items():
        table.at_most(f"{name}: {key} {ours[key]:.6f}, difference to evo", abs(ours[key] - value), 1e-6)


def kitti_cases(shared: Path, work: Path) -> dict:
    """KITTI 00 as TUM files: name to (estimate, truth)."""
    folder = shared / "trajectories"
    if not folder.is_dir():
        return {}
    times = np.loadtxt(folder / "KITTI_00_gt_times.txt")

    def convert(name: str) -> Path:
        poses = file_interface.read_kitti_poses_file(str(folder / f"{name}.txt")).poses_se3
        stamped = PoseTrajectory3D(poses_se3=poses, timestamps=times[: len(poses)])
        out = work / f"{name}.tum"
        file_interface.write_tum_trajectory_file(str(out), stamped)
        return out

    truth = convert("KITTI_00_gt")
    return {
        "KITTI 00 S-PTAM": (convert("KITTI_00_SPTAM"), truth),
        "KITTI 00 ORB-SLAM2": (convert("KITTI_00_ORB"), truth),
    }


def made_up_case(work: Path) -> tuple:
    """A winding drive; the estimate in another world, scaled, drifting, late by up to 5 ms and with
    a third of its frames missing."""
    rng = np.random.default_rng(7)
    t = np.arange(300) * 0.1
    position = np.stack([5 * np.sin(0.3 * t), 0.5 * np.cos(t), 0.4 * t], axis=1)
    rotation = Rotation.from_euler("yxz", np.stack([np.cos(0.3 * t), 0.1 * np.sin(t), 0.05 * t], axis=1))
    world = Rotation.from_rotvec([0.4, -1.2, 2.0])
    keep = np.sort(rng.choice(len(t), 200, replace=False))
    drift = np.cumsum(rng.normal(scale=0.01, size=position.shape), axis=0)
    noise = Rotation.from_rotvec(rng.normal(scale=0.01, size=position.shape))

    def write(name: str, times, positions, rotations) -> Path:
        rows = np.column_stack([times, positions, rotations.as_quat()])
        np.savetxt(work / name, rows, fmt="%.17g")
        return work / name

    truth = write("made-up-truth.tum", t, position, rotation)
    moved = 0.9 * world.apply(position + drift) + [10, -3, 7]
    late = t + rng.uniform(-0.005, 0.005, len(t))
    estimate = write("made-up.tum", late[keep], moved[keep], (world * rotation * noise)[keep])
    return estimate, truth
