"""Clouds as laspy and pypcd4 read them, and registration against Open3D and small_gicp."""

import time
from pathlib import Path

import laspy
import numpy as np
import open3d
import small_gicp
from plyfile import PlyData, PlyElement
from pypcd4 import PointCloud

from common import Barchan, Table


def check_files(table: Table, folder: Path) -> None:
    """`folder` is the output of `barchan map --pcd`: three files of one cloud."""
    vertex = PlyData.read(str(folder / "cloud.ply"))["vertex"]
    place = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    colour = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1)

    by_open3d = open3d.io.read_point_cloud(str(folder / "cloud.ply"))
    table.equal("cloud.ply by Open3D: places", bool((np.asarray(by_open3d.points) == place).all()), True)
    rounded = np.rint(255 * np.asarray(by_open3d.colors)).astype(np.uint8)
    table.equal("cloud.ply by Open3D: colours", bool((rounded == colour).all()), True)

    las = laspy.read(folder / "cloud.laz")
    table.equal("cloud.laz by laspy: points", len(las), len(place))
    table.at_most("cloud.laz: largest difference to cloud.ply, m", np.abs(las.xyz - place).max(), 6e-5)
    rgb = np.stack([las.red, las.green, las.blue], axis=1)
    table.equal("cloud.laz: colours", bool((rgb == colour.astype(np.uint16) * 257).all()), True)
    inside = (las.header.mins <= las.xyz.min(axis=0) + 1e-9).all() and (las.header.maxs >= las.xyz.max(axis=0) - 1e-9).all()
    table.equal("cloud.laz: its header's extent holds them", bool(inside), True)

    pcd = PointCloud.from_path(folder / "cloud.pcd")
    table.equal("cloud.pcd by pypcd4: fields", " ".join(pcd.fields), "x y z rgb")
    table.equal("cloud.pcd: places", bool((pcd.numpy(("x", "y", "z")) == place).all()), True)
    table.equal("cloud.pcd: colours", bool((PointCloud.decode_rgb(pcd.pc_data["rgb"]) == colour).all()), True)


def by_open3d(reference: np.ndarray, estimate: np.ndarray) -> tuple[np.ndarray, float]:
    """The motion of point-to-plane registration and the seconds it took, normals and all."""
    begun = time.perf_counter()
    target, source = (open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p)) for p in (reference, estimate))
    target.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(20))
    registration = open3d.pipelines.registration
    found = registration.registration_icp(
        source, target, 0.5, np.eye(4), registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(1e-12, 1e-12, 100),
    )  # fmt: skip
    return found.transformation, time.perf_counter() - begun


def by_small_gicp(reference: np.ndarray, estimate: np.ndarray) -> tuple[np.ndarray, float]:
    """The motion of generalised registration and the seconds it took, covariances and all."""
    begun = time.perf_counter()
    target, source = small_gicp.PointCloud(reference), small_gicp.PointCloud(estimate)
    for cloud in (target, source):
        small_gicp.estimate_normals_covariances(cloud, num_neighbors=20)
    found = small_gicp.align(
        target, source, small_gicp.KdTree(target), registration_type="GICP", max_correspondence_distance=0.5,
        max_iterations=100, translation_epsilon=1e-7, rotation_epsilon=1e-8,
    )  # fmt: skip
    return found.T_target_source, time.perf_counter() - begun


def check_registration(table: Table, barchan: Barchan, work: Path) -> None:
    """30 000 points of hummocky ground, moved, against 60 000 others of it."""
    random = np.random.default_rng(4)

    def ground(count: int) -> np.ndarray:
        x, y = random.uniform(0, 20, count), random.uniform(0, 15, count)
        z = 0.5 * np.sin(0.7 * x) * np.cos(0.5 * y) + 0.15 * np.sin(1.9 * x + 1.3 * y)
        return np.stack([x, y, z + random.normal(0, 0.005, count)], axis=1)

    reference, estimate = ground(60_000), ground(30_000)
    turn, shift = np.radians(0.8), np.array([0.12, -0.09, 0.07])
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    estimate = (estimate - shift) @ rotation
    files = {}
    for name, points in (("reference", reference), ("estimate", estimate)):
        rows = np.array([tuple(p) for p in points], dtype=[(axis, "f8") for axis in "xyz"])
        files[name] = work / f"{name}.ply"
        PlyData([PlyElement.describe(rows, "vertex")]).write(str(files[name]))
    # small_gicp's own points with planes weighs each axis of the distance by the normal's, which is another
    # measure than the distance to the plane.
    for name, peer, flags, bound in (
        ("points with planes, Open3D", by_open3d, [], 1.0),
        ("planes with planes, small_gicp", by_small_gicp, ["--generalised"], np.inf),
    ):
        # Turn by turn, and the fastest of each: other work on the machine disturbs both.
        runs = []
        for _ in range(3):
            theirs, seconds = peer(reference, estimate)
            figures = barchan.json("eval", "cloud", "--est", files["estimate"], "--ref", files["reference"], *flags)
            runs.append((figures["seconds"], seconds))
        fastest = [min(times) for times in zip(*runs)]
        print(f"  {name}: ours {fastest[0]:.2f} s, theirs {fastest[1]:.2f} s")
        table.at_most(f"eval cloud: {name}, our time over its", fastest[0] / fastest[1], bound)
        ours = np.array(figures["transform"])
        between = np.linalg.inv(theirs) @ ours
        # From the sine: the cosine of so small an angle is 1 but for rounding.
        angle = np.degrees(np.linalg.norm(between[:3, :3] - between[:3, :3].T) / (2 * np.sqrt(2)))
        # At the middle of the cloud: the origin is a lever away.
        middle = estimate.mean(axis=0)
        apart = np.linalg.norm((ours[:3, :3] - theirs[:3, :3]) @ middle + ours[:3, 3] - theirs[:3, 3])
        table.at_most(f"eval cloud: {name}, m", apart, 1e-4)
        table.at_most(f"eval cloud: {name}, deg", angle, 1e-3)
        found = np.linalg.norm(rotation @ middle + shift - (ours[:3, :3] @ middle + ours[:3, 3]))
        table.at_most(f"eval cloud: {name}, ours against the truth, m", found, 5e-3)
