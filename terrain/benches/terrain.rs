//! What a rover and an office wait for: one look into voxels and into the elevation map, and a DEM of fifty million
//! points. `cargo bench -p barchan-terrain`; each on one thread.

use std::hint::black_box;

use barchan_geometry::Se3;
use barchan_geometry::nalgebra::{
    Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3,
};
use barchan_terrain::elevation::{ElevationConfig, ElevationMap, Scan, SensorModel};
use barchan_terrain::{CellStatistic, Cloud, CloudPoint, VoxelMap, dem};
use divan::Bencher;

fn main() {
    divan::main();
    // Where the system tells: what the whole run, the fifty million points above all, took of memory.
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(peak) = status.lines().find(|l| l.starts_with("VmHWM")) {
        println!("{peak}");
    }
}

/// Hummocky ground.
fn ground(x: f64, y: f64) -> f64 {
    0.12 * (1.3 * x).sin() * (1.1 * y + 0.4).cos() + 0.03 * (4.0 * y).sin()
}

/// A look of Hong's cameras, 484 x 366 pixels of which each is a point (177 144), from 0.8 m above the ground, 40
/// degrees down.
#[allow(non_snake_case)]
fn look() -> (Cloud, Se3) {
    let (s, c) = 40f64.to_radians().sin_cos();
    let axes = Matrix3::new(0.0, -s, c, -1.0, 0.0, 0.0, 0.0, -c, -s);
    let T_map_cam = Se3::from_parts(
        Translation3::new(0.3, -0.2, ground(0.3, -0.2) + 0.8),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
    );
    let mut points = vec![];
    for (u, v) in (0..366).flat_map(|v| (0..484).map(move |u| (f64::from(u), f64::from(v)))) {
        let ray = Vector3::new((u - 241.5) / 387.0, (v - 182.5) / 387.0, 1.0);
        let turned = T_map_cam.rotation * ray;
        // A step to the plane, and Newton's along the ray.
        let mut z = -T_map_cam.translation.z / turned.z;
        for _ in 0..4 {
            let p = T_map_cam.translation.vector + turned * z;
            z += (p.z - ground(p.x, p.y)) / -turned.z;
        }
        points.push(CloudPoint {
            position: Point3::from(ray * z),
            colour: [(u as u32 % 256) as u8, (v as u32 % 256) as u8, 90],
            sigma: (0.25 * z * z / (387.0 * 0.12)) as f32,
        });
    }
    (Cloud { points }, T_map_cam)
}

#[divan::bench(sample_count = 40)]
fn look_into_elevation_5_cm(bencher: Bencher) {
    let (cloud, pose) = look();
    let mut map = ElevationMap::new(ElevationConfig::default()).expect("defaults are valid");
    let scan = Scan {
        cloud: &cloud,
        T_map_sensor: pose,
        pose_covariance: None,
        sensor: SensorModel::Stereo {
            focal: 387.0,
            baseline: 0.12,
            pixel: 1.0,
            systematic: 0.1,
            shared: 1.0,
        },
        time: 0.0,
    };
    bencher.bench_local(|| map.add_growing(&scan).is_ok());
}

#[divan::bench(sample_count = 40, args = [0.02, 0.05])]
fn look_into_new_voxels(bencher: Bencher, size: f64) {
    let (cloud, pose) = look();
    let cloud = cloud.transform(&pose);
    bencher.bench_local(|| {
        let mut map = VoxelMap::new(size).expect("above zero");
        map.insert(&cloud);
        map.len()
    });
}

/// Looks at a site of 50 x 50 m, each a window of 3 x 3 m of it that moves on, until there were fifty million points: half
/// a metre of ground every 0.2 m2, in voxels of 0.1 m, as `barchan map --cell 0.3` chooses.
#[divan::bench(sample_count = 1, sample_size = 1, args = [50_000_000])]
fn dem_of_30_cm(bencher: Bencher, total: usize) {
    const LOOK: usize = 200_000;
    let mut state = 7u64;
    let mut uniform = move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / (1u64 << 31) as f64
    };
    // A look is made before the clock runs; ten of them, moved over the site, are as good as many.
    let looks: Vec<Cloud> = (0..10)
        .map(|_| {
            let points = (0..LOOK).map(|k| {
                // Rows of an image: neighbours in the list are neighbours on the ground.
                let x = 3.0 * (k % 500) as f64 / 500.0 + 0.004 * uniform();
                let y = 3.0 * (k / 500) as f64 / 400.0 + 0.004 * uniform();
                CloudPoint {
                    position: Point3::new(x, y, ground(x, y) + 0.02 * (uniform() - 0.5)),
                    colour: [120, (k % 256) as u8, 90],
                    sigma: 0.01,
                }
            });
            Cloud {
                points: points.collect(),
            }
        })
        .collect();
    bencher.bench_local(|| {
        let mut map = VoxelMap::new(0.1).expect("above zero");
        for k in 0..total / LOOK {
            let (column, row) = (k % 16, k / 16 % 16);
            let shift = Se3::translation(3.0 * column as f64, 3.0 * row as f64, 0.0);
            map.insert(&looks[k % looks.len()].clone().transform(&shift));
        }
        let voxels = map.voxels(2);
        black_box(dem(&voxels, 0.3, CellStatistic::Mean, 25_000_000).map(|d| d.raster.values.len()))
    });
}
