//! What stands where a line of sight went through is gone (spec 8, after elevation_mapping).

use super::{ElevationCell, ElevationMap};

impl ElevationMap {
    /// Removes cells that stand in the way of what was seen behind them since the last call: a cell goes
    /// when a line of sight to a later measurement passed three deviations below its top, and it was
    /// not measured within the scanning duration before `now`. Returns how many went.
    pub fn clear_ghosts(&mut self, now: f64) -> usize {
        let cell = self.config.cell;
        let mut highest = vec![f64::INFINITY; self.cells.len()];
        for place in self.window.places() {
            let Some(slot) = self.window.slot(place) else {
                continue;
            };
            let end = &self.cells[slot];
            if end.lowest.is_nan() {
                continue;
            }
            let sensor = self.sensors[end.seen_from as usize];
            let target = place.map(|k| (k as f64 + 0.5) * cell);
            let (dx, dy) = (target[0] - sensor.x, target[1] - sensor.y);
            let rise = f64::from(end.lowest) - sensor.z;
            // One step a cell along the longer axis; the last cell is the one that was seen.
            let steps = (dx.abs().max(dy.abs()) / cell).ceil();
            if !(1.0..1e6).contains(&steps) {
                continue;
            }
            for k in 0..steps as usize {
                let share = k as f64 / steps;
                let at = [sensor.x + share * dx, sensor.y + share * dy];
                let passed = at.map(|x| (x / cell).floor() as i64);
                if passed == place {
                    break;
                }
                if let Some(slot) = self.window.slot(passed) {
                    // The lower end of the line within the cell, and no lower.
                    let height = sensor.z + rise * share;
                    let height = height.max(height + rise / steps);
                    highest[slot] = highest[slot].min(height);
                }
            }
        }
        let mut removed = 0;
        for (known, highest) in self.cells.iter_mut().zip(highest) {
            let bottom = known.height - 3.0 * known.variance().sqrt();
            let old = now - known.time > self.config.scanning_duration;
            if old && bottom > highest {
                *known = ElevationCell::EMPTY;
                removed += 1;
            }
            known.lowest = f32::NAN;
        }
        self.sensors.clear();
        removed
    }
}
