"""DEM and hillshade against GDAL: what rasterio reads, and what GDAL's own gdaldem makes of the DEM."""

import ctypes
from pathlib import Path

import numpy as np
import rasterio
from plyfile import PlyData

from common import Barchan, Table


def check(table: Table, folder: Path) -> None:
    """`folder` is the output of `barchan map`."""
    with rasterio.open(folder / "dem.tif") as file:
        dem, grid, bounds, shape = file.read(1), file.transform, file.bounds, file.shape
        table.equal("dem.tif: type", file.dtypes[0], "float32")
        table.equal("dem.tif: nodata", file.nodata, -9999.0)
        table.equal("dem.tif: AREA_OR_POINT", file.tags().get("AREA_OR_POINT"), "Area")
    north_up = grid.b == grid.d == 0 and grid.a > 0 and np.isclose(grid.a, -grid.e, rtol=1e-9)
    table.equal("dem.tif: north up, square cells", bool(north_up), True)
    cell = grid.a
    known = dem != -9999
    table.equal("dem.tif: heights finite", bool(np.isfinite(dem).all()), True)
    print(f"  {shape[1]} x {shape[0]} cells of {cell:g} m, {known.mean():.0%} known, {bounds}")

    cloud = PlyData.read(str(folder / "cloud.ply"))["vertex"]
    x, y, z = (np.asarray(cloud[axis], dtype=float) for axis in "xyz")
    overhang = max(
        abs(bounds.left - x.min()), abs(bounds.right - x.max()),
        abs(bounds.bottom - y.min()), abs(bounds.top - y.max()),
    )  # fmt: skip
    table.at_most("dem.tif: extent against that of cloud.ply, cells", overhang / cell, 2)

    # The height of a cell lies among the points that fall into it: the grid is where it says it is.
    column = np.clip(((x - bounds.left) / cell).astype(int), 0, shape[1] - 1)
    row = np.clip(((bounds.top - y) / cell).astype(int), 0, shape[0] - 1)
    lowest, highest = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(lowest, (row, column), z)
    np.maximum.at(highest, (row, column), z)
    both = known & np.isfinite(lowest)
    inside = (dem >= lowest - cell) & (dem <= highest + cell)
    table.at_least("dem.tif: cells that hold points of cloud.ply", both.sum() / known.sum(), 0.8)
    table.at_least("dem.tif: of those, height among the points", inside[both].mean(), 0.95)

    with rasterio.open(folder / "hillshade.tif") as file:
        shade, nodata = file.read(1).astype(float), file.nodata
        table.equal("hillshade.tif: same grid", (file.transform, file.shape) == (grid, shape), True)
    wanted = gdaldem_hillshade(folder / "dem.tif", folder / "gdaldem.tif").astype(float)
    blank, wanted_blank = shade == nodata, wanted == 0
    both = ~blank & ~wanted_blank
    table.at_most("hillshade.tif: cells blank here and not in gdaldem's", (blank & ~wanted_blank).sum(), 0)
    table.at_most("hillshade.tif: cells blank in gdaldem's and not here", (wanted_blank & ~blank).sum(), 0)
    largest = np.abs(shade - wanted)[both].max() if both.any() else np.nan
    table.at_most("hillshade.tif: largest difference to gdaldem, of 255", largest, 1)


def check_round_trip(table: Table, barchan: Barchan, shared: Path, work: Path) -> None:
    """Rasters that others wrote: values come out of barchan bit by bit, and shades are gdaldem's to the pixel."""
    random = np.random.default_rng(8)
    heights = random.normal(1000, 300, (70, 113)).astype(np.float32)
    place = rasterio.transform.from_origin(351234.5, 5612345.25, 0.25, 0.25)
    theirs = work / "theirs.tif"
    shape = {"height": 70, "width": 113, "count": 1, "dtype": "float32"}
    with rasterio.open(theirs, "w", driver="GTiff", crs="EPSG:32632", transform=place, nodata=-9999.0, **shape) as file:
        file.write(heights, 1)
    barchan("raster", "fill", theirs, "--out", work / "ours.tif")
    with rasterio.open(work / "ours.tif") as file:
        table.equal("GeoTIFF of rasterio through barchan: values", bool((file.read(1) == heights).all()), True)
        table.equal("GeoTIFF of rasterio through barchan: transform", file.transform == place, True)
        table.equal("GeoTIFF of rasterio through barchan: CRS", str(file.crs), "EPSG:32632")

    yard = shared / "marsyard2021" / "elevation.tif"
    for name, dem in (("random heights", theirs), ("marsyard2021", yard)):
        if not dem.is_file():
            continue
        barchan("raster", "hillshade", dem, "--out", work / "shade.tif")
        with rasterio.open(work / "shade.tif") as file:
            shade = file.read(1)
        wanted = gdaldem_hillshade(dem, work / "gdaldem.tif")
        table.at_most(f"hillshade of {name}: pixels that differ from gdaldem's", int((shade != wanted).sum()), 0)


def gdaldem_hillshade(dem: Path, out: Path) -> np.ndarray:
    """gdaldem hillshade (azimuth 315, altitude 45, z 1: its defaults), called in the GDAL library
    that rasterio's wheel brings."""
    (library,) = (Path(rasterio.__file__).parent.parent / "rasterio.libs").glob("libgdal-*")
    gdal = ctypes.CDLL(str(library))
    gdal.GDALOpen.restype = gdal.GDALDEMProcessing.restype = ctypes.c_void_p
    gdal.GDALOpen.argtypes = [ctypes.c_char_p, ctypes.c_int]
    gdal.GDALClose.argtypes = [ctypes.c_void_p]
    gdal.GDALDEMProcessing.argtypes = (
        [ctypes.c_char_p, ctypes.c_void_p] + [ctypes.c_char_p] * 2 + [ctypes.c_void_p] * 2
    )
    gdal.GDALAllRegister()
    source = gdal.GDALOpen(str(dem).encode(), 0)
    assert source, f"{dem}: GDAL cannot open it"
    made = gdal.GDALDEMProcessing(str(out).encode(), source, b"hillshade", None, None, None)
    assert made, f"{dem}: gdaldem failed"
    gdal.GDALClose(made)
    gdal.GDALClose(source)
    with rasterio.open(out) as file:
        return file.read(1)
