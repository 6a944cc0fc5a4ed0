use std::path::Path;

use nalgebra::{Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion};

use crate::{GeometryError, Se3};

/// A camera pose and when it held.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(non_snake_case)]
pub struct StampedPose {
    /// Seconds.
    pub time: f64,
    /// Maps points of the left camera frame to the world.
    pub T_world_cam: Se3,
}

/// Poses in the order of time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// The poses.
    pub poses: Vec<StampedPose>,
}

impl Trajectory {
    /// Reads TUM text: `time tx ty tz qx qy qz qw` a line, `#` starts a comment.
    ///
    /// # Errors
    /// When the file cannot be read or a line does not hold eight numbers.
    pub fn read_tum(path: &Path) -> Result<Self, GeometryError> {
        let rows = read_rows(path, 8, "time tx ty tz qx qy qz qw")?;
        let mut poses = Vec::with_capacity(rows.len());
        for (line, r) in rows {
            let q = Quaternion::new(r[7], r[4], r[5], r[6]);
            let rotation =
                UnitQuaternion::try_new(q, 1e-9).ok_or_else(|| GeometryError::Trajectory {
                    path: path.to_owned(),
                    line,
                    message: "the quaternion is zero".into(),
                })?;
            let pose = Se3::from_parts(Translation3::new(r[1], r[2], r[3]), rotation);
            poses.push(StampedPose {
                time: r[0],
                T_world_cam: pose,
            });
        }
        Ok(Self { poses })
    }

    /// Reads KITTI text: twelve numbers a line, the rows of the 3x4 matrix `T_world_cam`.
    /// Times are the line numbers from 0, unless `times` gives them.
    ///
    /// # Errors
    /// When the file cannot be read, a line does not hold twelve numbers, or `times` is too short.
    pub fn read_kitti(path: &Path, times: Option<&[f64]>) -> Result<Self, GeometryError> {
        let rows = read_rows(path, 12, "the 12 numbers of a 3x4 pose")?;
        let mut poses = Vec::with_capacity(rows.len());
        for (i, (line, r)) in rows.into_iter().enumerate() {
            let matrix = Matrix3::from_fn(|a, b| r[4 * a + b]);
            // Far from a rotation the search for the nearest need not end.
            let off = (matrix * matrix.transpose() - Matrix3::identity()).norm();
            if off.is_nan() || off > 0.1 || matrix.determinant() < 0.0 {
                return Err(GeometryError::Trajectory {
                    path: path.to_owned(),
                    line,
                    message: "the left three columns are no rotation".into(),
                });
            }
            // Published poses are printed with few digits: take the nearest rotation.
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&matrix));
            let pose = Se3::from_parts(Translation3::new(r[3], r[7], r[11]), rotation);
            let time = match times {
                None => i as f64,
                Some(t) => *t.get(i).ok_or_else(|| GeometryError::Trajectory {
                    path: path.to_owned(),
                    line,
                    message: format!("no time for this pose: only {} times are known", t.len()),
                })?,
            };
            poses.push(StampedPose {
                time,
                T_world_cam: pose,
            });
        }
        Ok(Self { poses })
    }

    /// The pose at a time, between its two neighbours: position linearly, rotation along the
    /// shortest arc. `None` before the first pose, after the last, and between opposite rotations.
    pub fn at(&self, time: f64) -> Option<Se3> {
        let after = self.poses.partition_point(|p| p.time < time);
        let next = self.poses.get(after)?;
        if next.time == time {
            return Some(next.T_world_cam);
        }
        let last = self.poses.get(after.checked_sub(1)?)?;
        let share = (time - last.time) / (next.time - last.time);
        last.T_world_cam
            .try_lerp_slerp(&next.T_world_cam, share, 1e-9)
    }

    /// TUM text.
    pub fn to_tum(&self) -> String {
        let line = |p: &StampedPose| {
            let t = p.T_world_cam.translation.vector;
            let q = p.T_world_cam.rotation.coords;
            format!(
                "{:.6} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}\n",
                p.time, t.x, t.y, t.z, q.x, q.y, q.z, q.w
            )
        };
        self.poses.iter().map(line).collect()
    }

    /// KITTI text. Times are lost.
    pub fn to_kitti(&self) -> String {
        let line = |p: &StampedPose| {
            let m = p.T_world_cam.to_matrix();
            let row: Vec<String> = (0..12)
                .map(|i| format!("{:.9e}", m[(i / 4, i % 4)]))
                .collect();
            row.join(" ") + "\n"
        };
        self.poses.iter().map(line).collect()
    }
}

/// Lines of `columns` numbers each, with their line number; blank and `#` lines are passed over.
fn read_rows(
    path: &Path,
    columns: usize,
    expected: &str,
) -> Result<Vec<(usize, Vec<f64>)>, GeometryError> {
    let text = std::fs::read_to_string(path).map_err(GeometryError::io(path))?;
    let mut rows = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let numbers: Option<Vec<f64>> = line
            .split_whitespace()
            .map(|w| w.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        match numbers {
            Some(row) if row.len() == columns => rows.push((i + 1, row)),
            _ => {
                return Err(GeometryError::Trajectory {
                    path: path.to_owned(),
                    line: i + 1,
                    message: format!("expected {expected}, found \"{line}\""),
                });
            }
        }
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3;
    use nalgebra::Vector6;

    fn sample() -> Trajectory {
        let poses = (0..5)
            .map(|i| {
                let s = i as f64;
                let twist = Vector6::new(s, -0.5 * s, 0.25, 0.1 * s, 0.3, -0.2 * s);
                StampedPose {
                    time: s,
                    T_world_cam: se3::exp(&twist),
                }
            })
            .collect();
        Trajectory { poses }
    }

    fn assert_same(a: &Trajectory, b: &Trajectory) {
        assert_eq!(a.poses.len(), b.poses.len());
        for (p, q) in a.poses.iter().zip(&b.poses) {
            assert_eq!(p.time, q.time);
            assert!(se3::log(&(p.T_world_cam.inverse() * q.T_world_cam)).norm() < 1e-7);
        }
    }

    #[test]
    fn both_formats_round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t");
        std::fs::write(&path, sample().to_tum()).unwrap();
        assert_same(&Trajectory::read_tum(&path).unwrap(), &sample());
        std::fs::write(&path, sample().to_kitti()).unwrap();
        assert_same(&Trajectory::read_kitti(&path, None).unwrap(), &sample());
    }

    #[test]
    fn between_poses_the_motion_is_even_and_outside_it_is_unknown() {
        let sample = sample();
        for (i, pose) in sample.poses.iter().enumerate() {
            assert_eq!(sample.at(i as f64), Some(pose.T_world_cam));
        }
        let (a, b) = (sample.poses[1].T_world_cam, sample.poses[2].T_world_cam);
        let quarter = sample.at(1.25).unwrap();
        let expected = a.translation.vector * 0.75 + b.translation.vector * 0.25;
        assert!((quarter.translation.vector - expected).norm() < 1e-12);
        assert!(
            (a.rotation.angle_to(&quarter.rotation) - 0.25 * a.rotation.angle_to(&b.rotation))
                .abs()
                < 1e-9
        );
        assert!(sample.at(-0.1).is_none() && sample.at(4.1).is_none());
    }

    #[test]
    fn a_bad_line_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bad.tum");
        std::fs::write(&path, "# comment\n0 0 0 0 0 0 0 1\n1 2 3\n").unwrap();
        let message = Trajectory::read_tum(&path).unwrap_err().to_string();
        assert!(message.contains("bad.tum:3"), "{message}");
    }

    #[test]
    fn a_matrix_that_is_no_rotation_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.kitti");
        for row in [
            "0 0 0 0 0 0 0 0 0 0 0 0",
            "1e308 0 0 0 0 1 0 0 0 0 1 0",
            "1 0 0 0 0 1 0 0 0 0 -1 0",
        ] {
            std::fs::write(&path, format!("1 0 0 0 0 1 0 0 0 0 1 0\n{row}\n")).unwrap();
            let message = Trajectory::read_kitti(&path, None).unwrap_err().to_string();
            assert!(message.contains("no rotation"), "{row}: {message}");
        }
    }
}
