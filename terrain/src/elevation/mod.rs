//! Elevation with its uncertainty: a grid of upright cells, each with a height and how far off it may be
//! (Bai and Guo, Sensors 2019, after Fankhauser, Bloesch and Hutter, RA-L 2018).
//!
//! A cell keeps two variances. `random` is what more looks average away, and the scalar Kalman filter of
//! eq. 7 to 15 does that. `systematic` is what all looks have in common (calibration, a pose that is
//! off): it is averaged by the same weights, as fully correlated errors are, and so never shrinks by
//! mere repetition. The map states their sum. The papers know only the first, which falls as 1/N.
//!
//! Assumed: no overhangs; a frame whose z is up; a rigid, calibrated sensor; terrain that stands still
//! but for what the gate and [`ElevationMap::clear_ghosts`] catch; roll and pitch drift enters with
//! measurements and not with motion.
#![allow(non_snake_case)] // A pose's name tells its frames: T_map_sensor.

mod bounds;
mod motion;
mod sensor;
#[cfg(test)]
mod tests;
mod visibility;

use std::path::Path;

use barchan_geometry::Se3;
use nalgebra::{Matrix2, Matrix3, Matrix4, Matrix6, Point3, RowVector3, Vector3};
use serde::{Deserialize, Serialize};

pub use bounds::{Bounds, BoundsKind};
pub use motion::{
    InertialInput, InertialMotion, InertialNoise, MotionUpdate, PaperMotion, reduced_covariance,
    relative_covariance, yaw,
};
pub use sensor::{PointCovariance, SensorModel};

use crate::error::positive;
use crate::voxel::{linear_to_srgb, srgb_to_linear};
use crate::{Cloud, CloudPoint, Grid, TerrainError, write_geotiff};

/// What the points of one scan are worth to a cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Hits {
    /// One measurement, their mean: right for stereo, where neighbouring pixels err together.
    #[default]
    PerScan,
    /// A measurement each, as the papers have it: right only where points err independently.
    PerPoint,
}

/// What a measurement that does not fit is held against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gate {
    /// The deviation of the difference, that of cell and measurement together.
    #[default]
    Innovation,
    /// The deviation of the cell alone, as elevation_mapping has it.
    Cell,
}

/// What happens where a later scan contradicts a cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Contradiction {
    /// Both are believed less, by one factor, until they agree (the ratio of Birge 1932): the surer one
    /// still decides the height, and the bounds tell of the quarrel.
    #[default]
    Widen,
    /// The cell stays and gains a little variance (`multi_height_noise`), as elevation_mapping has it:
    /// whoever came first is right.
    Keep,
}

/// How measurements become an elevation map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ElevationConfig {
    /// Edge of a cell, metres.
    pub cell: f64,
    /// What the points of a scan are worth. Default `per-scan`.
    pub hits: Hits,
    /// Smallest variance of a height, square metres. Default 9e-6, (3 mm)^2.
    pub min_variance: f64,
    /// Largest variance, as the sensor makes it, of a measurement that is fused, square metres; what the
    /// pose may be off widens the bounds and leaves nothing out. Default 0.01, (0.1 m)^2.
    pub max_variance: f64,
    /// Smallest deviation of a cell's place, metres. Default half a cell.
    pub min_horizontal: Option<f64>,
    /// What a measurement that does not fit is held against. Default `innovation`.
    pub gate: Gate,
    /// How many deviations still fit. Default 2.5.
    pub gate_threshold: f64,
    /// Fewest points of a scan that make a measurement of a cell, with `per-scan`. Default 5.
    pub min_points: u32,
    /// Fewest of a cell's four neighbours that the same scan must measure too, with `per-scan`. Default
    /// 4: at the rim of what a scan sees, where the near hides the far, matching hangs points into
    /// the air, and how the ground goes on is not known.
    pub min_neighbours: usize,
    /// Fewest measurements of a cell that [`ElevationMap::bounds`] and files call known. Default 1. What one look
    /// gets wholly wrong nothing contradicts, and no bound holds it.
    pub min_looks: u32,
    /// What happens where a later scan contradicts a cell. Default `widen`.
    pub contradiction: Contradiction,
    /// Variance that a cell gains when it is contradicted and kept, square metres. Default 9e-7.
    pub multi_height_noise: f64,
    /// Share of the old height kept where a higher point of the same scan wins. Default 0.
    pub increase_height_alpha: f64,
    /// Measurements no further apart in time are of one scan, seconds. Default 0.
    pub scanning_duration: f64,
    /// Whether slopes count: heights vary within a cell by `g d / sqrt(12)` or more, and an error
    /// sideways is one of height by the slope `g`. Default true; the papers leave it out.
    pub slopes: bool,
    /// Most cells. Default 10 million, 0.8 GB.
    pub max_cells: usize,
}

impl Default for ElevationConfig {
    fn default() -> Self {
        Self {
            cell: 0.05,
            hits: Hits::default(),
            min_variance: 9e-6,
            max_variance: 0.01,
            min_horizontal: None,
            gate: Gate::default(),
            gate_threshold: 2.5,
            min_points: 5,
            min_neighbours: 4,
            min_looks: 1,
            contradiction: Contradiction::default(),
            multi_height_noise: 9e-7,
            increase_height_alpha: 0.0,
            scanning_duration: 0.0,
            slopes: true,
            max_cells: 10_000_000,
        }
    }
}

/// What the map knows of a place. All numbers are NaN where nothing was measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ElevationCell {
    /// Height, metres.
    pub height: f64,
    /// Variance of the height that more looks make smaller, square metres.
    pub random: f64,
    /// Variance of the height that all looks share, square metres.
    pub systematic: f64,
    /// Covariance of where the cell is: xx, yy, xy, square metres.
    pub horizontal: [f64; 3],
    /// Mean colour, linear light.
    pub linear_rgb: [f32; 3],
    /// Points that fell into the cell.
    pub count: u32,
    /// Measurements that were taken in: with `per-scan`, scans.
    pub looks: u32,
    /// When it was last measured, seconds.
    pub time: f64,
    /// Of the measurements since the last clean-up, the lowest height and three deviations, metres.
    lowest: f32,
    /// Which sensor position that was seen from.
    seen_from: u32,
}

impl ElevationCell {
    const EMPTY: Self = Self {
        height: f64::NAN,
        random: f64::NAN,
        systematic: f64::NAN,
        horizontal: [f64::NAN; 3],
        linear_rgb: [f32::NAN; 3],
        count: 0,
        looks: 0,
        time: f64::NAN,
        lowest: f32::NAN,
        seen_from: 0,
    };

    /// Whether anything was measured.
    pub fn is_known(&self) -> bool {
        !self.height.is_nan()
    }

    /// Variance of the height, square metres: both kinds.
    pub fn variance(&self) -> f64 {
        self.random + self.systematic
    }

    /// Mean colour, sRGB; black where nothing is known.
    pub fn colour(&self) -> [u8; 3] {
        self.linear_rgb.map(|c| linear_to_srgb(f64::from(c)))
    }
}

/// One look of a sensor.
#[derive(Clone, Copy, Debug)]
pub struct Scan<'a> {
    /// The points, in the sensor frame (z is depth).
    pub cloud: &'a Cloud,
    /// Maps points of the sensor frame to the map.
    pub T_map_sensor: Se3,
    /// Covariance of that pose: of its position and of its rotation vector, both about the axes of
    /// the map. `None` is a pose taken for exact.
    pub pose_covariance: Option<Matrix6<f64>>,
    /// How far points may be off.
    pub sensor: SensorModel,
    /// Seconds.
    pub time: f64,
}

/// The grid of cells. It lies on multiples of the cell's edge, its axes those of the map frame; it may
/// be moved with a robot (cells that stay are not touched) or grow.
#[derive(Clone, Debug)]
pub struct ElevationMap {
    config: ElevationConfig,
    window: Window,
    cells: Vec<ElevationCell>,
    /// While a scan is added: which of its bins belongs to a cell.
    bin_of: Vec<u32>,
    /// Where scans were taken from since the last clean-up.
    sensors: Vec<Point3<f64>>,
}

/// No bin.
const NONE: u32 = u32::MAX;

/// Which cells the map holds, counted from the origin of the map frame, east and north.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Window {
    /// The south-western cell.
    corner: [i64; 2],
    /// Cells west to east and south to north.
    size: [usize; 2],
    /// Where that cell is stored: its place modulo the size.
    start: [usize; 2],
}

impl Window {
    fn new(corner: [i64; 2], size: [usize; 2]) -> Self {
        let start = [0, 1].map(|k| match size[k] {
            0 => 0,
            size => corner[k].rem_euclid(size as i64) as usize,
        });
        Self {
            corner,
            size,
            start,
        }
    }

    /// Where a cell is stored; `None` outside. Cell (i, j) lies at (i mod width, j mod height): a move
    /// frees what leaves and keeps the rest in its place.
    fn slot(&self, place: [i64; 2]) -> Option<usize> {
        let wrapped = |k: usize| {
            // Below the corner is far beyond the size as well.
            let from_corner = place[k].wrapping_sub(self.corner[k]) as u64;
            (from_corner < self.size[k] as u64).then(|| {
                // Divisions take longer than all the rest, and this is asked for every point.
                let at = self.start[k] + from_corner as usize;
                if at < self.size[k] {
                    at
                } else {
                    at - self.size[k]
                }
            })
        };
        Some(wrapped(1)? * self.size[0] + wrapped(0)?)
    }

    /// All cells, row by row from the south-west.
    fn places(self) -> impl Iterator<Item = [i64; 2]> {
        let [width, height] = self.size.map(|n| n as i64);
        let [west, south] = self.corner;
        (0..height).flat_map(move |j| (0..width).map(move |i| [west + i, south + j]))
    }
}

/// A measurement of one cell's height.
struct Measurement {
    height: f64,
    /// Of the variance, what is not the pose's.
    by_sensor: f64,
    random: f64,
    systematic: f64,
    linear_rgb: [f32; 3],
    points: u32,
}

/// The points of a scan that fall into one cell, summed.
#[derive(Clone, Copy)]
struct Bin {
    points: u32,
    /// Of positions in the sensor frame.
    position: Vector3<f64>,
    /// Of heights in the map frame.
    height: f64,
    /// Of squared heights above the sensor, which keeps digits.
    height2: f64,
    /// Of squared deviations along the line of sight.
    sigma2: f64,
    linear_rgb: [f32; 3],
}

impl Bin {
    const EMPTY: Self = Self {
        points: 0,
        position: Vector3::new(0.0, 0.0, 0.0),
        height: 0.0,
        height2: 0.0,
        sigma2: 0.0,
        linear_rgb: [0.0; 3],
    };

    fn of(point: &CloudPoint, height: f64) -> Self {
        let mut bin = Self::EMPTY;
        bin.add(point, height, 0.0);
        bin
    }

    fn add(&mut self, point: &CloudPoint, height: f64, sensor: f64) {
        self.points += 1;
        self.position += point.position.coords;
        self.height += height;
        self.height2 += (height - sensor).powi(2);
        self.sigma2 += f64::from(point.sigma * point.sigma);
        for (sum, c) in self.linear_rgb.iter_mut().zip(point.colour) {
            *sum += srgb_to_linear(c) as f32;
        }
    }

    /// One point for all: their mean, with the mean of their variances, because they err together.
    fn mean(&self) -> CloudPoint {
        let n = f64::from(self.points);
        CloudPoint {
            position: Point3::from(self.position / n),
            colour: [0; 3],
            sigma: (self.sigma2 / n).sqrt() as f32,
        }
    }
}

impl ElevationMap {
    /// An empty map without extent: let it grow ([`ElevationMap::grow`]) or give it one
    /// ([`ElevationMap::square`]).
    ///
    /// # Errors
    /// When a setting makes no sense.
    pub fn new(config: ElevationConfig) -> Result<Self, TerrainError> {
        positive("cell", config.cell)?;
        positive("gate_threshold", config.gate_threshold)?;
        Ok(Self {
            config,
            window: Window::new([0, 0], [0, 0]),
            cells: vec![],
            bin_of: vec![],
            sensors: vec![],
        })
    }

    /// A map of a square of `edge` metres around the origin, to be moved with a robot.
    ///
    /// # Errors
    /// When a setting makes no sense or the square has too many cells.
    pub fn square(config: ElevationConfig, edge: f64) -> Result<Self, TerrainError> {
        positive("edge of the map", edge)?;
        let mut map = Self::new(config)?;
        let half = 0.5 * edge;
        map.grow([-half, -half], [half, half])?;
        Ok(map)
    }

    /// The settings.
    pub fn config(&self) -> &ElevationConfig {
        &self.config
    }

    /// Makes the map hold the rectangle from `low` to `high` as well, metres. What it knows stays.
    ///
    /// # Errors
    /// When it would have more cells than allowed; the map then stays as it was.
    pub fn grow(&mut self, low: [f64; 2], high: [f64; 2]) -> Result<(), TerrainError> {
        let cell = self.config.cell;
        let [mut low, mut high] = [low, high].map(|p| p.map(|x| (x / cell).floor()));
        if !self.cells.is_empty() {
            for k in 0..2 {
                let first = self.window.corner[k] as f64;
                low[k] = low[k].min(first);
                high[k] = high[k].max(first + self.window.size[k] as f64 - 1.0);
            }
        }
        let [width, height] = [0, 1].map(|k| high[k] - low[k] + 1.0);
        let cells = width * height;
        let far = low.iter().chain(&high).any(|b| b.abs() >= 1e15);
        // Not written with <, so that NaN is refused too.
        if far || !(cells >= 1.0 && cells <= self.config.max_cells as f64) {
            return Err(TerrainError::TooLarge {
                width,
                height,
                cell,
                limit: self.config.max_cells,
            });
        }
        let window = Window::new(low.map(|b| b as i64), [width as usize, height as usize]);
        if window != self.window {
            let mut cells = vec![ElevationCell::EMPTY; cells as usize];
            for place in self.window.places() {
                if let (Some(to), Some(from)) = (window.slot(place), self.window.slot(place)) {
                    cells[to] = self.cells[from];
                }
            }
            self.bin_of = vec![NONE; cells.len()];
            (self.window, self.cells) = (window, cells);
        }
        Ok(())
    }

    /// Moves the map so that the cell of `centre` is its middle one. Cells that stay inside are not
    /// touched; those that enter know nothing. A centre that is not finite moves nothing.
    pub fn move_to(&mut self, centre: [f64; 2]) {
        if !centre.iter().all(|c| c.is_finite()) {
            return;
        }
        let old = self.window;
        let corner = [0, 1].map(|k| {
            let middle = (centre[k] / self.config.cell).floor().clamp(-1e15, 1e15) as i64;
            middle - old.size[k] as i64 / 2
        });
        self.window = Window::new(corner, old.size);
        if self.window == old {
            return;
        }
        for place in self.window.places() {
            if old.slot(place).is_none()
                && let Some(slot) = self.window.slot(place)
            {
                self.cells[slot] = ElevationCell::EMPTY;
            }
        }
    }

    /// Adds a scan (eq. 3 to 15): its points fall into cells; those of a cell make a measurement with
    /// the variance of the whole chain; a scalar Kalman filter fuses it, unless the gate objects.
    /// Points outside the map are passed over: see [`ElevationMap::add_growing`].
    pub fn add(&mut self, scan: &Scan) {
        self.add_at(scan, &positions(scan));
    }

    /// [`ElevationMap::add`] to a map that grows to hold all points of the scan.
    ///
    /// # Errors
    /// As [`ElevationMap::grow`].
    pub fn add_growing(&mut self, scan: &Scan) -> Result<(), TerrainError> {
        let positions = positions(scan);
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in &positions {
            for k in 0..2 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        if low[0] <= high[0] {
            self.grow(low, high)?;
        }
        self.add_at(scan, &positions);
        Ok(())
    }

    /// `positions` are those of the scan's points in the map frame.
    fn add_at(&mut self, scan: &Scan, positions: &[Point3<f64>]) {
        // Gather the points of each cell.
        let mut bins: Vec<([i64; 2], Bin)> = vec![];
        for (point, p) in scan.cloud.points.iter().zip(positions) {
            let Some((place, slot)) = self.locate(p) else {
                continue;
            };
            if self.bin_of[slot] == NONE {
                self.bin_of[slot] = bins.len() as u32;
                bins.push((place, Bin::EMPTY));
            }
            bins[self.bin_of[slot] as usize]
                .1
                .add(point, p.z, scan.T_map_sensor.translation.z);
        }
        let slopes: Vec<[f64; 2]> = bins.iter().map(|b| self.slope(b.0, &bins)).collect();

        // Turn them into measurements and fuse these.
        self.sensors
            .push(scan.T_map_sensor.translation.vector.into());
        match self.config.hits {
            Hits::PerScan => {
                for ((place, bin), slope) in bins.iter().zip(&slopes) {
                    if self.is_well_seen(*place, &bins) {
                        let measurement = measure(scan, &self.config, bin, slope);
                        self.fuse(*place, &measurement, scan.time);
                    }
                }
            }
            Hits::PerPoint => {
                for (point, p) in scan.cloud.points.iter().zip(positions) {
                    if let Some((place, slot)) = self.locate(p) {
                        let slope = &slopes[self.bin_of[slot] as usize];
                        let bin = Bin::of(point, p.z);
                        let measurement = measure(scan, &self.config, &bin, slope);
                        self.fuse(place, &measurement, scan.time);
                    }
                }
            }
        }
        for (place, _) in &bins {
            if let Some(slot) = self.window.slot(*place) {
                self.bin_of[slot] = NONE;
            }
        }
    }

    /// The cell in which a point lies, by its place and where it is stored; `None` outside the map.
    fn locate(&self, p: &Point3<f64>) -> Option<([i64; 2], usize)> {
        let [i, j] = [p.x, p.y].map(|x| (x / self.config.cell).floor());
        // A cast takes NaN to 0, so that must be seen first.
        let place = (i.abs() < 1e15 && j.abs() < 1e15 && p.z.is_finite())
            .then_some([i as i64, j as i64])?;
        Some((place, self.window.slot(place)?))
    }

    /// Whether a scan has enough points in a cell and in its neighbours.
    fn is_well_seen(&self, [i, j]: [i64; 2], bins: &[([i64; 2], Bin)]) -> bool {
        let enough = |place: [i64; 2]| {
            let bin = self.window.slot(place).map(|slot| self.bin_of[slot]);
            bin.and_then(|bin| bins.get(bin as usize))
                .is_some_and(|(_, bin)| bin.points >= self.config.min_points)
        };
        let neighbours = [[i - 1, j], [i + 1, j], [i, j - 1], [i, j + 1]];
        enough([i, j])
            && neighbours.into_iter().filter(|n| enough(*n)).count() >= self.config.min_neighbours
    }

    /// How the ground rises east and north at a bin, by the mean heights of its neighbours in the same
    /// scan; 0 where there are none, or where slopes do not count.
    fn slope(&self, [i, j]: [i64; 2], bins: &[([i64; 2], Bin)]) -> [f64; 2] {
        if !self.config.slopes {
            return [0.0; 2];
        }
        let height = |place: [i64; 2]| {
            let bin = self.bin_of[self.window.slot(place)?];
            let (_, bin) = bins.get(bin as usize)?;
            Some(bin.height / f64::from(bin.points))
        };
        let here = height([i, j]);
        [([i - 1, j], [i + 1, j]), ([i, j - 1], [i, j + 1])].map(|(before, after)| {
            let rise = match (height(before), here, height(after)) {
                (Some(a), _, Some(b)) => 0.5 * (b - a),
                (Some(a), Some(b), None) | (None, Some(a), Some(b)) => b - a,
                _ => 0.0,
            };
            rise / self.config.cell
        })
    }

    /// The Kalman filter of one cell (eq. 7 to 15) behind its gate.
    fn fuse(&mut self, place: [i64; 2], m: &Measurement, time: f64) {
        let Some(slot) = self.window.slot(place) else {
            return;
        };
        let config = &self.config;
        let variance = m.random + m.systematic;
        // Not written with >, so that NaN is refused too.
        if !(m.height.is_finite() && variance.is_finite() && m.by_sensor <= config.max_variance) {
            return;
        }
        let cell = &mut self.cells[slot];
        let upper = (m.height + 3.0 * variance.sqrt()) as f32;
        // NaN stands for none yet.
        if cell.lowest.is_nan() || upper < cell.lowest {
            cell.lowest = upper;
            cell.seen_from = self.sensors.len() as u32 - 1;
        }
        let floor = config.min_variance;
        if !cell.is_known() {
            *cell = ElevationCell {
                height: m.height,
                random: m.random.max(floor),
                systematic: m.systematic,
                linear_rgb: m.linear_rgb,
                count: m.points,
                looks: 1,
                ..*cell
            };
        } else {
            let innovation = match config.gate {
                Gate::Innovation => cell.variance() + variance,
                Gate::Cell => cell.variance(),
            };
            let deviations = (m.height - cell.height).abs() / innovation.sqrt();
            let same_scan = time - cell.time <= config.scanning_duration;
            let mut doubt = 1.0;
            if deviations > config.gate_threshold {
                match config.contradiction {
                    Contradiction::Widen => doubt = (deviations / config.gate_threshold).powi(2),
                    Contradiction::Keep => {
                        if !same_scan {
                            cell.random += config.multi_height_noise;
                        } else if m.height > cell.height {
                            let keep = config.increase_height_alpha;
                            let mix = |old: f64, new: f64| keep * old + (1.0 - keep) * new;
                            cell.height = mix(cell.height, m.height);
                            cell.random = mix(cell.random, m.random.max(floor));
                            cell.systematic = mix(cell.systematic, m.systematic);
                        }
                        return;
                    }
                }
            }
            let gain = cell.variance() / (cell.variance() + variance);
            // Two perfect measurements: neither knows better.
            let gain = if gain.is_nan() { 0.5 } else { gain };
            cell.height += gain * (m.height - cell.height);
            let random = (1.0 - gain).powi(2) * cell.random + gain * gain * m.random;
            let systematic = (1.0 - gain) * cell.systematic.sqrt() + gain * m.systematic.sqrt();
            cell.systematic = systematic * systematic;
            // A quarrel is no calibration's: what it adds may be settled by more looks.
            let quarrel = (doubt - 1.0) * (random + cell.systematic);
            cell.random = random.max(floor) + quarrel;
            cell.count = cell.count.saturating_add(m.points);
            cell.looks = cell.looks.saturating_add(1);
            let share = m.points as f32 / cell.count as f32;
            for (mean, c) in cell.linear_rgb.iter_mut().zip(m.linear_rgb) {
                *mean += share * (c - *mean);
            }
        }
        let place = config.min_horizontal.unwrap_or(0.5 * config.cell).powi(2);
        cell.horizontal = [place, place, 0.0];
        cell.time = time;
    }

    /// Eq. 28: a robot moved from `T_map_from`, and how far is known only to `relative`, the covariance
    /// of (x, y, z, yaw) in its frame without tilt ([`MotionUpdate::relative_covariance`]). A map
    /// that is tied to the robot loses certainty in every cell it knows; no data moves.
    ///
    /// Heights lose by the vertical part alone: an error of yaw moves cells sideways, by its lever.
    pub fn motion_update(&mut self, T_map_from: &Se3, relative: &Matrix4<f64>) {
        let c = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), yaw(T_map_from));
        let c = c.into_inner();
        let position: Matrix3<f64> = c * relative.fixed_view::<3, 3>(0, 0) * c.transpose();
        // How errors of position and of yaw go together, east, north and up.
        let crossed: Vector3<f64> = c * relative.fixed_view::<3, 1>(0, 3);
        let robot = T_map_from.translation.vector;
        for place in self.window.places() {
            let Some(slot) = self.window.slot(place) else {
                continue;
            };
            let cell = &mut self.cells[slot];
            if !cell.is_known() {
                continue;
            }
            let [x, y] = place.map(|k| (k as f64 + 0.5) * self.config.cell);
            // e_z x r: where a cell goes when the yaw is off by a radian.
            let lever = nalgebra::Vector2::new(-(y - robot.y), x - robot.x);
            let crossed = crossed.fixed_rows::<2>(0) * lever.transpose();
            let added: Matrix2<f64> = position.fixed_view::<2, 2>(0, 0)
                + lever * lever.transpose() * relative[(3, 3)]
                + crossed
                + crossed.transpose();
            cell.random += position[(2, 2)];
            cell.horizontal[0] += added[(0, 0)];
            cell.horizontal[1] += added[(1, 1)];
            cell.horizontal[2] += added[(0, 1)];
        }
    }

    /// The cell in which a place lies; `None` outside the map.
    pub fn at(&self, x: f64, y: f64) -> Option<&ElevationCell> {
        let (_, slot) = self.locate(&Point3::new(x, y, 0.0))?;
        self.cells.get(slot)
    }

    /// The map as a north-up grid and its cells, row by row.
    pub fn raster(&self) -> (Grid, Vec<&ElevationCell>) {
        let Window { corner, size, .. } = self.window;
        let cell = self.config.cell;
        let grid = Grid {
            width: size[0],
            height: size[1],
            west: corner[0] as f64 * cell,
            north: (corner[1] + size[1] as i64) as f64 * cell,
            cell_x: cell,
            cell_y: cell,
        };
        let rows = (0..size[1] as i64).rev();
        let places = rows.flat_map(|j| (0..size[0] as i64).map(move |i| [i, j]));
        let slots = places.filter_map(|[i, j]| self.window.slot([corner[0] + i, corner[1] + j]));
        (grid, slots.map(|k| &self.cells[k]).collect())
    }

    /// [`ElevationMap::raster`], where cells of fewer than [`ElevationConfig::min_looks`] are empty.
    fn settled(&self) -> (Grid, Vec<&ElevationCell>) {
        let (grid, mut cells) = self.raster();
        for cell in &mut cells {
            if cell.looks < self.config.min_looks {
                *cell = &ElevationCell::EMPTY;
            }
        }
        (grid, cells)
    }
}

/// Bands of the file that [`ElevationMap::write`] makes.
const BANDS: [&str; 9] = [
    "elevation",
    "variance",
    "lower",
    "upper",
    "count",
    "red",
    "green",
    "blue",
    "time",
];

impl ElevationMap {
    /// Writes a GeoTIFF of nine bands: elevation (m), variance (m^2), lower and upper bound (m), count,
    /// red, green, blue (sRGB, 0 to 255) and time (s).
    ///
    /// # Errors
    /// When the file cannot be written, or the map has no cell.
    pub fn write(&self, path: &Path, kind: BoundsKind) -> Result<(), TerrainError> {
        let (grid, cells) = self.settled();
        let mut bands: [Vec<f32>; 9] = Default::default();
        for (cell, bounds) in cells.into_iter().zip(self.bounds(kind)) {
            let [r, g, b] = match cell.is_known() {
                true => cell.colour().map(f32::from),
                false => [f32::NAN; 3],
            };
            let values = [
                bounds.height as f32,
                cell.variance() as f32,
                bounds.lower as f32,
                bounds.upper as f32,
                cell.count as f32,
                r,
                g,
                b,
                cell.time as f32,
            ];
            for (band, value) in bands.iter_mut().zip(values) {
                band.push(value);
            }
        }
        let named: Vec<(&str, &[f32])> = BANDS
            .into_iter()
            .zip(bands.iter().map(Vec::as_slice))
            .collect();
        write_geotiff(path, &grid, None, &named)
    }
}

/// The points of a scan in the map frame.
fn positions(scan: &Scan) -> Vec<Point3<f64>> {
    let (rotation, translation) = (
        scan.T_map_sensor.rotation.to_rotation_matrix(),
        scan.T_map_sensor.translation.vector,
    );
    let points = scan.cloud.points.iter();
    points
        .map(|p| rotation * p.position + translation)
        .collect()
}

/// What the points of a bin say of a cell's height, on ground that rises by `slope`.
///
/// The chain: deviations of the points -> covariance in the sensor frame -> with that of the pose, in
/// the map frame (eq. 3 to 6; the lever arm is the sensor's own, so the pose's covariance is the
/// sensor's too) -> variance of the height at a fixed place, which on a slope an error sideways feeds.
fn measure(scan: &Scan, config: &ElevationConfig, bin: &Bin, slope: &[f64; 2]) -> Measurement {
    let mean = bin.mean();
    let covariance = scan.sensor.covariance(&mean);
    // An error e of the point is one of height of normal * e.
    let normal = RowVector3::new(-slope[0], -slope[1], 1.0);
    let rotation = scan.T_map_sensor.rotation.to_rotation_matrix();
    let in_sensor = normal * rotation.matrix();
    let variance = |m: &Matrix3<f64>| (in_sensor * m * in_sensor.transpose())[0];
    let mut random = variance(&covariance.random);
    let mut systematic = variance(&covariance.systematic);
    let pose = scan.pose_covariance.map_or(0.0, |pose| {
        let j = normal * pose_jacobian(&(rotation * mean.position.coords));
        (j * pose * j.transpose())[0]
    });
    let n = f64::from(bin.points);
    if config.slopes {
        // How heights vary within the cell: by its slope, or by what the scan saw if that is more (a
        // stone, an edge, points hung into the air).
        let rise = slope[0].hypot(slope[1]);
        let above_sensor = bin.height / n - scan.T_map_sensor.translation.z;
        let spread = bin.height2 / n - above_sensor * above_sensor;
        random += spread.max((rise * config.cell).powi(2) / 12.0);
    }
    let by_sensor = random + systematic;
    systematic += pose;
    Measurement {
        height: bin.height / n,
        by_sensor,
        random,
        systematic,
        linear_rgb: bin.linear_rgb.map(|c| c / bin.points as f32),
        points: bin.points,
    }
}

/// How a point moves with the pose it was seen from (eq. 5): `[I, -[l]x]` for a shift and a small
/// rotation about the axes of the map, where `l` leads from the sensor to the point, in the map frame.
fn pose_jacobian(lever: &Vector3<f64>) -> nalgebra::Matrix3x6<f64> {
    let mut j = nalgebra::Matrix3x6::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
    j.fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-lever.cross_matrix());
    j
}
