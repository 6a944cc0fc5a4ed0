//! The text files of the archive: no header, columns separated by blanks, a time stamp first.

use std::path::Path;

use chrono::NaiveDate;
use nalgebra::Vector3;

use crate::text::number;
use crate::{DataError, ImuSample};

/// Drive wheels, in the order of the columns: front, middle and rear, of each the left one first.
pub(super) const WHEELS: usize = 6;

/// The UTM zone of the beach.
pub(crate) const ZONE: u8 = 31;

/// A satellite fix: metres on the plane of UTM zone 31 north.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fix {
    pub time: f64,
    /// East, north, and height above the ellipsoid.
    pub p_utm: Vector3<f64>,
    /// Standard deviations to the east, the north and up.
    pub sigma: Vector3<f64>,
}

/// What the wheels had turned by and how fast they turned, radians and radians a second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Wheels {
    pub time: f64,
    pub angle: [f64; WHEELS],
    pub rate: [f64; WHEELS],
}

/// Seconds since 1970 of `YYYY_MM_DD_hh_mm_ss_mmm`. Milliseconds can read 1000: the recorder rounded
/// up, and the second that follows is meant.
pub(super) fn stamp(text: &str) -> Option<f64> {
    let parts = text.split('_').map(|p| p.parse::<u32>().ok());
    let parts: Option<Vec<u32>> = parts.collect();
    let [year, month, day, hour, minute, second, millis] = parts?[..] else {
        return None;
    };
    let day = NaiveDate::from_ymd_opt(i32::try_from(year).ok()?, month, day)?;
    let whole = day.and_hms_opt(hour, minute, second)?.and_utc().timestamp();
    (millis <= 1000).then(|| (whole * 1000 + i64::from(millis)) as f64 / 1000.0)
}

/// The rows of a table in the order of time: the line counted from 0, the time, the other cells.
fn rows<T>(
    path: &Path,
    columns: usize,
    row: impl Fn(usize, f64, &[&str]) -> Result<(f64, T), DataError>,
) -> Result<Vec<T>, DataError> {
    let text = std::fs::read_to_string(path).map_err(DataError::io(path))?;
    let mut rows = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let cells: Vec<&str> = line.split_whitespace().collect();
        let Some((first, rest)) = cells.split_first() else {
            continue;
        };
        if cells.len() != columns {
            let message = format!(
                "line {}: {} columns, expected {columns} separated by blanks; remove the line or copy the file again",
                i + 1,
                cells.len()
            );
            return Err(DataError::file(path, message));
        }
        let time = stamp(first).ok_or_else(|| {
            let message = format!(
                "line {}: \"{first:.40}\" is no time; expected YYYY_MM_DD_hh_mm_ss_mmm",
                i + 1
            );
            DataError::file(path, message)
        })?;
        rows.push(row(i, time, rest)?);
    }
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(rows.into_iter().map(|(_, row)| row).collect())
}

fn numbers<const N: usize>(
    path: &Path,
    line: usize,
    cells: &[&str],
) -> Result<[f64; N], DataError> {
    let mut values = [0.0; N];
    for (value, cell) in values.iter_mut().zip(cells) {
        *value = number(path, line, cell)?;
    }
    Ok(values)
}

/// `gps-latlong.txt` or `gps-utm31.txt`: time, status, two coordinates, altitude, deviations to the
/// north, the east and up. The archive has latitude and longitude in either file (de Jong 2020,
/// section 2.2.3), so the range of the numbers decides.
pub(super) fn read_fixes(path: &Path) -> Result<Vec<Fix>, DataError> {
    rows(path, 8, |line, time, cells| {
        let [a, b, altitude, north, east, up] = numbers(path, line, &cells[1..])?;
        let (easting, northing) = to_utm31(a, b).ok_or_else(|| {
            let message = format!(
                "line {}: {a} {b} is neither latitude and longitude near zone 31 nor northing and easting; remove the line",
                line + 1
            );
            DataError::file(path, message)
        })?;
        let fix = Fix {
            time,
            p_utm: Vector3::new(easting, northing, altitude),
            sigma: Vector3::new(east, north, up),
        };
        Ok((time, fix))
    })
}

/// East and north in UTM zone 31 north of latitude and longitude, degrees on WGS84, or of northing
/// and easting in either order: an easting has at most six digits before the point, and a northing
/// of Europe has seven.
pub(crate) fn to_utm31(a: f64, b: f64) -> Option<(f64, f64)> {
    let easting = 100_000.0..1_000_000.0;
    let northing = 1_000_000.0..10_000_000.0;
    // Farther from the meridian at 3 degrees the series of the projection does not hold.
    if (1.0..=84.0).contains(&a) && (-6.0..=12.0).contains(&b) {
        let (north, east, _) = utm::to_utm_wgs84(a, b, ZONE);
        Some((east, north))
    } else if northing.contains(&a) && easting.contains(&b) {
        Some((b, a))
    } else if easting.contains(&a) && northing.contains(&b) {
        Some((a, b))
    } else {
        None
    }
}

/// `imu.txt`: time, acceleration, angular rate, and the acceleration of the inclinometer, which is
/// passed over.
pub(super) fn read_imu(path: &Path) -> Result<Vec<ImuSample>, DataError> {
    rows(path, 10, |line, time, cells| {
        let v: [f64; 9] = numbers(path, line, cells)?;
        let sample = ImuSample {
            time,
            acceleration: Vector3::new(v[0], v[1], v[2]),
            rate: Vector3::new(v[3], v[4], v[5]),
        };
        Ok((time, sample))
    })
}

/// `odometry.txt`: time, six drive and four steering wheels with angle, angular velocity and an
/// analogue value each, the rocker and two bogies.
pub(super) fn read_wheels(path: &Path) -> Result<Vec<Wheels>, DataError> {
    rows(path, 34, |line, time, cells| {
        let v: [f64; 33] = numbers(path, line, cells)?;
        let wheels = Wheels {
            time,
            angle: std::array::from_fn(|k| v[3 * k]),
            rate: std::array::from_fn(|k| v[3 * k + 1]),
        };
        Ok((time, wheels))
    })
}

/// Where the mast of the cameras pointed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanTilt {
    /// Seconds since 1970.
    pub time: f64,
    /// Radians.
    pub pan: f64,
    /// Radians.
    pub tilt: f64,
}

/// `ptu.txt` of the Katwijk archive: time, pan and tilt, in the order of time.
///
/// # Errors
/// When the file cannot be read, or a line is not of a time and two numbers.
pub fn read_ptu(path: &Path) -> Result<Vec<PanTilt>, DataError> {
    rows(path, 3, |line, time, cells| {
        let [pan, tilt] = numbers(path, line, cells)?;
        Ok((time, PanTilt { time, pan, tilt }))
    })
}

/// A file of rock positions of the Katwijk archive, such as `large-rocks-traverse12.txt`: east and north of each
/// in UTM zone 31 north, metres. As of fixes, the range of the numbers tells what they are.
///
/// # Errors
/// When the file cannot be read, or a line is not of two coordinates near the zone.
pub fn read_rocks(path: &Path) -> Result<Vec<[f64; 2]>, DataError> {
    let text = std::fs::read_to_string(path).map_err(DataError::io(path))?;
    let mut rocks = Vec::new();
    for (line, row) in text.lines().enumerate() {
        let cells: Vec<&str> = row.split_whitespace().collect();
        if cells.is_empty() {
            continue;
        }
        let place = match cells.len() {
            2 => {
                let [a, b] = numbers(path, line, &cells)?;
                to_utm31(a, b)
            }
            _ => None,
        };
        let (east, north) = place.ok_or_else(|| {
            let message = format!(
                "line {}: expected two numbers, east and north in zone 31 or latitude and longitude; remove the line",
                line + 1
            );
            DataError::file(path, message)
        })?;
        rocks.push([east, north]);
    }
    Ok(rocks)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stamp_of_1000_milliseconds_is_the_next_second() {
        let noon = stamp("2015_11_26_12_00_00_000").unwrap();
        assert_eq!(noon, 1_448_539_200.0);
        assert_eq!(stamp("2015_11_26_11_59_59_1000"), Some(noon));
        assert_eq!(stamp("2015_11_26_12_00_00_034"), Some(noon + 0.034));
        for wrong in [
            "2015_02_30_12_00_00_000",
            "2015_11_26_12_00_00_1001",
            "2015_11_26_12_00_00",
            "2015_11_26_12_00_00_0_0",
            "-1_11_26_12_00_00_000",
            "",
        ] {
            assert_eq!(stamp(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn utm_agrees_with_known_values_and_ranges_decide() {
        // The example of the Python package utm, 51.2 7.5 in zone 32: 1.5 degrees west of the
        // zone's meridian, as 1.5 is in zone 31.
        let (east, north) = to_utm31(51.2, 1.5).unwrap();
        assert!((east - 395_201.310).abs() < 0.01, "{east}");
        assert!((north - 5_673_135.241).abs() < 0.01, "{north}");
        // Along the central meridian, north is 0.9996 times the arc of the meridian: 4 984 944.378 m
        // to 45 degrees on WGS84.
        let (east, north) = to_utm31(45.0, 3.0).unwrap();
        assert!((east - 500_000.0).abs() < 1e-3);
        assert!((north - 0.9996 * 4_984_944.378).abs() < 0.01, "{north}");
        // Either order of the plane's numbers is the same place.
        let (east, north) = to_utm31(52.217_259, 4.403_469).unwrap();
        assert_eq!(to_utm31(north, east), Some((east, north)));
        assert_eq!(to_utm31(east, north), Some((east, north)));
        for (a, b) in [
            (0.0, 4.0),
            (52.0, 100.0),
            (91.0, 4.0),
            (5e5, 5e5),
            (f64::NAN, 4.0),
        ] {
            assert_eq!(to_utm31(a, b), None);
        }
    }

    #[test]
    fn the_mast_and_the_rocks_are_read_and_faults_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, text).unwrap();
            path
        };
        let ptu = file(
            "ptu.txt",
            "2015_11_26_12_00_01_1000 0.5 -0.1\n\n2015_11_26_12_00_00_000\t0 0.25\n",
        );
        let read = read_ptu(&ptu).unwrap();
        assert_eq!(read.len(), 2);
        assert_eq!(read[1].time - read[0].time, 2.0);
        assert_eq!([read[1].pan, read[1].tilt, read[0].tilt], [0.5, -0.1, 0.25]);

        let (east, north) = to_utm31(52.2173, 4.4035).unwrap();
        let rocks = file("rocks.txt", &format!("{east} {north}\n52.2173 4.4035\n"));
        let read = read_rocks(&rocks).unwrap();
        assert_eq!(read.len(), 2);
        assert_eq!(read[0], [east, north]);
        assert!((read[1][0] - east).hypot(read[1][1] - north) < 1e-6);
        for wrong in ["1 2 3\n", "5 x\n", "500 600\n", "nan nan\n"] {
            let message = read_rocks(&file("wrong.txt", wrong))
                .unwrap_err()
                .to_string();
            assert!(message.contains("line 1"), "{wrong}: {message}");
        }
        assert!(read_ptu(&file("wrong.txt", "2015_11_26_12_00_00_000 1\n")).is_err());
    }
}
