//! Where the determinant of the Hessian peaks (Alcantarilla 2013, 3.3).

use barchan_datasets::Plane;
use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;

use super::filters::row;
use super::scale_space::Level;

/// A peak of the response of a level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Peak {
    /// Index of its level.
    pub level: usize,
    /// Column and row to a fraction of a pixel, pixels of the level.
    pub at: Vector2<f32>,
    /// Determinant of the Hessian there.
    pub response: f32,
}

/// Peaks above `threshold` whose descriptor, which reaches `reach` times the spacing of their level,
/// lies inside the image; the strongest first. A peak that a stronger one overlaps, in its level or in a
/// neighbouring one, is none.
pub(super) fn find_peaks(levels: &[Level], threshold: f32, reach: f32) -> Vec<Peak> {
    let mut peaks: Vec<Peak> = levels
        .par_iter()
        .enumerate()
        .flat_map_iter(|(index, level)| local_maxima(index, level, threshold, reach))
        .collect();
    // Levels and rows decide between equals, so that the order is always the same.
    peaks.sort_by(|a, b| b.response.total_cmp(&a.response));
    let mut stronger = Places::new(levels);
    peaks.retain(|peak| {
        let overlapped = stronger.overlap(peak);
        stronger.add(peak);
        !overlapped
    });
    peaks.retain_mut(|peak| match refine(&levels[peak.level].response, peak.at) {
        Some(at) => {
            peak.at = at;
            true
        }
        None => false,
    });
    peaks
}

/// Pixels that surpass all eight neighbours.
fn local_maxima(index: usize, level: &Level, threshold: f32, reach: f32) -> Vec<Peak> {
    let border = (reach * level.spacing as f32).round() as usize + 1;
    let [width, height] = [level.response.width(), level.response.height()].map(|n| n as usize);
    let mut maxima = Vec::new();
    for y in border..height.saturating_sub(border) {
        let rows = [y - 1, y, y + 1].map(|y| row(&level.response, y));
        for x in border..width.saturating_sub(border) {
            let value = rows[1][x];
            if value > threshold
                && value > rows[1][x - 1]
                && value > rows[1][x + 1]
                && rows[0][x - 1..=x + 1].iter().all(|v| value > *v)
                && rows[2][x - 1..=x + 1].iter().all(|v| value > *v)
            {
                maxima.push(Peak {
                    level: index,
                    at: Vector2::new(x as f32, y as f32),
                    response: value,
                });
            }
        }
    }
    maxima
}

/// Peaks of each level by place.
struct Places {
    levels: Vec<Cells>,
}

/// Peaks of a level by square cells of the image.
struct Cells {
    /// Size of a pixel of the level, and of its features, pixels of the image.
    ratio: f32,
    size: f32,
    columns: usize,
    rows: usize,
    cells: Vec<Vec<Vector2<f32>>>,
}

impl Places {
    fn new(levels: &[Level]) -> Self {
        let cells = |level: &Level| {
            let size = level.ratio * level.spacing as f32;
            let count = |n: u32| (n as f32 * level.ratio / size) as usize + 1;
            let (columns, rows) = (count(level.image.width()), count(level.image.height()));
            Cells {
                ratio: level.ratio,
                size,
                columns,
                rows,
                cells: vec![Vec::new(); columns * rows],
            }
        };
        Self {
            levels: levels.iter().map(cells).collect(),
        }
    }

    /// Whether a peak of the same or of a neighbouring level lies within the size of the larger one.
    fn overlap(&self, peak: &Peak) -> bool {
        let own = &self.levels[peak.level];
        let neighbours = peak.level.saturating_sub(1)..(peak.level + 2).min(self.levels.len());
        self.levels[neighbours]
            .iter()
            .any(|l| l.holds_near(peak.at * own.ratio, own.size))
    }

    fn add(&mut self, peak: &Peak) {
        let own = &mut self.levels[peak.level];
        let at = peak.at * own.ratio;
        let cell = own.cell(at.y, own.rows) * own.columns + own.cell(at.x, own.columns);
        own.cells[cell].push(at);
    }
}

impl Cells {
    fn cell(&self, coordinate: f32, count: usize) -> usize {
        ((coordinate / self.size) as usize).min(count - 1)
    }

    fn holds_near(&self, at: Vector2<f32>, size: f32) -> bool {
        let radius = size.max(self.size);
        let range = |c: f32, count| self.cell(c - radius, count)..=self.cell(c + radius, count);
        range(at.y, self.rows).any(|y| {
            range(at.x, self.columns).any(|x| {
                let cell = &self.cells[y * self.columns + x];
                cell.iter()
                    .any(|p| (p - at).norm_squared() <= radius * radius)
            })
        })
    }
}

/// The top of the parabola through a pixel and its neighbours; `None` where it lies elsewhere.
fn refine(response: &Plane, at: Vector2<f32>) -> Option<Vector2<f32>> {
    let (x, y) = (at.x as usize, at.y as usize);
    let [above, here, below] = [y - 1, y, y + 1].map(|y| &row(response, y)[x - 1..=x + 1]);
    let gradient = 0.5 * Vector2::new(here[2] - here[0], below[1] - above[1]);
    let dxy = 0.25 * (below[2] + above[0] - above[2] - below[0]);
    let hessian = Matrix2::new(
        here[2] + here[0] - 2.0 * here[1],
        dxy,
        dxy,
        below[1] + above[1] - 2.0 * here[1],
    );
    let offset = -(hessian.try_inverse()? * gradient);
    (offset.amax() <= 1.0).then(|| at + offset)
}
