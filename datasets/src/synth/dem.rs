use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use nalgebra::{Point3, Vector2};
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use super::options::Options;
use super::relief::Clear;
use super::rocks::{Rocks, scatter};
use super::rover::Plan;
use super::surface::Surface;
use crate::DataError;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// The largest grid that is rendered: with room for the spline beyond its ends, the next power of
/// two is 2048.
const MOST: usize = 2046;
/// Metres between the route and the end of the ground: the wheels, and something to look at.
const MARGIN: f64 = 1.5;

/// A digital elevation model: heights at the nodes of a grid, metres.
pub(super) struct Dem {
    pub width: usize,
    pub height: usize,
    /// Metres between nodes.
    pub cell: f64,
    /// Where the first node of the first row lies.
    pub corner: Vector2<f64>,
    /// Row by row from the south (towards positive y), no gaps.
    pub heights: Vec<f64>,
}

impl Dem {
    /// Reads a GeoTIFF of one channel. World x and y are its model coordinates (taken as metres), z
    /// its heights. Cells without data take the mean of their nearest neighbours.
    ///
    /// # Errors
    /// When the file is missing, damaged, no grid of heights in square cells, too large or empty.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let file = File::open(path).map_err(DataError::io(path))?;
        let damaged = |e: tiff::TiffError| {
            DataError::file(path, format!("cannot be read as a GeoTIFF of heights: {e}"))
        };
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(damaged)?;
        let (width, height) = decoder.dimensions().map_err(damaged)?;
        let (width, height) = (width as usize, height as usize);
        if !(4..=MOST).contains(&width) || !(4..=MOST).contains(&height) {
            let message = format!(
                "is {width} x {height}; from 4 x 4 to {MOST} x {MOST} can be rendered: cut out or resample (gdal_translate -srcwin or -outsize)"
            );
            return Err(DataError::file(path, message));
        }
        let numbers = |decoder: &mut Decoder<_>, tag| decoder.get_tag_f64_vec(tag).ok();
        let scale = numbers(&mut decoder, Tag::ModelPixelScaleTag);
        let tie = numbers(&mut decoder, Tag::ModelTiepointTag);
        let (Some([sx, sy, ..]), Some([i, j, _, x, y, ..])) = (scale.as_deref(), tie.as_deref())
        else {
            return Err(DataError::file(
                path,
                "has no ModelPixelScale and ModelTiepoint tags: a north-up GeoTIFF is needed (gdalwarp makes one)",
            ));
        };
        let square = (sx - sy).abs() <= 1e-6 * sx;
        if !(*sx > 0.0 && sx.is_finite() && square && x.is_finite() && y.is_finite()) {
            let message = format!(
                "cells of {sx} x {sy}; square cells in metres are needed (gdalwarp -tr 0.1 0.1)"
            );
            return Err(DataError::file(path, message));
        }
        // GTRasterTypeGeoKey (1025) is 2 when the tie point is a node, else it is a cell's corner.
        let keys = decoder.get_tag_u16_vec(Tag::GeoKeyDirectoryTag).ok();
        let is_point = keys
            .unwrap_or_default()
            .chunks_exact(4)
            .any(|key| key[0] == 1025 && key[3] == 2);
        let shift = if is_point { 0.0 } else { 0.5 };
        let nodata = decoder.get_tag_ascii_string(Tag::GdalNodata).ok();
        let nodata: Option<f64> = nodata.and_then(|t| t.trim_matches(['\0', ' ']).parse().ok());
        let corner = Vector2::new(
            x + (shift - i) * sx,
            y - (height as f64 - 1.0 + shift - j) * sx,
        );
        let cell = *sx;

        let rows: Vec<f64> = match decoder.read_image().map_err(damaged)? {
            DecodingResult::F32(v) => v.into_iter().map(f64::from).collect(),
            DecodingResult::F64(v) => v,
            DecodingResult::U8(v) => v.into_iter().map(f64::from).collect(),
            DecodingResult::U16(v) => v.into_iter().map(f64::from).collect(),
            DecodingResult::I16(v) => v.into_iter().map(f64::from).collect(),
            DecodingResult::I32(v) => v.into_iter().map(f64::from).collect(),
            _ => {
                return Err(DataError::file(
                    path,
                    "holds no 8-, 16- or 32-bit numbers: convert it (gdal_translate -ot Float32)",
                ));
            }
        };
        if rows.len() != width * height {
            return Err(DataError::file(
                path,
                "has more than one channel: heights need one (gdal_translate -b 1)",
            ));
        }
        let known = |h: f64| (h.is_finite() && h.abs() < 1e5 && Some(h) != nodata).then_some(h);
        let from_south = rows.chunks_exact(width).rev().flatten();
        let heights = fill(width, from_south.map(|h| known(*h)).collect())
            .ok_or_else(|| DataError::file(path, "holds no height at all, only missing data"))?;
        Ok(Self {
            width,
            height,
            cell,
            corner,
            heights,
        })
    }

    /// The spline surface that goes through every height of the grid.
    pub fn surface(&self) -> Surface {
        let (width, height) = (self.width, self.height);
        let side = (width.max(height) + 2).next_power_of_two();
        // Heights are counted from the middle one, so that single precision resolves micrometres
        // on high ground as well.
        let (lowest, highest) = self
            .heights
            .iter()
            .fold((f64::MAX, f64::MIN), |(a, b), h| (a.min(*h), b.max(*h)));
        let zero = lowest.midpoint(highest);
        let mut grid: Vec<f64> = self.heights.iter().map(|h| h - zero).collect();
        grid.chunks_exact_mut(width).for_each(interpolate);
        let mut column = vec![0.0; height];
        for i in 0..width {
            for (j, h) in column.iter_mut().enumerate() {
                *h = grid[j * width + i];
            }
            interpolate(&mut column);
            for (j, h) in column.iter().enumerate() {
                grid[j * width + i] = *h;
            }
        }
        // Beyond its ends the grid is mirrored, as the interpolation has it; the rest repeats the
        // last row and column and is never seen.
        let mirrored = |k: usize, n: usize| match k {
            k if k < n => k,
            k if k == side - 1 => 1,
            k if k == n => n - 2,
            _ => n - 1,
        };
        let node =
            |k: usize| grid[mirrored(k / side, height) * width + mirrored(k % side, width)] as f32;
        Surface::new(
            side,
            self.cell,
            Point3::new(self.corner.x, self.corner.y, zero),
            Some([width - 1, height - 1]),
            (0..side * side).map(node).collect(),
        )
    }
}

/// The ground of a digital elevation model and the plan moved to its flattest part. Rocks lie on it
/// when the options say so.
///
/// # Errors
/// When the file cannot be used, or is too small to drive on.
pub(super) fn build(
    path: &Path,
    options: &Options,
    plan: &mut Plan,
) -> Result<(Surface, Rocks), DataError> {
    let dem = Dem::read(path)?;
    let surface = dem.surface();
    let [long, wide] = [dem.width, dem.height].map(|n| (n - 1) as f64 * dem.cell / 2.0);
    let middle = dem.corner + Vector2::new(long, wide);
    let room = long.min(wide) - MARGIN;
    let most = room / Plan::REACH;
    let length = options.frames as f64 * super::INTERVAL * options.speed;
    let has_room = options.round.is_none() || plan.scale <= most;
    plan.scale = plan.scale.min(most);
    if !has_room || plan.scale < 0.2 || !plan.stays_within(room, length) {
        let message = format!(
            "{:.1} x {:.1} m are too small for this route of {length:.1} m: ask for fewer frames, another route or a larger grid",
            2.0 * long,
            2.0 * wide
        );
        return Err(DataError::file(path, message));
    }
    // Of the places that have room for the route, the one where it climbs least.
    let spare = [long, wide].map(|half| half - MARGIN - Plan::REACH * plan.scale);
    let mut best = f64::MAX;
    let mut centre = middle;
    for k in 0..25 {
        let step = |k: i32, spare: f64| f64::from(k - 2) / 2.0 * spare.max(0.0);
        let moved = Vector2::new(step(k % 5, spare[0]), step(k / 5, spare[1]));
        plan.centre = middle + moved;
        let heights = (0..200).map(|s| {
            let place = plan.place(length.min(100.0) * f64::from(s) / 200.0);
            surface.height(place.x, place.y)
        });
        let (low, high) = heights.fold((f64::MAX, f64::MIN), |(a, b), h| (a.min(h), b.max(h)));
        // A straight line may leave the ground where a closed route would not.
        let stays = plan.place(0.0).metric_distance(&middle) < room
            && plan.place(length).metric_distance(&middle) < room;
        if high - low < best && stays {
            (best, centre) = (high - low, plan.centre);
        }
    }
    plan.centre = centre;
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let clear = Clear::new(plan, length.min(100.0) + 8.0, surface.period());
    let list = scatter(&surface, options.rocks.unwrap_or(0.0), &mut rng, |place| {
        if clear.at(place) { 0.04 } else { f64::MAX }
    });
    let rocks = Rocks::new(&surface, list);
    Ok((surface, rocks))
}

/// Fills gaps ring by ring with the mean of the neighbours already known. `None` if all is a gap.
fn fill(width: usize, mut grid: Vec<Option<f64>>) -> Option<Vec<f64>> {
    let height = grid.len() / width;
    let around = |k: usize| {
        let (i, j) = (k % width, k / width);
        (j.saturating_sub(1)..(j + 2).min(height)).flat_map(move |j| {
            (i.saturating_sub(1)..(i + 2).min(width)).map(move |i| j * width + i)
        })
    };
    let is_edge =
        |grid: &[Option<f64>], k: usize| grid[k].is_none() && around(k).any(|n| grid[n].is_some());
    let mut ring: Vec<usize> = (0..grid.len()).filter(|k| is_edge(&grid, *k)).collect();
    while !ring.is_empty() {
        let mean = |k: usize| {
            let known = around(k).filter_map(|n| grid[n]);
            let (sum, n) = known.fold((0.0, 0.0), |(s, n), h| (s + h, n + 1.0));
            (k, sum / n)
        };
        let found: Vec<(usize, f64)> = ring.iter().map(|k| mean(*k)).collect();
        for (k, h) in &found {
            grid[*k] = Some(*h);
        }
        ring = found.iter().flat_map(|(k, _)| around(*k)).collect();
        ring.sort_unstable();
        ring.dedup();
        ring.retain(|k| grid[*k].is_none());
    }
    grid.into_iter().collect()
}

/// Turns samples into the control points of the uniform cubic B-spline through them, mirrored at
/// the ends: a recursive filter forwards and backwards (Unser 1999, box 2).
fn interpolate(line: &mut [f64]) {
    let pole = 3f64.sqrt() - 2.0;
    let n = line.len();
    // The filter's sum over all mirrored samples before the first.
    let mut sum = line[0];
    let mut power = pole;
    for k in 1..n.min(40) {
        sum += line[k] * power;
        power *= pole;
    }
    // With fewer than 40 samples the mirror images beyond the far end count as well.
    if n < 40 {
        for k in (1..n - 1).rev() {
            sum += line[k] * power;
            power *= pole;
        }
        sum /= 1.0 - pole.powi(2 * n as i32 - 2);
    }
    line[0] = sum;
    for k in 1..n {
        line[k] += pole * line[k - 1];
    }
    line[n - 1] = pole / (pole * pole - 1.0) * (line[n - 1] + pole * line[n - 2]);
    for k in (0..n - 1).rev() {
        line[k] = pole * (line[k + 1] - line[k]);
    }
    for value in line {
        *value *= 6.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiff::encoder::{TiffEncoder, colortype};

    fn write(path: &Path, width: u32, height: u32, heights: &[f32], scale: &[f64]) {
        let mut encoder = TiffEncoder::new(File::create(path).unwrap()).unwrap();
        let mut image = encoder
            .new_image::<colortype::Gray32Float>(width, height)
            .unwrap();
        let tags = image.encoder();
        tags.write_tag(Tag::ModelPixelScaleTag, scale).unwrap();
        tags.write_tag(
            Tag::ModelTiepointTag,
            &[0.0, 0.0, 0.0, 5000.0, 9000.0, 0.0][..],
        )
        .unwrap();
        tags.write_tag(Tag::GdalNodata, "-9999").unwrap();
        image.write_data(heights).unwrap();
    }

    #[test]
    fn the_surface_goes_through_every_height_and_gaps_are_filled() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dem.tif");
        for (width, height) in [(70, 50), (30, 9)] {
            let wavy = |k: usize| {
                let (i, r) = ((k % width) as f32, (k / width) as f32);
                2500.0 + 0.5 * (0.3 * i).sin() + 0.01 * ((7 * k) % 11) as f32 + 0.1 * r
            };
            let mut heights: Vec<f32> = (0..width * height).map(wavy).collect();
            heights[3 * width + 5] = -9999.0;
            heights[3 * width + 6] = f32::NAN;
            write(
                &path,
                width as u32,
                height as u32,
                &heights,
                &[0.5, 0.5, 0.0],
            );
            let surface = Dem::read(&path).unwrap().surface();
            for (k, h) in heights.iter().enumerate() {
                // Corner of the first cell at (5000, 9000), rows to the south.
                let x = 5000.0 + 0.5 * ((k % width) as f64 + 0.5);
                let y = 9000.0 - 0.5 * ((k / width) as f64 + 0.5);
                let error = surface.height(x, y) - f64::from(*h);
                if *h > 0.0 {
                    assert!(error.abs() < 1e-5, "{k}: {error}");
                } else {
                    assert!((surface.height(x, y) - 2500.0).abs() < 2.0);
                }
            }
            assert!(surface.height(4999.0, 8990.0).is_nan());
        }
    }

    #[test]
    fn files_that_are_no_ground_are_named_with_the_cure() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dem.tif");
        let message = |path: &Path| {
            Dem::read(path)
                .err()
                .map_or(String::new(), |e| e.to_string())
        };
        assert!(message(&path).contains("dem.tif"));
        std::fs::write(&path, "II*\0nonsense").unwrap();
        assert!(message(&path).contains("GeoTIFF"), "{}", message(&path));
        write(&path, 20, 20, &[1.0; 400], &[0.5, 0.7, 0.0]);
        assert!(message(&path).contains("square"), "{}", message(&path));
        write(&path, 20, 20, &[-9999.0; 400], &[0.5, 0.5, 0.0]);
        assert!(message(&path).contains("no height"), "{}", message(&path));
        write(&path, 2, 200, &[1.0; 400], &[0.5, 0.5, 0.0]);
        assert!(message(&path).contains("2 x 200"), "{}", message(&path));
    }
}
