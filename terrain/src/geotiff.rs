use std::fs::File;
use std::io::{BufReader, Cursor, Seek, Write};
use std::path::Path;

use tiff::decoder::{Decoder, DecodingResult};
use tiff::encoder::colortype::{ColorType, Gray8, Gray32Float};
use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, TiffValue};
use tiff::tags::{ExtraSamples, Tag};
use tiff::{TiffError, TiffResult};

use crate::atomic::write_atomically;
use crate::{Grid, NODATA, Raster, TerrainError};

/// A coordinate system as a GeoTIFF spells it (its GeoKeys): kept as it was read, to be written with
/// products made of that raster.
#[derive(Clone, Debug, PartialEq)]
pub struct Crs {
    keys: Vec<[u16; 4]>,
    doubles: Vec<f64>,
    ascii: String,
}

/// A type of cell that a file can hold.
pub trait Sample: Copy + PartialEq {
    /// The colour type of the `tiff` crate that stores it.
    type Stored: ColorType<Inner = Self>;
    /// What GDAL is told to take for "no data".
    const NODATA: &'static str;
    /// The value as stored.
    fn to_file(self) -> Self;
    /// A value of a file as this type; `no_data` when it is the file's marker for that. `None` when
    /// this type cannot hold it.
    fn from_file(value: f64, no_data: bool) -> Option<Self>;
}

impl Sample for f32 {
    type Stored = Gray32Float;
    const NODATA: &'static str = "-9999";

    fn to_file(self) -> Self {
        if self.is_nan() { NODATA } else { self }
    }

    fn from_file(value: f64, no_data: bool) -> Option<Self> {
        Some(if no_data { f32::NAN } else { value as f32 })
    }
}

impl Sample for u8 {
    type Stored = Gray8;
    const NODATA: &'static str = "0";

    fn to_file(self) -> Self {
        self
    }

    fn from_file(value: f64, no_data: bool) -> Option<Self> {
        let exact = value as u8;
        if no_data {
            Some(0)
        } else {
            (f64::from(exact) == value).then_some(exact)
        }
    }
}

impl<T: Sample> Raster<T>
where
    [T]: TiffValue,
{
    /// Writes a GeoTIFF of one band, see [`write_geotiff`].
    ///
    /// # Errors
    /// As [`write_geotiff`].
    pub fn write(&self, path: &Path) -> Result<(), TerrainError> {
        write_geotiff(path, &self.grid, self.crs.as_ref(), &[("", &self.values)])
    }
}

impl<T: Sample> Raster<T> {
    /// Reads the first band of a north-up GeoTIFF of any number type. Cells of the file's "no data"
    /// value become NaN (`f32`) or 0 (`u8`).
    ///
    /// # Errors
    /// When the file cannot be read or is no TIFF, has no place on the ground (no geotransform), is
    /// rotated, or holds values that `T` does not.
    pub fn read(path: &Path) -> Result<Self, TerrainError> {
        let mut bands = Self::read_bands(path)?;
        Ok(bands.swap_remove(0).1)
    }

    /// Reads all bands, at least one, with their names as GDAL keeps them; empty where there is none.
    ///
    /// # Errors
    /// As [`Raster::read`].
    pub fn read_bands(path: &Path) -> Result<Vec<(String, Self)>, TerrainError> {
        let bad = |message: String| TerrainError::Raster {
            path: path.to_owned(),
            message,
        };
        let damaged = |e: TiffError| bad(format!("not a TIFF that can be read: {e}"));
        let file = File::open(path).map_err(TerrainError::io(path))?;
        let mut tiff = Decoder::new(BufReader::new(file)).map_err(damaged)?;

        let (width, height) = tiff.dimensions().map_err(damaged)?;
        let place = read_place(&mut tiff).map_err(damaged)?;
        let [west, north, cell_x, cell_y] = place.ok_or_else(|| {
            bad("it has no north-up geotransform\n  cure: give it one, as with gdal_translate -a_ullr or gdalwarp".into())
        })?;
        let grid = Grid {
            width: width as usize,
            height: height as usize,
            west,
            north,
            cell_x,
            cell_y,
        };
        let crs = read_crs(&mut tiff).map_err(damaged)?;
        let nodata = optional(tiff.get_tag_ascii_string(Tag::GdalNodata)).map_err(damaged)?;
        let nodata: Option<f64> =
            nodata.and_then(|text| text.trim_end_matches('\0').trim().parse().ok());

        let metadata = optional(tiff.get_tag_ascii_string(GDAL_METADATA)).map_err(damaged)?;
        let metadata = metadata.unwrap_or_default();

        let stored = tiff.read_image().map_err(damaged)?;
        let (samples, single) =
            samples(stored).ok_or_else(|| bad("its number type is not supported".into()))?;
        // Bands are interleaved by pixel, or the first plane alone was read.
        let bands = samples.len() / (grid.width * grid.height).max(1);
        if bands == 0 || samples.len() != bands * grid.width * grid.height {
            return Err(bad(format!(
                "it holds {} values for {width} x {height} cells",
                samples.len()
            )));
        }
        // The marker is text of a double; cells of f32 hold it rounded.
        let marker = nodata.map(|n| if single { f64::from(n as f32) } else { n });
        let value = |v: f64| {
            let no_data = v.is_nan() || marker.is_some_and(|m| m == v);
            T::from_file(v, no_data).ok_or_else(|| {
                bad(format!(
                    "it holds {v}, where whole numbers of 0 to 255 are expected"
                ))
            })
        };
        (0..bands)
            .map(|k| {
                let values = samples.iter().skip(k).step_by(bands).map(|v| value(*v));
                let raster = Self {
                    grid,
                    crs: crs.clone(),
                    values: values.collect::<Result<Vec<T>, _>>()?,
                };
                Ok((band_name(&metadata, k), raster))
            })
            .collect()
    }
}

/// Writes a GeoTIFF: deflate, cells as areas, north up, "no data" declared (-9999 for `f32`, where
/// NaN stands in memory; 0 for `u8`). Without a `crs` the file declares a local frame in metres. Each
/// band has a name, which QGIS and gdalinfo show; an empty one is not written.
///
/// # Errors
/// When the file cannot be written (an older one of that name then stays as it was), or a band has
/// not the size of the grid.
pub fn write_geotiff<T: Sample>(
    path: &Path,
    grid: &Grid,
    crs: Option<&Crs>,
    bands: &[(&str, &[T])],
) -> Result<(), TerrainError>
where
    [T]: TiffValue,
{
    write_atomically(path, |out| encode(path, out, grid, crs, bands))
}

/// The bytes of the file that [`write_geotiff`] writes.
///
/// # Errors
/// When a band has not the size of the grid.
pub fn geotiff_bytes<T: Sample>(
    grid: &Grid,
    crs: Option<&Crs>,
    bands: &[(&str, &[T])],
) -> Result<Vec<u8>, TerrainError>
where
    [T]: TiffValue,
{
    let mut bytes = Cursor::new(vec![]);
    encode(Path::new("raster"), &mut bytes, grid, crs, bands)?;
    Ok(bytes.into_inner())
}

/// `path` is for messages.
fn encode<T: Sample>(
    path: &Path,
    out: impl Write + Seek,
    grid: &Grid,
    crs: Option<&Crs>,
    bands: &[(&str, &[T])],
) -> Result<(), TerrainError>
where
    [T]: TiffValue,
{
    let bad = |message: String| TerrainError::Raster {
        path: path.to_owned(),
        message,
    };
    let cells = grid.width * grid.height;
    if bands.is_empty() || bands.iter().any(|b| b.1.len() != cells) {
        return Err(bad(format!(
            "every band of the raster must hold {cells} values"
        )));
    }
    let (Ok(width), Ok(height)) = (u32::try_from(grid.width), u32::try_from(grid.height)) else {
        return Err(bad(
            "a TIFF holds at most 4294967295 rows and columns".into()
        ));
    };
    let interleaved: Vec<T> = (0..cells)
        .flat_map(|i| bands.iter().map(move |b| b.1[i].to_file()))
        .collect();
    let local = Crs::local();
    let crs = crs.unwrap_or(&local);
    let write = || -> TiffResult<()> {
        let mut tiff =
            TiffEncoder::new(out)?.with_compression(Compression::Deflate(DeflateLevel::Balanced));
        let mut image = tiff.new_image::<T::Stored>(width, height)?;
        if bands.len() > 1 {
            image.extra_samples(&vec![ExtraSamples::Unspecified; bands.len() - 1])?;
        }
        let tags = image.encoder();
        tags.write_tag(
            Tag::ModelPixelScaleTag,
            &[grid.cell_x, grid.cell_y, 0.0][..],
        )?;
        tags.write_tag(
            Tag::ModelTiepointTag,
            &[0.0, 0.0, 0.0, grid.west, grid.north, 0.0][..],
        )?;
        tags.write_tag(Tag::GeoKeyDirectoryTag, &crs.directory()[..])?;
        if !crs.doubles.is_empty() {
            tags.write_tag(Tag::GeoDoubleParamsTag, &crs.doubles[..])?;
        }
        if !crs.ascii.is_empty() {
            tags.write_tag(Tag::GeoAsciiParamsTag, crs.ascii.as_str())?;
        }
        let names = band_names(bands.iter().map(|b| b.0));
        if !names.is_empty() {
            tags.write_tag(GDAL_METADATA, names.as_str())?;
        }
        tags.write_tag(Tag::GdalNodata, T::NODATA)?;
        image.write_data(&interleaved)
    };
    write().map_err(|e| match e {
        TiffError::IoError(source) => TerrainError::Io {
            path: path.to_owned(),
            source,
        },
        other => bad(other.to_string()),
    })
}

/// Where GDAL keeps what TIFF has no tag for, as XML.
const GDAL_METADATA: Tag = Tag::Unknown(42112);

/// The names of bands as GDAL writes them; empty without any. Names are of this program: plain words.
fn band_names<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let items: String = names
        .enumerate()
        .filter(|(_, name)| !name.is_empty())
        .map(|(k, name)| {
            format!("<Item name=\"DESCRIPTION\" sample=\"{k}\" role=\"description\">{name}</Item>")
        })
        .collect();
    if items.is_empty() {
        return items;
    }
    format!("<GDALMetadata>{items}</GDALMetadata>")
}

/// The name of band `k` in what [`band_names`] or GDAL wrote; empty where there is none.
fn band_name(metadata: &str, k: usize) -> String {
    let sample = format!("sample=\"{k}\"");
    let items = metadata.split("<Item").skip(1);
    let mut described = items.filter_map(|item| {
        let (attributes, rest) = item.split_once('>')?;
        let names = attributes.contains("role=\"description\"") && attributes.contains(&sample);
        names.then(|| rest.split('<').next().unwrap_or_default().to_owned())
    });
    described.next().unwrap_or_default()
}

impl Crs {
    const RASTER_TYPE: u16 = 1025;

    /// A frame of nobody's but the rover's, in metres (GeoTIFF 1.1, 7.5: user-defined model).
    fn local() -> Self {
        let ascii = "Local frame, metres|".to_string();
        let length = ascii.len() as u16;
        let keys = vec![
            [1024, 0, 1, 32767],      // GTModelType: user-defined
            [1026, 34737, length, 0], // GTCitation: the text above
            [3076, 0, 1, 9001],       // ProjLinearUnits: metre
        ];
        Self {
            keys,
            doubles: vec![],
            ascii,
        }
    }

    /// The GeoKeyDirectory tag: header, then the keys in ascending order, cells as areas.
    fn directory(&self) -> Vec<u16> {
        let others = self
            .keys
            .iter()
            .copied()
            .filter(|k| k[0] != Self::RASTER_TYPE);
        let mut keys: Vec<[u16; 4]> = others.chain([[Self::RASTER_TYPE, 0, 1, 1]]).collect();
        keys.sort_unstable();
        [1, 1, 0, keys.len() as u16]
            .into_iter()
            .chain(keys.into_iter().flatten())
            .collect()
    }

    /// Whether values stand for points at the cell corners, not for areas.
    fn is_point(&self) -> bool {
        self.keys
            .iter()
            .any(|k| k[0] == Self::RASTER_TYPE && k[3] == 2)
    }
}

/// West, north, cell width and height of a north-up raster; `None` of any other.
fn read_place(tiff: &mut Decoder<BufReader<File>>) -> TiffResult<Option<[f64; 4]>> {
    let scale = optional(tiff.get_tag_f64_vec(Tag::ModelPixelScaleTag))?;
    let tie = optional(tiff.get_tag_f64_vec(Tag::ModelTiepointTag))?;
    let matrix = optional(tiff.get_tag_f64_vec(Tag::ModelTransformationTag))?;
    let place = match (scale.as_deref(), tie.as_deref(), matrix.as_deref()) {
        (Some([sx, sy, ..]), Some([i, j, _, x, y, _, ..]), _) => [x - i * sx, y + j * sy, *sx, *sy],
        (_, _, Some([a, b, _, x, c, d, _, y, ..])) if *b == 0.0 && *c == 0.0 => [*x, *y, *a, -d],
        _ => return Ok(None),
    };
    let [mut west, mut north, sx, sy] = place;
    if read_crs(tiff)?.is_some_and(|crs| crs.is_point()) {
        west -= 0.5 * sx;
        north += 0.5 * sy;
    }
    let valid = sx > 0.0 && sy > 0.0 && [west, north, sx, sy].iter().all(|v| v.is_finite());
    Ok(valid.then_some([west, north, sx, sy]))
}

fn read_crs(tiff: &mut Decoder<BufReader<File>>) -> TiffResult<Option<Crs>> {
    let Some(directory) = optional(tiff.get_tag_u16_vec(Tag::GeoKeyDirectoryTag))? else {
        return Ok(None);
    };
    let keys = directory
        .chunks_exact(4)
        .skip(1)
        .map(|k| [k[0], k[1], k[2], k[3]])
        .collect();
    let doubles = optional(tiff.get_tag_f64_vec(Tag::GeoDoubleParamsTag))?.unwrap_or_default();
    let ascii = optional(tiff.get_tag_ascii_string(Tag::GeoAsciiParamsTag))?.unwrap_or_default();
    Ok(Some(Crs {
        keys,
        doubles,
        ascii: ascii.trim_end_matches('\0').into(),
    }))
}

/// A tag that may be absent.
fn optional<T>(tag: TiffResult<T>) -> TiffResult<Option<T>> {
    match tag {
        Ok(value) => Ok(Some(value)),
        Err(TiffError::FormatError(tiff::TiffFormatError::RequiredTagNotFound(_))) => Ok(None),
        Err(e) => Err(e),
    }
}

/// Stored values as numbers, and whether they were stored as f32; `None` of types no DEM has.
fn samples(stored: DecodingResult) -> Option<(Vec<f64>, bool)> {
    fn wide<T: Into<f64>>(values: Vec<T>) -> Vec<f64> {
        values.into_iter().map(Into::into).collect()
    }
    Some(match stored {
        DecodingResult::U8(v) => (wide(v), false),
        DecodingResult::U16(v) => (wide(v), false),
        DecodingResult::U32(v) => (wide(v), false),
        DecodingResult::I8(v) => (wide(v), false),
        DecodingResult::I16(v) => (wide(v), false),
        DecodingResult::I32(v) => (wide(v), false),
        DecodingResult::F32(v) => (wide(v), true),
        DecodingResult::F64(v) => (v, false),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    fn relief(width: usize, height: usize) -> Raster<f32> {
        let grid = Grid {
            width,
            height,
            west: -3.25,
            north: 7.5,
            cell_x: 0.05,
            cell_y: 0.05,
        };
        let mut values: Vec<f32> = (0..width * height)
            .map(|i| (i as f32 * 0.37).sin() * 3.0 + i as f32 * 1e-3)
            .collect();
        values[width + 1] = f32::NAN;
        Raster {
            grid,
            crs: None,
            values,
        }
    }

    fn same(a: &[f32], b: &[f32]) -> bool {
        a.len() == b.len()
            && a.iter()
                .zip(b)
                .all(|(x, y)| x == y || (x.is_nan() && y.is_nan()))
    }

    #[test]
    fn rasters_round_trip_exactly() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dem.tif");
        // The second is larger than a strip.
        for dem in [relief(37, 23), relief(900, 700)] {
            dem.write(&path).unwrap();
            let back = Raster::<f32>::read(&path).unwrap();
            assert_eq!(back.grid, dem.grid);
            assert!(same(&back.values, &dem.values));
            // Written again with the CRS that was read: nothing changes any more.
            back.write(&path).unwrap();
            assert_eq!(Raster::<f32>::read(&path).unwrap().crs, back.crs);
        }
        let shade = Raster {
            grid: relief(37, 23).grid,
            crs: None,
            values: (0..37 * 23).map(|i| i as u8).collect(),
        };
        shade.write(&path).unwrap();
        let back = Raster::<u8>::read(&path).unwrap();
        assert_eq!((back.grid, back.values), (shade.grid, shade.values));
    }

    #[test]
    fn of_several_bands_the_first_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bands.tif");
        let dem = relief(31, 17);
        let other = vec![5.0f32; 31 * 17];
        let bands: [(&str, &[f32]); 3] = [("height", &dem.values), ("", &other), ("five", &other)];
        write_geotiff(&path, &dem.grid, None, &bands).unwrap();
        assert!(same(
            &Raster::<f32>::read(&path).unwrap().values,
            &dem.values
        ));
        let read = Raster::<f32>::read_bands(&path).unwrap();
        let names: Vec<&str> = read.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["height", "", "five"]);
        assert!(same(&read[0].1.values, &dem.values) && same(&read[2].1.values, &other));
        let text = Command::new("gdalinfo").arg(&path).output();
        if let Ok(text) = text.map(|out| String::from_utf8_lossy(&out.stdout).into_owned()) {
            let described = |name| text.contains(&format!("Description = {name}"));
            assert!(described("height") && described("five"), "{text}");
        }
        let short = [("", &dem.values[..]), ("", &other[1..])];
        assert!(write_geotiff(&path, &dem.grid, None, &short).is_err());
    }

    #[test]
    fn what_is_no_georeferenced_raster_is_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("broken.tif");
        let refused = || Raster::<f32>::read(&path).unwrap_err().to_string();
        relief(40, 30).write(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for length in [0, 3, 8, 100, whole.len() / 2, whole.len() - 5] {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert!(refused().contains("broken.tif"), "{length}");
        }
        std::fs::write(&path, b"\x89PNG not a tiff").unwrap();
        assert!(refused().contains("not a TIFF"), "{}", refused());
        image::GrayImage::new(8, 8).save(&path).unwrap();
        assert!(refused().contains("geotransform"), "{}", refused());
        relief(4, 4).write(&path).unwrap();
        let error = Raster::<u8>::read(&path).unwrap_err().to_string();
        assert!(error.contains("whole numbers"), "{error}");
    }

    #[test]
    fn gdal_sees_place_size_and_no_data() {
        if Command::new("gdalinfo").arg("--version").output().is_err() {
            println!("skipped: no gdalinfo");
            return;
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dem.tif");
        relief(37, 23).write(&path).unwrap();
        let out = Command::new("gdalinfo")
            .arg("-stats")
            .arg(&path)
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&out.stdout).into_owned();
        for expected in [
            "Size is 37, 23",
            "Origin = (-3.250000000000000,7.500000000000000)",
            "Pixel Size = (0.050000000000000,-0.050000000000000)",
            "AREA_OR_POINT=Area",
            "NoData Value=-9999",
            "Type=Float32",
            "COMPRESSION=DEFLATE",
        ] {
            assert!(text.contains(expected), "{expected} not in\n{text}");
        }
        assert!(
            out.stderr.is_empty(),
            "{}",
            String::from_utf8_lossy(&out.stderr)
        );
    }

    #[test]
    fn a_raster_of_gdal_reads_as_gdal_reads_it() {
        let yard = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../shared/data/marsyard2021/elevation.tif");
        if !yard.is_file() {
            println!("skipped: no {}", yard.display());
            return;
        }
        let dem = Raster::<f32>::read(&yard).unwrap();
        assert_eq!((dem.grid.width, dem.grid.height), (500, 500));
        assert_eq!((dem.grid.west, dem.grid.north), (-23.5, 21.5));
        assert!((dem.grid.cell_x - 0.094).abs() < 1e-12 && dem.crs.is_some());
        let known = || dem.values.iter().copied().filter(|v| v.is_finite());
        let (low, high) = known().fold((f32::MAX, f32::MIN), |(a, b), v| (a.min(v), b.max(v)));
        // As the survey is described: -0.98 to 5.59 m.
        assert!(
            (low + 0.98).abs() < 0.01 && (high - 5.59).abs() < 0.01,
            "{low} {high}"
        );
    }
}
