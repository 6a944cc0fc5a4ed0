"""The recording of a run as Foxglove's own MCAP reader reads it, against the run's and the map's files."""

import base64
import json
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import rasterio
from mcap.reader import make_reader
from plyfile import PlyData

from common import Barchan, Table

FLOAT32, UINT8 = 7, 1


def check(table: Table, barchan: Barchan, run: Path, map_dir: Path, work: Path) -> None:
    path = work / "run.mcap"
    barchan("view", run, "--map", map_dir, "--mcap", path)
    messages, schemas = defaultdict(list), {}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        table.equal("MCAP: topics by its statistics", reader.get_summary().statistics.channel_count, 9)
        for schema, channel, message in reader.iter_messages():
            schemas[channel.topic] = (schema.name, schema.encoding, channel.message_encoding)
            messages[channel.topic].append((message.log_time, json.loads(message.data)))
    named = all(n.startswith("foxglove.") and (e, m) == ("jsonschema", "json") for n, e, m in schemas.values())
    table.equal("MCAP: every message has a schema of Foxglove's", named, True)

    route = np.loadtxt(run / "trajectory.tum", ndmin=2)
    tf = [(t, m) for t, m in messages["/tf"] if m["child_frame_id"] == "camera"]
    told = np.array([[t / 1e9, *m["translation"].values(), *m["rotation"].values()] for t, m in tf])
    table.equal("MCAP: a transform for each frame", told.shape, route.shape)
    table.at_most("MCAP: transforms against trajectory.tum", np.abs(told - route).max(), 1e-6)

    keyframes = sorted((run / "keyframes" / "disparity").iterdir())
    for topic in ("/camera/left", "/camera/disparity"):
        table.equal(f"MCAP: {topic}, pictures", len(messages[topic]), len(keyframes))
    seen = cv2.imdecode(np.frombuffer(base64.b64decode(messages["/camera/left"][0][1]["data"]), np.uint8), 1)
    true = cv2.imread(str(run / "keyframes" / "left" / keyframes[0].name))
    off = np.abs(seen.astype(float) - true).mean() if seen.shape == true.shape else np.nan
    table.at_most("MCAP: the first picture by OpenCV, mean grey levels off", off, 6)

    cloud = messages["/map/cloud"][0][1]
    xyz, rgb = unpacked(cloud, "xyz", FLOAT32), unpacked(cloud, ["red", "green", "blue"], UINT8)
    xyz = xyz + list(cloud["pose"]["position"].values())
    ply = PlyData.read(str(map_dir / "cloud.ply"))["vertex"]
    wanted = np.stack([np.asarray(ply[axis], dtype=float) for axis in "xyz"], axis=1)
    table.equal("MCAP: points of /map/cloud", xyz.shape, wanted.shape)
    table.at_most("MCAP: points against cloud.ply, m", np.abs(xyz - wanted).max(), 1e-5)
    colours = np.stack([np.asarray(ply[c]) for c in ("red", "green", "blue")], axis=1)
    table.equal("MCAP: colours against cloud.ply", bool((rgb == colours).all()), True)

    grid = messages["/map/relief"][0][1]
    heights = unpacked(grid, ["elevation"], FLOAT32, "cell_stride").reshape(-1, grid["column_count"])
    with rasterio.open(map_dir / "dem.tif") as dem:
        truth, corner = dem.read(1, masked=True).filled(np.nan), (dem.bounds.left, dem.bounds.bottom)
    table.equal("MCAP: heights against dem.tif, southern row first", bool(np.array_equal(heights[::-1], truth, True)), True)
    place = grid["pose"]["position"]
    table.at_most("MCAP: corner of the relief, m", np.abs(np.subtract((place["x"], place["y"]), corner)).max(), 1e-9)


def unpacked(message: dict, names, kind: int, stride: str = "point_stride") -> np.ndarray:
    """Fields of packed bytes, a column each."""
    fields = {f["name"]: f for f in message["fields"]}
    assert all(fields[name]["type"] == kind for name in names)
    data = np.frombuffer(base64.b64decode(message["data"]), np.uint8).reshape(-1, message[stride])
    size = {FLOAT32: 4, UINT8: 1}[kind]
    columns = [data[:, fields[n]["offset"] : fields[n]["offset"] + size] for n in names]
    if kind == FLOAT32:
        columns = [np.ascontiguousarray(column).view("<f4") for column in columns]
    return np.concatenate(columns, axis=1)
