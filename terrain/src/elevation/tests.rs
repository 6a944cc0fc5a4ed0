//! The checks S1 to S9 of the specification that the map itself must pass (S3 and S4 are in `motion`),
//! and what else it promises.

use barchan_geometry::Se3;
use nalgebra::{
    Matrix3, Matrix4, Matrix6, Point3, Rotation3, Translation3, UnitQuaternion, Vector3,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

fn point(x: f64, y: f64, z: f64) -> CloudPoint {
    CloudPoint {
        position: Point3::new(x, y, z),
        colour: [200, 120, 60],
        sigma: 0.0,
    }
}

/// The papers' map: every point a measurement, no floor, no slopes, no gate.
fn plain(cell: f64) -> ElevationConfig {
    ElevationConfig {
        cell,
        hits: Hits::PerPoint,
        min_variance: 0.0,
        slopes: false,
        gate_threshold: 1e9,
        contradiction: Contradiction::Keep,
        ..ElevationConfig::default()
    }
}

/// Normal noise of one deviation up and down, for a sensor whose z axis is the map's.
fn upright(deviation: f64) -> SensorModel {
    SensorModel::StructuredLight {
        a: deviation,
        b: 0.0,
        c: 0.0,
        d: 0.0,
        e: 1.0,
        l: 0.0,
    }
}

fn scan(cloud: &Cloud, sensor: SensorModel, time: f64) -> Scan<'_> {
    Scan {
        cloud,
        T_map_sensor: Se3::identity(),
        pose_covariance: None,
        sensor,
        time,
    }
}

fn cloud(points: impl IntoIterator<Item = CloudPoint>) -> Cloud {
    Cloud {
        points: points.into_iter().collect(),
    }
}

#[test]
fn s1_the_variance_of_a_hundred_equal_measurements_is_a_hundredth() {
    let mut map = ElevationMap::square(plain(0.1), 2.0).unwrap();
    let one = cloud([point(0.02, 0.03, 0.7)]);
    for i in 0..100 {
        map.add(&scan(&one, upright(0.02), f64::from(i)));
    }
    let cell = map.at(0.02, 0.03).unwrap();
    assert!((cell.variance() / (4e-4 / 100.0) - 1.0).abs() < 1e-12);
    assert!((cell.height - 0.7).abs() < 1e-15);
    assert_eq!((cell.count, cell.time), (100, 99.0));
    assert_eq!(cell.colour(), [200, 120, 60]);
    // A floor keeps it from certainty.
    let mut floored = ElevationMap::square(
        ElevationConfig {
            min_variance: 9e-6,
            ..plain(0.1)
        },
        2.0,
    )
    .unwrap();
    for i in 0..1000 {
        floored.add(&scan(&one, upright(0.02), f64::from(i)));
    }
    assert!(floored.at(0.02, 0.03).unwrap().variance() >= 9e-6);
}

#[test]
fn s2_a_point_moves_with_the_pose_as_its_jacobian_says() {
    // A robot, and a sensor with a lever arm on it.
    let robot = UnitQuaternion::from_euler_angles(0.2, -0.3, 1.1);
    let mount = UnitQuaternion::from_euler_angles(-1.9, 0.1, -1.5);
    let (arm, seen) = (Vector3::new(0.4, -0.1, 0.9), Vector3::new(0.5, 0.3, 2.7));
    let position = Vector3::new(3.0, -1.0, 0.2);
    let in_map = |shift: Vector3<f64>, turn: Vector3<f64>| {
        position + shift + UnitQuaternion::from_scaled_axis(turn) * (robot * (mount * seen + arm))
    };
    let j = pose_jacobian(&(robot * (mount * seen + arm)));
    for k in 0..6 {
        let mut delta = nalgebra::Vector6::zeros();
        delta[k] = 1e-5;
        let (shift, turn) = (
            delta.fixed_rows::<3>(0).into_owned(),
            delta.fixed_rows::<3>(3).into_owned(),
        );
        let difference = (in_map(shift, turn) - in_map(-shift, -turn)) / 2e-5;
        assert!(
            (difference - j.column(k)).norm() < 1e-8,
            "{k}: {difference} {}",
            j.column(k)
        );
    }
}

#[test]
fn s5_yaw_moves_cells_sideways_and_leaves_their_heights_sure() {
    let mut map = ElevationMap::square(plain(0.02), 10.0).unwrap();
    let far = cloud([point(3.0, 0.0, 0.0)]);
    map.add(&scan(&far, upright(0.01), 0.0));
    let before = *map.at(3.0, 0.0).unwrap();
    assert_eq!(before.horizontal, [1e-4, 1e-4, 0.0]);
    let mut yaw_only = Matrix4::zeros();
    yaw_only[(3, 3)] = 1f64.to_radians().powi(2);
    map.motion_update(&Se3::identity(), &yaw_only);
    let after = map.at(3.0, 0.0).unwrap();
    assert_eq!(after.variance(), before.variance());
    // The cell's middle is at 3.01 m.
    let expected = 2.742e-3 * (3.01f64 / 3.0).powi(2);
    assert!((after.horizontal[1] - 1e-4 - expected).abs() < 1e-6);
    assert!((after.horizontal[0] - 1e-4).abs() < 1e-6);

    // The whole of (28) against a propagation of samples, for a robot that stands elsewhere, turned.
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let robot = Se3::new(Vector3::new(1.0, -0.5, 0.3), Vector3::z() * 0.6);
    let root = Matrix4::new(
        0.02, 0.0, 0.0, 0.0, 0.01, 0.03, 0.0, 0.0, 0.0, 0.005, 0.01, 0.0, 0.01, 0.0, 0.002, 0.02,
    );
    let before = *map.at(3.0, 0.0).unwrap();
    map.motion_update(&robot, &(root * root.transpose()));
    let after = *map.at(3.0, 0.0).unwrap();
    let turned = robot.rotation.to_rotation_matrix();
    let lever = Vector3::new(3.01, 0.01, 0.0) - robot.translation.vector;
    let (n, mut sum) = (20_000, Matrix3::zeros());
    for _ in 0..n {
        let e = root * nalgebra::Vector4::from_fn(|_, _| normal(&mut rng));
        let moved = turned * e.fixed_rows::<3>(0) + Vector3::z().cross(&lever) * e[3];
        sum += moved * moved.transpose() / f64::from(n);
    }
    let added = [0, 1, 2].map(|k| after.horizontal[k] - before.horizontal[k]);
    for (ours, sampled) in added.iter().zip([sum[(0, 0)], sum[(1, 1)], sum[(0, 1)]]) {
        assert!(
            (ours - sampled).abs() < 0.05 * sum[(1, 1)],
            "{ours} {sampled}"
        );
    }
    assert!((after.variance() - before.variance() - sum[(2, 2)]).abs() < 0.05 * sum[(2, 2)]);
    // Every known cell, and no other.
    assert!(map.at(2.0, 0.0).unwrap().horizontal[0].is_nan());
}

/// S6: 20 hits a cell on a slope of 20 degrees, 5 mm of noise, cells of 5 cm.
#[test]
fn s6_on_slopes_bounds_hold_when_slopes_count() {
    let (d, s, rise) = (0.05, 0.005, 20f64.to_radians().tan());
    let covered = |slopes: bool| {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let config = ElevationConfig { slopes, ..plain(d) };
        let mut map = ElevationMap::square(config, 4.0).unwrap();
        let n = 20 * 80 * 80;
        let points = (0..n).map(|i| {
            let (column, row) = (i % 80 - 40, i / 80 % 80 - 40);
            let x = d * (f64::from(column) + rng.random::<f64>());
            let y = d * (f64::from(row) + rng.random::<f64>());
            point(x, y, rise * x + s * normal(&mut rng))
        });
        map.add(&scan(&cloud(points), upright(s), 0.0));
        let (grid, cells) = map.raster();
        let within = cells.iter().enumerate().filter(|(i, c)| {
            let (x, _) = grid.centre(i % grid.width, i / grid.width);
            (c.height - rise * x).abs() < 3.0 * c.variance().sqrt()
        });
        let known = cells.iter().filter(|c| c.is_known()).count();
        assert_eq!(known, 80 * 80);
        within.count() as f64 / known as f64
    };
    let (without, with) = (covered(false), covered(true));
    println!("3 sigma hold {without:.4} without slopes, {with:.4} with");
    assert!((without - 0.965).abs() < 0.01, "{without}");
    assert!((0.993..0.9995).contains(&with), "{with}");
}

#[test]
fn s7_half_a_degree_of_pitch_is_three_and_a_half_centimetres_at_four_metres() {
    let mut map = ElevationMap::square(plain(0.1), 10.0).unwrap();
    let ahead = cloud([point(4.0, 0.0, 0.0)]);
    let mut pose = Matrix6::zeros();
    pose[(4, 4)] = 0.5f64.to_radians().powi(2);
    map.add(&Scan {
        pose_covariance: Some(pose),
        ..scan(&ahead, SensorModel::Perfect, 0.0)
    });
    let deviation = map.at(4.0, 0.0).unwrap().variance().sqrt();
    assert!((deviation - 0.0349).abs() < 1e-4, "{deviation}");
    // The same pose error in scan after scan: no number of them makes it smaller.
    for i in 1..50 {
        map.add(&Scan {
            pose_covariance: Some(pose),
            ..scan(&ahead, SensorModel::Perfect, f64::from(i))
        });
    }
    assert!((map.at(4.0, 0.0).unwrap().variance().sqrt() - deviation).abs() < 1e-12);
}

/// A camera `height` above (x, y, 0), looking along +x, pitched down.
fn camera(x: f64, y: f64, height: f64, pitch: f64) -> Se3 {
    let (c, s) = (pitch.cos(), pitch.sin());
    let axes = Matrix3::new(0.0, -s, c, -1.0, 0.0, 0.0, 0.0, -c, -s);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Se3::from_parts(Translation3::new(x, y, height), rotation)
}

/// Points of the surface z = f(x, y) in the frame of a camera of 96 x 72 pixels, nearer than 3 m.
fn look(T_map_cam: &Se3, f: impl Fn(f64, f64) -> f64) -> Vec<Point3<f64>> {
    let mut points = vec![];
    for (u, v) in (0..72).flat_map(|v| (0..96).map(move |u| (f64::from(u), f64::from(v)))) {
        let ray = Vector3::new((u - 47.5) / 85.0, (v - 35.5) / 85.0, 1.0);
        let turned = T_map_cam.rotation * ray;
        let above = |depth: f64| {
            let p = T_map_cam.translation.vector + turned * depth;
            p.z - f(p.x, p.y)
        };
        let hit = (7..=60)
            .map(|i| 0.05 * f64::from(i))
            .find(|&d| above(d) <= 0.0);
        if let Some(mut far) = hit {
            let mut near = far - 0.05;
            for _ in 0..30 {
                let middle = 0.5 * (near + far);
                if above(middle) <= 0.0 {
                    far = middle;
                } else {
                    near = middle;
                }
            }
            points.push(Point3::from(ray * far));
        }
    }
    points
}

/// How far the cells of a map with at least `hits` points are off, in the order of size.
fn errors(map: &ElevationMap, hits: u32, truth: impl Fn(f64, f64) -> f64) -> Vec<(f64, f64)> {
    let (grid, cells) = map.raster();
    let known = cells.iter().enumerate().filter(|(_, c)| c.count >= hits);
    let mut errors: Vec<(f64, f64)> = known
        .map(|(i, c)| {
            let (x, y) = grid.centre(i % grid.width, i / grid.width);
            ((c.height - truth(x, y)).abs(), c.variance().sqrt())
        })
        .collect();
    errors.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    errors
}

/// S8: a Kinect on a rover over hummocky ground, nearer than 3 m, as in Bai 2019's simulation. Its
/// errors are maxima at picked points; these are maxima over all cells.
#[test]
fn s8_the_accuracy_of_the_paper_is_met_with_true_and_with_noisy_poses() {
    let ground =
        |x: f64, y: f64| 0.12 * (1.3 * x).sin() * (1.1 * y + 0.4).cos() + 0.03 * (4.0 * y).sin();
    let drive = |position: f64, degrees: f64| {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let config = ElevationConfig {
            cell: 0.05,
            ..ElevationConfig::default()
        };
        let mut map = ElevationMap::new(config).unwrap();
        let mut covariance = Matrix6::zeros();
        for k in 0..3 {
            covariance[(k, k)] = position * position;
            covariance[(k + 3, k + 3)] = degrees.to_radians().powi(2);
        }
        for i in 0..24 {
            let (x, y) = (0.1 * f64::from(i), 0.3 * (0.3 * f64::from(i)).sin());
            let truth = camera(x, y, ground(x, y) + 1.0, 0.6);
            let points = look(&truth, ground).into_iter().map(|p| {
                let exact = CloudPoint {
                    position: p,
                    ..point(0.0, 0.0, 0.0)
                };
                let c = SensorModel::KINECT.covariance(&exact).random;
                let noise = Vector3::from_fn(|k, _| c[(k, k)].sqrt() * normal(&mut rng));
                CloudPoint {
                    position: p + noise,
                    ..exact
                }
            });
            let cloud = cloud(points);
            let shift = Vector3::from_fn(|_, _| position * normal(&mut rng));
            let turn = Vector3::from_fn(|_, _| degrees.to_radians() * normal(&mut rng));
            let believed = Se3::from_parts(
                (truth.translation.vector + shift).into(),
                UnitQuaternion::from_scaled_axis(turn) * truth.rotation,
            );
            map.add_growing(&Scan {
                cloud: &cloud,
                T_map_sensor: believed,
                pose_covariance: (position > 0.0).then_some(covariance),
                sensor: SensorModel::KINECT,
                time: f64::from(i),
            })
            .unwrap();
        }
        let all = errors(&map, 1, ground);
        let seen = errors(&map, 20, ground);
        let n = seen.len() as f64;
        let rmse = (seen.iter().map(|e| e.0 * e.0).sum::<f64>() / n).sqrt();
        let covered = seen.iter().filter(|e| e.0 < 3.0 * e.1).count() as f64 / n;
        println!(
            "{position} m, {degrees} deg: {} of {} cells with 20 hits; rmse {:.4}, 95 % {:.4}, max {:.4} m, 3 sigma hold {covered:.4}",
            seen.len(),
            all.len(),
            rmse,
            seen[(0.95 * n) as usize].0,
            seen[seen.len() - 1].0
        );
        assert!(
            seen.len() > 1000 && covered > 0.99,
            "{} {covered}",
            seen.len()
        );
        (seen[(0.95 * n) as usize].0, seen[seen.len() - 1].0)
    };
    let (profile, largest) = drive(0.0, 0.0);
    assert!(largest <= 0.014 && profile <= 0.006, "{largest} {profile}");
    let (_, largest) = drive(0.002, 0.1);
    assert!(largest <= 0.02, "{largest}");
}

#[test]
fn s9_a_move_keeps_cells_bit_by_bit_and_empties_those_that_enter() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut map = ElevationMap::square(plain(0.25), 6.0).unwrap();
    let points = (0..5000).map(|_| {
        let [x, y, z] = [0; 3].map(|_| rng.random::<f64>() * 6.5 - 3.25);
        point(x, y, z)
    });
    map.add(&scan(&cloud(points), upright(0.02), 1.0));
    for (dx, dy) in [
        (0.5, 0.0),
        (-1.0, 0.75),
        (0.1, 0.1),
        (0.0, -4.0),
        (100.0, 0.0),
    ] {
        let (before, _) = map.raster();
        let old = map.clone();
        let middle = [0, 1].map(|k| {
            let half = 0.125;
            if k == 0 {
                before.west + 0.25 * before.width as f64 / 2.0 + half + dx
            } else {
                before.north - 0.25 * before.height as f64 / 2.0 + half + dy
            }
        });
        map.move_to(middle);
        let (grid, cells) = map.raster();
        assert_eq!((grid.width, grid.height), (before.width, before.height));
        for (i, cell) in cells.iter().enumerate() {
            let (x, y) = grid.centre(i % grid.width, i / grid.width);
            match old.at(x, y) {
                // NaN differs from itself: compare what is printed.
                Some(kept) => assert_eq!(format!("{cell:?}"), format!("{kept:?}")),
                None => assert!(!cell.is_known() && cell.horizontal[0].is_nan()),
            }
        }
    }
    assert!(map.raster().1.iter().all(|c| !c.is_known()));
}

#[test]
fn growing_keeps_what_is_known_and_refuses_absurd_sizes() {
    let mut map = ElevationMap::new(ElevationConfig {
        max_cells: 10_000,
        ..plain(0.5)
    })
    .unwrap();
    for (i, (x, y)) in [(0.1, 0.1), (-7.3, 2.0), (5.0, -9.9)]
        .into_iter()
        .enumerate()
    {
        let here = cloud([point(x, y, x + y)]);
        map.add_growing(&scan(&here, upright(0.01), i as f64))
            .unwrap();
    }
    for (x, y) in [(0.1, 0.1), (-7.3, 2.0), (5.0, -9.9)] {
        assert_eq!(map.at(x, y).unwrap().height, x + y);
    }
    for (x, y) in [(1e9, 0.0), (f64::INFINITY, 0.0), (0.0, 1e300)] {
        let far = cloud([point(x, y, 0.0)]);
        let grown = map.add_growing(&scan(&far, upright(0.01), 9.0));
        assert!(
            matches!(grown, Err(TerrainError::TooLarge { .. })),
            "{x} {y}"
        );
    }
    let odd = cloud([point(f64::NAN, 0.0, 0.0), point(0.1, 0.1, f64::NAN)]);
    map.add(&scan(&odd, upright(0.01), 9.0));
    assert_eq!(map.at(0.1, 0.1).unwrap().count, 1);
    assert!(ElevationMap::square(plain(0.0), 3.0).is_err());
    assert!(ElevationMap::square(plain(0.1), f64::NAN).is_err());
}

#[test]
fn the_gate_acts_as_it_is_written() {
    let fuse = |config: ElevationConfig, measurements: &[(f64, f64)]| {
        let mut map = ElevationMap::square(config, 2.0).unwrap();
        for (z, time) in measurements {
            map.add(&scan(&cloud([point(0.0, 0.0, *z)]), upright(0.01), *time));
        }
        *map.at(0.0, 0.0).unwrap()
    };
    let gated = ElevationConfig {
        gate_threshold: 2.5,
        ..plain(0.1)
    };
    // A later scan that contradicts: the height stays and is a little less sure.
    let later = fuse(gated, &[(0.0, 0.0), (0.5, 1.0)]);
    assert_eq!(later.height, 0.0);
    assert!((later.variance() - (1e-4 + 9e-7)).abs() < 1e-12 && later.time == 0.0);
    // The same scan: the higher point wins, a lower one is passed over; the first point counts too.
    assert_eq!(fuse(gated, &[(0.0, 1.0), (0.5, 1.0)]).height, 0.5);
    assert_eq!(fuse(gated, &[(0.5, 1.0), (0.0, 1.0)]).height, 0.5);
    let half = ElevationConfig {
        increase_height_alpha: 0.5,
        ..gated
    };
    assert_eq!(fuse(half, &[(0.0, 1.0), (0.5, 1.0)]).height, 0.25);
    // Three deviations of the cell are 2.1 of the difference: the two gates disagree.
    let three = [(0.0, 0.0), (0.03, 1.0)];
    assert!((fuse(gated, &three).height - 0.015).abs() < 1e-12);
    let cell = ElevationConfig {
        gate: Gate::Cell,
        ..gated
    };
    assert_eq!(fuse(cell, &three).height, 0.0);
    // Widening: the surer one decides, and the bounds reach to both. 0.5 m are 35 deviations.
    let widen = ElevationConfig {
        contradiction: Contradiction::Widen,
        ..gated
    };
    let quarrel = fuse(widen, &[(0.0, 0.0), (0.5, 1.0)]);
    assert!((quarrel.height - 0.25).abs() < 1e-12);
    assert!((quarrel.variance() - (0.5f64 / 2.5).powi(2) / 4.0).abs() < 1e-12);
    assert!(3.0 * quarrel.variance().sqrt() > 0.25);
    // Many more that agree settle it.
    let many: Vec<(f64, f64)> = (0..40)
        .map(|i| (if i == 0 { 0.0 } else { 0.5 }, f64::from(i)))
        .collect();
    let settled = fuse(widen, &many);
    assert!(
        (settled.height - 0.5).abs() < 0.02 && settled.variance().sqrt() < 0.01,
        "{settled:?}"
    );
    // Measurements worse than the map accepts are not taken.
    let strict = ElevationConfig {
        max_variance: 1e-5,
        ..gated
    };
    assert!(!fuse(strict, &[(0.0, 0.0)]).is_known());
}

/// Stereo errors of a scan have one sign over whole cells, and a part of them is the same in every scan.
#[test]
fn errors_that_neighbours_share_do_not_make_the_bounds_too_narrow() {
    let (shared, all_looks) = (0.02, 0.01);
    let covered = |hits: Hits, systematic: f64| {
        let mut within = 0;
        for seed in 0..400 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut map = ElevationMap::square(
                ElevationConfig {
                    hits,
                    min_neighbours: 0,
                    ..ElevationConfig::default()
                },
                1.0,
            )
            .unwrap();
            let bias = all_looks * normal(&mut rng);
            for i in 0..12 {
                let off = bias + shared * normal(&mut rng);
                let points = (0..30).map(|_| CloudPoint {
                    sigma: shared as f32,
                    ..point(0.01 + 0.03 * rng.random::<f64>(), 0.02, 2.0 + off)
                });
                map.add(&scan(
                    &cloud(points),
                    // Straight down or up: depth is height. 0.01 m of depth at 2 m.
                    SensorModel::Stereo {
                        focal: 400.0,
                        baseline: 0.1,
                        pixel: 0.0,
                        systematic,
                        shared: 0.0,
                    },
                    f64::from(i),
                ));
            }
            let cell = map.at(0.02, 0.02).unwrap();
            within += usize::from((cell.height - 2.0).abs() < 3.0 * cell.variance().sqrt());
        }
        within as f64 / 400.0
    };
    let honest = covered(Hits::PerScan, all_looks * 40.0 / 4.0);
    let papers = covered(Hits::PerPoint, 0.0);
    println!("3 sigma hold {honest} with, {papers} without what errors share");
    assert!(honest > 0.985, "{honest}");
    assert!(papers < 0.8, "{papers}");
}

#[test]
fn both_kinds_of_bounds_agree_on_flat_ground_that_did_not_move() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let config = ElevationConfig {
        min_variance: 0.0,
        ..plain(0.1)
    };
    let mut map = ElevationMap::square(config, 3.0).unwrap();
    for i in 0..4 {
        let points = (0..30 * 30 * 4).map(|_| {
            let [x, y] = [0; 2].map(|_| rng.random::<f64>() * 3.0 - 1.5);
            point(x, y, 0.5 + 0.02 * normal(&mut rng))
        });
        map.add(&scan(&cloud(points), upright(0.02), f64::from(i)));
    }
    let mean_width = |kind| {
        let bounds = map.bounds(kind);
        let known: Vec<_> = bounds.iter().filter(|b| !b.height.is_nan()).collect();
        assert!(
            known
                .iter()
                .all(|b| b.lower <= b.height && b.height <= b.upper)
        );
        known.iter().map(|b| b.upper - b.lower).sum::<f64>() / known.len() as f64
    };
    let (sigma, quantile) = (
        mean_width(BoundsKind::Sigma3),
        mean_width(BoundsKind::Quantile),
    );
    assert!(
        (1.0 / 1.5..1.5).contains(&(quantile / sigma)),
        "{quantile} {sigma}"
    );
    // Where the map is unsure of places, the ground around counts: bounds widen over a step.
    let mut step = ElevationMap::square(plain(0.1), 3.0).unwrap();
    let ground = (0..30 * 30).map(|i| {
        let (x, y) = (
            0.1 * f64::from(i % 30) - 1.45,
            0.1 * f64::from(i / 30) - 1.45,
        );
        point(x, y, if x > 0.0 { 0.3 } else { 0.0 })
    });
    step.add(&scan(&cloud(ground), upright(0.005), 0.0));
    let mut moved = Matrix4::zeros();
    moved[(0, 0)] = 0.1 * 0.1;
    step.motion_update(&Se3::identity(), &moved);
    let (grid, _) = step.raster();
    let (column, row) = grid.cell_at(-0.05, 0.05).unwrap();
    let near = step.bounds(BoundsKind::Quantile)[row * grid.width + column];
    assert!(near.upper > 0.3 && near.lower < 0.0, "{near:?}");
    let (column, row) = grid.cell_at(-1.25, 0.05).unwrap();
    let far = step.bounds(BoundsKind::Quantile)[row * grid.width + column];
    assert!(far.upper < 0.05, "{far:?}");
}

#[test]
fn what_was_seen_too_seldom_has_no_bounds() {
    let config = ElevationConfig {
        min_looks: 2,
        ..plain(0.1)
    };
    let mut map = ElevationMap::square(config, 2.0).unwrap();
    let [once, twice] = [point(-0.45, 0.05, 0.3), point(0.45, 0.05, 0.1)];
    map.add(&scan(&cloud([once, twice]), upright(0.01), 0.0));
    let known = |map: &ElevationMap| {
        let bounds = map.bounds(BoundsKind::Sigma3);
        bounds.iter().filter(|b| !b.height.is_nan()).count()
    };
    assert_eq!(known(&map), 0);
    map.add(&scan(&cloud([twice]), upright(0.01), 1.0));
    assert_eq!(known(&map), 1);
    // What was seen once is kept for what comes.
    assert!(map.at(-0.45, 0.05).unwrap().is_known());
    assert_eq!(map.at(0.45, 0.05).unwrap().looks, 2);
}

#[test]
fn what_is_seen_through_is_removed_and_walls_stay() {
    let ground = || {
        (0..60).flat_map(|i| {
            (0..9).map(move |j| (0.1 * f64::from(i) + 0.05, 0.1 * f64::from(j) - 0.35))
        })
    };
    let sensor = Se3::translation(-0.5, 0.05, 1.0);
    let seen = |box_stands: bool| {
        let points = ground().filter_map(|(x, y)| {
            // A box of 0.6 m at 2 m hides what is behind it.
            let hidden = box_stands && x > 2.3 && (1.0 - 0.6) / 2.5 < 1.0 / (x + 0.5);
            let on_box = box_stands && (2.0..2.3).contains(&x);
            (!hidden).then(|| point(x + 0.5, y - 0.05, if on_box { 0.6 } else { 0.0 } - 1.0))
        });
        cloud(points)
    };
    let mut map = ElevationMap::square(plain(0.1), 14.0).unwrap();
    let add = |map: &mut ElevationMap, cloud: &Cloud, time| {
        map.add(&Scan {
            T_map_sensor: sensor,
            ..scan(cloud, upright(0.01), time)
        });
    };
    add(&mut map, &seen(true), 0.0);
    // The box hides nothing that was seen: all stays.
    assert_eq!(map.clear_ghosts(0.0), 0);
    // It is gone, and the ground where it stood is not looked at: only what lies behind.
    let behind = cloud(
        seen(false)
            .points
            .into_iter()
            .filter(|p| p.position.x > 3.3),
    );
    add(&mut map, &behind, 5.0);
    let removed = map.clear_ghosts(5.0);
    assert!((20..=30).contains(&removed), "{removed}");
    assert!(!map.at(2.15, 0.05).unwrap().is_known());
    assert!(map.at(1.55, 0.05).unwrap().is_known() && map.at(4.05, 0.05).unwrap().is_known());
}
