//! Bai 2019's experiment: a sensor with the noise of a Kinect, nearer than 3 m, its poses true, noisy and from SLAM.

use std::fmt::Write as _;
use std::path::Path;

use barchan_datasets::{Plane, disparity_file};

use crate::program::{barchan, json, text};

/// Focal length times baseline of the rendered rig: pixels times metres.
const FOCAL: f64 = 0.8 * 256.0;
const BASELINE: f64 = 0.12;
/// Range of the sensor, metres.
const RANGE: f64 = 3.0;

/// Kinect v1 after Nguyen 2012: deviations along and across the optical axis at a depth, metres.
fn noise(z: f64) -> [f64; 2] {
    [0.0012 + 0.0019 * (z - 0.4).powi(2), 0.001_376_915 * z]
}

/// Numbers that are nearly normal: sums of twelve uniform ones.
fn normals(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        let mut uniform = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 33) as f64 / (1u64 << 31) as f64
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }
}

/// What the sensor measures where the true disparity is `truth`, and its deviation, as disparity.
fn sensed(truth: &Plane, normal: &mut impl FnMut() -> f64) -> [Plane; 2] {
    let (width, height) = truth.dimensions();
    let mut measured = Plane::from_pixel(width, height, image::Luma([f32::NAN]));
    let mut sigma = measured.clone();
    for (u, v) in (0..height).flat_map(|v| (0..width).map(move |u| (u, v))) {
        // The depth of a place beside: errors across are of the same angle at every depth.
        let beside = |x: u32, most: u32, normal: &mut dyn FnMut() -> f64| {
            let across = noise(1.0)[1] * FOCAL * normal();
            (f64::from(x) + across).clamp(0.0, f64::from(most - 1) - 1e-6)
        };
        let (x, y) = (beside(u, width, normal), beside(v, height, normal));
        let (left, top) = (x.floor() as u32, y.floor() as u32);
        let (right, low) = ((left + 1).min(width - 1), (top + 1).min(height - 1));
        let depth = |x: u32, y: u32| FOCAL * BASELINE / f64::from(truth.get_pixel(x, y).0[0]);
        let (across, down) = (x.fract(), y.fract());
        let along = |y: u32| (1.0 - across) * depth(left, y) + across * depth(right, y);
        let z = (1.0 - down) * along(top) + down * along(low);
        let z = z + noise(z)[0] * normal();
        if z > 0.0 && z < RANGE {
            measured.get_pixel_mut(u, v).0[0] = (FOCAL * BASELINE / z) as f32;
            sigma.get_pixel_mut(u, v).0[0] = (noise(z)[0] * FOCAL * BASELINE / (z * z)) as f32;
        }
    }
    [measured, sigma]
}

/// Poses of a TUM file, 2 mm and 0.1 degrees off in each axis.
fn shaken(poses: &str, normal: &mut impl FnMut() -> f64) -> String {
    let mut text = String::new();
    for line in poses.lines().filter(|l| !l.starts_with('#')) {
        let fields: Vec<f64> = line
            .split_whitespace()
            .map(|f| f.parse().unwrap())
            .collect();
        let [time, x, y, z, qx, qy, qz, qw] = fields[..] else {
            panic!("{line}")
        };
        let shift = [(); 3].map(|()| 0.002 * normal());
        let [a, b, c] = [(); 3].map(|()| 0.5 * 0.1f64.to_radians() * normal());
        // The quaternion (1, a, b, c) before the pose's own: a small turn about the axes of the world.
        let turned = [
            qx + a * qw + b * qz - c * qy,
            qy - a * qz + b * qw + c * qx,
            qz + a * qy - b * qx + c * qw,
            qw - a * qx - b * qy - c * qz,
        ];
        let norm = turned.iter().map(|q| q * q).sum::<f64>().sqrt();
        let [qx, qy, qz, qw] = turned.map(|q| q / norm);
        writeln!(
            text,
            "{time} {} {} {} {qx} {qy} {qz} {qw}",
            x + shift[0],
            y + shift[1],
            z + shift[2]
        )
        .unwrap();
    }
    text
}

#[test]
fn the_papers_accuracy_is_met_with_true_with_noisy_and_with_slams_poses() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (data, run) = (at("data"), at("run"));
    let spec = "synth:seed=3,frames=40,width=256,height=192,rocks=0,tracks=false,tilt=35";
    barchan()
        .args(["data", "synth", spec, "--out", text(&data)])
        .assert()
        .success();
    let slam = ["slam", "--data", text(&data), "--model", "sgm:64"];
    let tracked = json(&[&slam[..], &["--out", text(&run)]].concat());
    assert_eq!(tracked["tracked"], 40, "{tracked}");

    // The sensor looks where the camera had its key frames.
    let mut normal = normals(7);
    let images = |folder: &Path| folder.read_dir().unwrap().map(|e| e.unwrap().path());
    for file in images(&run.join("keyframes/disparity")) {
        let name = file.file_name().unwrap();
        let truth = disparity_file::read(&data.join("disparity").join(name)).unwrap();
        let [measured, sigma] = sensed(&truth, &mut normal);
        disparity_file::write_png(&file, &measured).unwrap();
        disparity_file::write_png(&run.join("keyframes/sigma").join(name), &sigma).unwrap();
    }
    let sensor = at("kinect.toml");
    let kinect = "kind = \"structured-light\"\na = 0.0012\nb = 0.0019\nc = 0.4\nl = 0.001376915\n";
    std::fs::write(&sensor, kinect).unwrap();
    let (truth, noisy) = (data.join("groundtruth.tum"), at("noisy.tum"));
    let poses = std::fs::read_to_string(&truth).unwrap();
    std::fs::write(&noisy, shaken(&poses, &mut normal)).unwrap();

    let map = at("map");
    for (what, flag, poses, largest) in [
        ("true poses", "--poses", &truth, 0.014),
        ("2 mm and 0.1 degrees off", "--poses", &noisy, 0.02),
        ("SLAM", "--align", &truth, 0.065),
    ] {
        let sizes = ["--voxel", "0.05", "--cell", "0.05", "--max-depth", "3"];
        let begin = ["map", text(&run), "--sensor", text(&sensor)];
        json(
            &[
                &begin[..],
                &sizes,
                &[flag, text(poses), "--out", text(&map)],
            ]
            .concat(),
        );
        let (elevation, ground) = (map.join("elevation.tif"), data.join("dem.tif"));
        let score = json(&[
            "eval",
            "dem",
            "--est",
            text(&elevation),
            "--ref",
            text(&ground),
        ]);
        println!(
            "{what}: {} cells, largest error {:.4} m, 95 % {:.4}, RMSE {:.4}; bounds hold {}",
            score["cells"],
            score["max"].as_f64().unwrap(),
            score["p95"].as_f64().unwrap(),
            score["rmse"].as_f64().unwrap(),
            score["bounds"]
        );
        assert!(score["cells"].as_u64().unwrap() > 1000, "{what}: {score}");
        assert!(score["max"].as_f64().unwrap() <= largest, "{what}: {score}");
    }
}
