use super::super::tests::*;
use super::*;
use crate::StereoSource;
use barchan_geometry::Rectification;

const SIZE: (u32, u32) = (1024, 768);
/// The place of the first fix.
const START: [f64; 2] = [52.217259, 4.403469];

fn time(tenths: u32) -> String {
    format!("2015_11_26_12_00_{:02}_{}00", tenths / 10, tenths % 10)
}

/// Frames at 0, 1 (written as 0 s and 1000 ms), 2 and 8 s; fixes at 0 to 4 s going north at
/// 0.5 m/s; wheels of 0.125 m; a turn by 0.2 rad/s on a track of 0.8 m.
fn part() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for stamp in [
        time(0),
        "2015_11_26_12_00_00_1000".into(),
        time(20),
        time(80),
    ] {
        for (side, level) in [(0, 100), (1, 50)] {
            let name = format!("LocCam/LocCam_{stamp}_{side}.png");
            save_image(&root.path().join(name), SIZE, level);
        }
    }
    let (east, north) = tables::to_utm31(START[0], START[1]).unwrap();
    let fix = |k: u32| {
        format!(
            "{} RTK_FIXED {} {east} 45.0 0.005 0.004 0.009\n",
            time(10 * k),
            north + 0.5 * f64::from(k)
        )
    };
    save_text(
        &root.path().join("gps-utm31.txt"),
        &(0..5).map(fix).collect::<String>(),
    );
    let imu = |k: u32| format!("{} 0.1 0.2 9.8 0.01 0.02 0.2 0 0 9.81\n", time(k));
    save_text(
        &root.path().join("imu.txt"),
        &(0..50).map(imu).collect::<String>(),
    );
    let (radius, speed, half) = (0.125, 0.5, 0.2 * 0.8 / 2.0);
    let wheels = |k: u32| {
        let rate = |w: u32| (speed + if w.is_multiple_of(2) { -half } else { half }) / radius;
        let drive: String = (0..6)
            .map(|w| format!(" {} {} 1.5", rate(w) * f64::from(k) / 10.0, rate(w)))
            .collect();
        format!("{}{drive}{} 0 0 0\n", time(k), " 0 0 0".repeat(4))
    };
    save_text(
        &root.path().join("odometry.txt"),
        &(0..=40).map(wheels).collect::<String>(),
    );
    root
}

#[test]
fn pairs_truth_and_sensors_are_read() {
    let root = part();
    assert_eq!(detected(root.path()), ["katwijk"]);
    let source = (FORMAT.open)(root.path()).unwrap();
    // 8 s lies outside of the fixes.
    let stamps = [time(0), "2015_11_26_12_00_00_1000".into(), time(20)];
    assert_eq!(names(&source), stamps.map(|s| format!("LocCam_{s}")));
    let frame = source.frame(1).unwrap();
    assert_eq!(frame.time, tables::stamp(&time(10)).unwrap());
    let middle = |image: &crate::Rgb| (image[(512, 384)].0[0] * 255.0).round();
    assert_eq!((middle(&frame.left), middle(&frame.right)), (100.0, 50.0));
    let expected = Rectification::new(&loc_cam()).rig;
    assert_eq!(*source.rig(), expected);
    assert!((expected.baseline - 0.12008).abs() < 1e-12);

    let truth = source.true_trajectory().unwrap();
    let p = truth.poses[2].T_world_cam.translation.vector;
    assert!((p - Vector3::new(0.0, 1.0, 0.0)).norm() < 1e-6, "{p}");
    let sensors = source.sensors().unwrap();
    assert_eq!(
        (
            sensors.imu.len(),
            sensors.gnss.len(),
            sensors.odometry.len()
        ),
        (50, 5, 41)
    );
    assert_eq!(sensors.imu[3].rate, Vector3::new(0.01, 0.02, 0.2));
    // The camera looks against the x of the IMU, 18 degrees down, and its right is the IMU's y.
    let axis = |v: Vector3<f64>| sensors.T_imu_cam.rotation * v;
    let down = axis(Vector3::z()).z.asin().to_degrees();
    assert!(
        axis(Vector3::z()).x < -0.9 && (down + 18.0).abs() < 2.0,
        "{down}"
    );
    assert!(axis(Vector3::x()).y > 0.99);
    // The file has the deviation to the north first.
    assert_eq!(sensors.gnss[0].sigma, Vector3::new(0.004, 0.005, 0.009));
    for sample in &sensors.odometry {
        assert!(
            (sample.speed - 0.5).abs() < 1e-6 && (sample.yaw_rate - 0.2).abs() < 1e-6,
            "{sample:?}"
        );
    }
}

#[test]
fn latitude_and_longitude_in_either_file_are_the_same_place() {
    let root = part();
    let rows = |k: u32| {
        format!(
            "{} RTK_FIXED {} {} 45 0.005 0.004 0.009\n",
            time(10 * k),
            START[0] + 1e-5 * f64::from(k),
            START[1]
        )
    };
    let text: String = (0..5).map(rows).collect();
    save_text(&root.path().join("gps-utm31.txt"), &text);
    let from_utm = (FORMAT.open)(root.path()).unwrap();
    save_text(&root.path().join("gps-latlong.txt"), &text);
    std::fs::remove_file(root.path().join("gps-utm31.txt")).unwrap();
    let from_degrees = (FORMAT.open)(root.path()).unwrap();
    assert_eq!(
        from_utm.sensors().unwrap().gnss,
        from_degrees.sensors().unwrap().gnss
    );
    // A hundred-thousandth of a degree of latitude is 1.11 m.
    let p = from_utm.sensors().unwrap().gnss[4].p_world;
    assert!((p.xy().norm() - 4.45).abs() < 0.01, "{p}");
}

#[test]
fn images_further_apart_than_the_tolerance_are_no_pair() {
    for (millis, expected) in [("020", 1), ("021", 0)] {
        let root = tempfile::tempdir().unwrap();
        let image = |stamp: &str, side: u8| {
            save_image(
                &root
                    .path()
                    .join(format!("LocCam_2015_11_26_12_00_00_{stamp}_{side}.png")),
                SIZE,
                9,
            );
        };
        image("000", 0);
        image(millis, 1);
        match (FORMAT.open)(root.path()) {
            Ok(source) => assert_eq!(source.len(), expected),
            Err(error) => {
                assert_eq!(expected, 0, "{error}");
                assert!(error.to_string().contains("0.02 s"), "{error}");
            }
        }
    }
}

#[test]
fn a_calibration_in_the_folder_goes_before_the_published_one() {
    let root = part();
    let mut rig = loc_cam();
    rig.T_right_left = Se3::translation(-0.24, 0.0, 0.0);
    save_text(&root.path().join("rig.toml"), &rig.to_toml());
    let source = (FORMAT.open)(root.path()).unwrap();
    assert!((source.rig().baseline - 0.24).abs() < 1e-9);
}

#[test]
fn the_camera_on_the_mast_has_a_format_of_its_own() {
    let root = tempfile::tempdir().unwrap();
    for side in [0, 1] {
        let name = format!("PanCam/PanCam_{}_{side}.png", time(0));
        save_image(&root.path().join(name), (1280, 960), 9);
    }
    assert_eq!(detected(root.path()), ["katwijk-pancam"]);
    let source = (PAN_CAM.open)(root.path()).unwrap();
    assert!((source.rig().baseline - 0.5024).abs() < 1e-9 && source.sensors().is_none());
}

#[test]
fn what_is_broken_is_named_with_its_line() {
    let root = part();
    for (file, line, expected) in [
        ("imu.txt", "2015_11_26_12_00_00_000 1 2 3", "expected 10"),
        ("imu.txt", "12.5 0 0 0 0 0 0 0 0 0", "YYYY_MM_DD"),
        ("odometry.txt", "2015_11_26_12_00_00_000 1", "expected 34"),
        (
            "gps-utm31.txt",
            "2015_11_26_12_00_00_000 RTK_FIXED 52.2 x 4 0 0 0",
            "\"x\"",
        ),
        (
            "gps-utm31.txt",
            "2015_11_26_12_00_00_000 RTK_FIXED 5 1000 4 0 0 0",
            "neither",
        ),
    ] {
        let path = root.path().join(file);
        let before = std::fs::read_to_string(&path).unwrap();
        save_text(
            &path,
            &format!("{}\n{line}\n", before.lines().next().unwrap()),
        );
        let message = message(&FORMAT, root.path());
        let named = [file, "line 2", expected]
            .iter()
            .all(|part| message.contains(part));
        assert!(named, "{message}");
        save_text(&path, &before);
    }
}

#[test]
fn scans_are_read_by_the_rules_of_the_archive() {
    let root = tempfile::tempdir().unwrap();
    let grey = |sensor: RangeSensor, what: &str, value: &dyn Fn(u32, u32) -> u16| {
        let [width, height] = sensor.size().map(|n| n as u32);
        let image = image::ImageBuffer::from_fn(width, height, |x, y| image::Luma([value(x, y)]));
        let folder = root.path().join(sensor.folder());
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join(format!("{}_{}_{what}.png", sensor.folder(), time(15)));
        image.save(&path).unwrap();
        path
    };
    // Ten metres everywhere, all lasers to the left; the first column met nothing.
    let velodyne = RangeSensor::Velodyne;
    let ranges = grey(velodyne, "range", &|x, _| if x == 0 { 0 } else { 10_000 });
    grey(velodyne, "azimuth", &|_, _| 9000);
    let found = velodyne.scans(root.path()).unwrap();
    assert_eq!(found, [(tables::stamp(&time(15)).unwrap(), ranges.clone())]);
    let scan = velodyne.read(&ranges).unwrap();
    assert_eq!(
        (scan.width, scan.height, &scan.intensity),
        (1808, 16, &None)
    );
    assert_eq!(scan.points[1808 * 3], None);
    // The third row looks 11 degrees up, the last 15 down.
    let (up, down) = (11.0_f64.to_radians(), -15.0_f64.to_radians());
    for (row, angle) in [(2, up), (15, down)] {
        let p = scan.points[1808 * row + 7].unwrap().coords;
        let expected = Vector3::new(0.0, 10.0 * angle.cos(), 10.0 * angle.sin());
        assert!((p - expected).norm() < 1e-9, "{p}");
    }
    // Half of the reach straight ahead; the largest counts are no ranges.
    let tof = RangeSensor::Tof;
    let ranges = grey(tof, "range", &|x, _| if x < 2 { 16380 } else { 8192 });
    grey(tof, "intensity", &|_, y| y as u16);
    let scan = tof.read(&ranges).unwrap();
    assert_eq!(scan.points[176 * 9 + 1], None);
    let ahead = scan.points[176 * 72 + 88].unwrap();
    assert!((ahead.coords.norm() - 9.99308193 / 2.0).abs() < 1e-9);
    assert!(ahead.z > 4.99 && ahead.x > 0.0 && ahead.y > 0.0);
    // A ray at the right border, half a pixel inside 34.5 degrees.
    let right = scan.points[176 * 72 + 175].unwrap();
    let tangent = 34.5_f64.to_radians().tan() * 87.5 / 88.0;
    assert!((right.x / right.z - tangent).abs() < 1e-9);
    assert_eq!(scan.intensity.unwrap()[176 * 140], 140);
    assert!(tof.T_sensor_cam(root.path()).unwrap().is_none());

    let named = |error: DataError, part: &str| {
        let message = error.to_string();
        assert!(message.contains(part), "{message}");
    };
    named(velodyne.read(&ranges).unwrap_err(), "1808 x 16");
    std::fs::remove_file(
        root.path()
            .join(format!("Velodyne/Velodyne_{}_azimuth.png", time(15))),
    )
    .unwrap();
    named(velodyne.read(&found[0].1).unwrap_err(), "azimuth");
}
