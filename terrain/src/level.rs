use barchan_geometry::Se3;
use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// The frame of the terrain, and how it was found.
#[derive(Clone, Debug, PartialEq)]
#[allow(non_snake_case)]
pub struct Levelled {
    /// Maps points of the world to the levelled frame: z up, x the first camera's line of sight laid
    /// into the ground, the origin on the ground below the first camera.
    pub T_level_world: Se3,
    /// Set when no ground was found and the first camera's y axis stands for "down".
    pub notice: Option<String>,
}

/// Largest angle between the ground's normal and the first camera's "up" (-y) that is believed.
const MAX_TILT_DEGREES: f64 = 60.0;
/// The share of the points to which a candidate plane must be near to win. Less than a half, because
/// walls, rocks and the horizon may own the rest.
const GROUND_SHARE: f64 = 0.4;
/// The distance below which that share of normally distributed residuals lies, in deviations.
const SHARE_OF_NORMAL: f64 = 0.5244;

/// Finds "up" where no inertial sensor tells: the normal of the plane that best fits the ground.
///
/// `T_world_first` is the pose of the first camera. Least quantile of squares over random triples
/// (Rousseeuw 1984; the seed is fixed, so the same points give the same frame), kept within 60
/// degrees of the camera's own "up", then refined by least squares over the inliers. On a uniform
/// slope this levels the slope away: only gravity could tell.
#[allow(non_snake_case)]
pub fn level(points: &[Point3<f64>], T_world_first: &Se3) -> Levelled {
    let camera = T_world_first.translation.vector;
    let camera_up = -(T_world_first.rotation * Vector3::y());
    // A few thousand points find the plane as well as all.
    let sample: Vec<Vector3<f64>> = points
        .iter()
        .step_by(points.len() / 5000 + 1)
        .map(|p| p.coords)
        .collect();

    let ground =
        best_plane(&sample, &camera_up).and_then(|plane| refine(plane, &sample, &camera_up));
    let (up, height_of_ground, notice) = match ground {
        Some(plane) => (plane.normal, plane.offset, None),
        None => {
            let notice = "no ground plane within 60 degrees of the first camera's x-z plane was found: \
                          the first camera's y axis is taken for down, and the median point for the ground";
            (
                camera_up,
                quantile(sample.iter().map(|p| p.dot(&camera_up)), 0.5),
                Some(notice.to_string()),
            )
        }
    };
    // Nothing was seen: the ground is where the camera is.
    let height_of_ground = if height_of_ground.is_finite() {
        height_of_ground
    } else {
        camera.dot(&up)
    };

    // A camera that looks straight down has no forward; the top of its image is as good.
    let sight = T_world_first.rotation * Vector3::z();
    let forward = if sight.cross(&up).norm() > 0.1 {
        sight
    } else {
        camera_up
    };
    let x = (forward - up * forward.dot(&up)).normalize();
    let rows = Matrix3::from_rows(&[x.transpose(), up.cross(&x).transpose(), up.transpose()]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
    let origin = camera - up * (camera.dot(&up) - height_of_ground);
    let T_level_world = Se3::from_parts(Translation3::from(-(rotation * origin)), rotation);
    Levelled {
        T_level_world,
        notice,
    }
}

/// Points p with `normal . p = offset`.
#[derive(Clone, Copy)]
struct Plane {
    normal: Vector3<f64>,
    offset: f64,
}

impl Plane {
    /// The plane of a normal through a point, its normal turned to the side of `up`; `None` when
    /// there is no normal, or it is too far from `up`.
    fn facing(normal: Vector3<f64>, through: &Vector3<f64>, up: &Vector3<f64>) -> Option<Self> {
        let normal = normal.try_normalize(1e-12)?;
        let normal = if normal.dot(up) < 0.0 {
            -normal
        } else {
            normal
        };
        let believed = normal.dot(up) >= MAX_TILT_DEGREES.to_radians().cos();
        believed.then(|| Self {
            normal,
            offset: normal.dot(through),
        })
    }

    fn distance(&self, p: &Vector3<f64>) -> f64 {
        (self.normal.dot(p) - self.offset).abs()
    }

    /// The distance within which [`GROUND_SHARE`] of the points lie.
    fn misfit(&self, points: &[Vector3<f64>]) -> f64 {
        quantile(points.iter().map(|p| self.distance(p)), GROUND_SHARE)
    }
}

fn best_plane(points: &[Vector3<f64>], up: &Vector3<f64>) -> Option<Plane> {
    const TRIALS: usize = 400;
    let mut random = SplitMix64(20211);
    let mut best: Option<(f64, Plane)> = None;
    for _ in 0..TRIALS {
        let [a, b, c] = [(); 3].map(|()| points.get(random.below(points.len())));
        let (a, b, c) = (a?, b?, c?);
        let Some(plane) = Plane::facing((b - a).cross(&(c - a)), a, up) else {
            continue;
        };
        let misfit = plane.misfit(points);
        if best.is_none_or(|(least, _)| misfit < least) {
            best = Some((misfit, plane));
        }
    }
    best.map(|(_, plane)| plane)
}

/// Least squares over the points near the plane, until these no longer change much; `None` when
/// the result is no ground: tilted away, or thick as against its extent.
fn refine(mut plane: Plane, points: &[Vector3<f64>], up: &Vector3<f64>) -> Option<Plane> {
    const ROUNDS: usize = 8;
    const MAX_THICKNESS: f64 = 0.1;
    for _ in 0..ROUNDS {
        // 2.5 robust deviations; the floor keeps the exact planes of renderings.
        let near = 2.5 * plane.misfit(points) / SHARE_OF_NORMAL + 1e-9;
        let ground: Vec<_> = points
            .iter()
            .filter(|p| plane.distance(p) <= near)
            .collect();
        let mean = ground.iter().copied().sum::<Vector3<f64>>() / ground.len() as f64;
        let scatter = ground.iter().fold(Matrix3::zeros(), |s, p| {
            s + (**p - mean) * (**p - mean).transpose()
        });
        let eigen = scatter.symmetric_eigen();
        let smallest = eigen.eigenvalues.imin();
        plane = Plane::facing(eigen.eigenvectors.column(smallest).into_owned(), &mean, up)?;
    }
    let mean = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let extent = (points
        .iter()
        .map(|p| (p - mean).norm_squared())
        .sum::<f64>()
        / points.len() as f64)
        .sqrt();
    (plane.misfit(points) <= MAX_THICKNESS * extent).then_some(plane)
}

/// NaN of no values.
fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    if values.is_empty() {
        return f64::NAN;
    }
    let rank = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// Steele, Lea and Flood 2014.
struct SplitMix64(u64);

impl SplitMix64 {
    /// A number of `0..n`; 0 when n is 0.
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((u128::from(z ^ (z >> 31)) * n as u128) >> 64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_geometry::se3;
    use nalgebra::Vector6;

    /// Level ground z = 0 seen by a camera 0.5 m above, pitched down by `pitch`, looking along +x;
    /// everything then moved by `motion`. Returns the points, the camera, and the true frame.
    #[allow(non_snake_case)]
    fn scene(pitch: f64, motion: &Se3, z: impl Fn(f64, f64) -> f64) -> (Vec<Point3<f64>>, Se3) {
        let points =
            (0..80).flat_map(|i| (0..60).map(move |j| (0.05 * i as f64, 0.05 * j as f64 - 1.5)));
        let points = points
            .map(|(x, y)| motion * Point3::new(x + 0.5, y, z(x, y)))
            .collect();
        let (c, s) = (pitch.cos(), pitch.sin());
        // Columns: the camera's x (right, -y), y (down) and z (forward) axes in the level frame.
        let axes = Matrix3::new(0.0, -s, c, -1.0, 0.0, 0.0, 0.0, -c, -s);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        let T_level_cam = Se3::from_parts(Translation3::new(0.0, 0.0, 0.5), rotation);
        (points, motion * T_level_cam)
    }

    fn close(a: &Se3, b: &Se3, by: f64) -> bool {
        se3::log(&a.inv_mul(b)).norm() < by
    }

    #[test]
    fn level_ground_is_found_in_any_world() {
        let motion = se3::exp(&Vector6::new(3.0, -2.0, 5.0, 0.4, -1.2, 2.0));
        for pitch in [0.0, 0.3, 0.9] {
            let (points, camera) = scene(pitch, &motion, |_, _| 0.0);
            let found = level(&points, &camera);
            assert_eq!(found.notice, None);
            assert!(
                close(&found.T_level_world, &motion.inverse(), 1e-9),
                "{pitch}: {found:?}"
            );
        }
    }

    #[test]
    fn rocks_a_wall_and_noise_do_not_tilt_the_ground() {
        let motion = se3::exp(&Vector6::new(1.0, 0.0, 0.0, 0.0, 0.7, 0.0));
        let ripple = |x: f64, y: f64| 0.01 * (40.0 * x).sin() * (37.0 * y).cos();
        // Behind x = 2.6 (a third of all points) stands a wall; a rock covers a fifth of the rest.
        let rough = |x: f64, y: f64| match (x > 2.6, x * x + y * y < 0.8) {
            (true, _) => ((x * 97.0).sin() * 43758.5).fract().abs() * 1.5,
            (_, true) => 0.15,
            _ => ripple(x, y),
        };
        let (points, camera) = scene(0.4, &motion, rough);
        let found = level(&points, &camera);
        assert_eq!(found.notice, None);
        let error = found.T_level_world * motion;
        assert!(
            error.rotation.angle().to_degrees() < 0.5,
            "{}",
            error.rotation.angle().to_degrees()
        );
        assert!(error.translation.vector.norm() < 0.01, "{error}");
    }

    #[test]
    fn without_ground_the_camera_says_what_is_down() {
        // A wall ahead, and nothing else.
        let wall: Vec<_> = (0..50)
            .flat_map(|i| {
                (0..50).map(move |j| Point3::new(0.04 * i as f64 - 1.0, 0.04 * j as f64 - 1.0, 3.0))
            })
            .collect();
        for points in [&wall[..], &wall[..2], &[]] {
            let found = level(points, &Se3::identity());
            assert!(found.notice.is_some());
            let up = found.T_level_world.rotation * -Vector3::y();
            let forward = found.T_level_world.rotation * Vector3::z();
            assert!((up - Vector3::z()).norm() < 1e-12 && (forward - Vector3::x()).norm() < 1e-12);
        }
    }

    #[test]
    fn a_camera_that_looks_straight_down_has_a_frame_too() {
        let motion = Se3::identity();
        let (points, camera) = scene(std::f64::consts::FRAC_PI_2, &motion, |_, _| 0.0);
        let found = level(&points, &camera);
        // Ground is 90 degrees off the camera's "up": not believed, by the rule of 60 degrees.
        assert!(found.notice.is_some());
        assert!(
            found
                .T_level_world
                .to_homogeneous()
                .iter()
                .all(|v| v.is_finite())
        );
        let (points, camera) = scene(0.99, &motion, |_, _| 0.0);
        assert!(level(&points, &camera).notice.is_none());
    }
}
