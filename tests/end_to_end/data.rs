//! `data info | check | rectify | rig`: what a user does with pairs before anything else.

use std::path::Path;

use crate::program::{barchan, json, refused, text};

/// A rendered sequence long enough to be checked.
fn sequence(dir: &Path) -> std::path::PathBuf {
    let data = dir.join("data");
    barchan()
        .args([
            "data",
            "synth",
            "synth:seed=5,frames=16,width=224,height=160",
        ])
        .args(["--out", text(&data)])
        .assert()
        .success();
    data
}

fn check(data: &Path, flags: &[&str], status: i32) -> serde_json::Value {
    let picture = data.with_extension("png");
    let output = barchan()
        .args([
            "data",
            "check",
            text(data),
            "--json",
            "--picture",
            text(&picture),
        ])
        .args(flags)
        .output()
        .unwrap();
    assert_eq!(
        output.status.code(),
        Some(status),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(image::open(&picture).is_ok());
    serde_json::from_slice(&output.stdout).unwrap()
}

fn faults(report: &serde_json::Value) -> Vec<&str> {
    let findings = report["findings"].as_array().unwrap();
    findings
        .iter()
        .map(|f| f["fault"].as_str().unwrap())
        .collect()
}

#[test]
fn swapped_images_stop_a_command_until_they_are_mended() {
    let dir = tempfile::tempdir().unwrap();
    let data = sequence(dir.path());
    assert!(faults(&check(&data, &[], 0)).is_empty());
    let (left, right, aside) = (data.join("left"), data.join("right"), data.join("aside"));
    std::fs::rename(&left, &aside).unwrap();
    std::fs::rename(&right, &left).unwrap();
    std::fs::rename(&aside, &right).unwrap();
    // The truth is that of the other camera now.
    std::fs::remove_dir_all(data.join("disparity")).unwrap();

    assert_eq!(faults(&check(&data, &[], 1)), ["swapped"]);
    let out = dir.path().join("out");
    let infer = ["infer", "--data", text(&data), "--out", text(&out)];
    let message = refused(&infer);
    assert!(
        message.contains("swapped") && message.contains("--fix"),
        "{message}"
    );
    assert!(!out.exists());

    assert_eq!(faults(&check(&data, &["--fix"], 0)), ["swapped"]);
    assert!(faults(&check(&data, &[], 0)).is_empty());
    assert_eq!(json(&infer)["frames"], 16);
    // Measured anew, not on top of the correction.
    assert_eq!(faults(&check(&data, &["--fix"], 0)), ["swapped"]);

    let rectified = dir.path().join("rectified");
    barchan()
        .args(["data", "rectify", text(&data), "--out", text(&rectified)])
        .assert()
        .success();
    assert!(!rectified.join("correction.toml").exists());
    assert!(faults(&check(&rectified, &[], 0)).is_empty());
}

#[test]
fn a_slip_of_the_right_images_is_mended_by_shifting_them_back() {
    let dir = tempfile::tempdir().unwrap();
    let data = sequence(dir.path());
    // Every right image becomes that of two frames earlier.
    for index in (2..16).rev() {
        let name = |i: usize| data.join(format!("right/{i:06}.png"));
        std::fs::copy(name(index - 2), name(index)).unwrap();
    }
    let report = check(&data, &["--fix"], 0);
    assert_eq!(faults(&report), ["slipped"]);
    assert_eq!(report["correction"]["right_frame_shift"], 2);
    assert!(faults(&check(&data, &[], 0)).is_empty());
    let info = json(&[
        "data",
        "info",
        text(&data),
        "--picture",
        text(&dir.path().join("i.png")),
    ]);
    assert_eq!(info["frames"], 14);
    assert_eq!(info["true_disparity"], true);

    std::fs::write(data.join("correction.toml"), "right_frame_shift = 99\n").unwrap();
    let message = refused(&["data", "info", text(&data)]);
    assert!(message.contains("correction.toml"), "{message}");
}

#[test]
fn info_tells_what_there_is_and_draws_it() {
    let dir = tempfile::tempdir().unwrap();
    let picture = dir.path().join("sheet.png");
    let info = json(&[
        "data",
        "info",
        "synth:seed=2,frames=5,width=128,height=96",
        "--picture",
        text(&picture),
    ]);
    assert_eq!(
        (&info["frames"], &info["rig"]["width"]),
        (&5.into(), &128.into())
    );
    assert!(info["true_path"].as_f64().unwrap() > 0.1);
    let [near, far] = [0, 2].map(|k| info["depth"][k].as_f64().unwrap());
    assert!(0.3 < near && near < far, "{near} {far}");
    // Left, right and truth in five rows.
    assert_eq!(image::open(&picture).unwrap().width(), 1200);
}

#[test]
fn the_calibration_of_another_tool_becomes_a_rig() {
    let dir = tempfile::tempdir().unwrap();
    let (calibration, rig) = (dir.path().join("calib.txt"), dir.path().join("rig.toml"));
    std::fs::write(
        &calibration,
        "cam0=[999.4 0 294.2; 0 999.4 252.9; 0 0 1]\ncam1=[999.4 0 326.9; 0 999.4 252.9; 0 0 1]\ndoffs=32.7\nbaseline=193.0\nwidth=741\nheight=497\nndisp=70\n",
    )
    .unwrap();
    let made = json(&["data", "rig", text(&calibration), "--out", text(&rig)]);
    assert!((made["baseline"].as_f64().unwrap() - 0.193).abs() < 1e-9);
    assert!(std::fs::read_to_string(&rig).unwrap().contains("741"));
    let message = refused(&[
        "data",
        "rig",
        text(&dir.path().join("absent.yaml")),
        "--out",
        text(&rig),
    ]);
    assert!(message.contains("absent.yaml"), "{message}");
}

#[test]
fn synth_writes_a_traverse_with_its_ground_or_random_scenes() {
    let dir = tempfile::tempdir().unwrap();
    let (drive, shapes) = (dir.path().join("drive"), dir.path().join("shapes"));
    let spec = "synth:seed=4,frames=2,width=96,height=64";
    json(&["data", "synth", spec, "--out", text(&drive)]);
    for name in [
        "left/000001.png",
        "disparity_right/000001.png",
        "occlusion/000001.png",
        "rocks.csv",
        "imu.csv",
        "dem.tif",
    ] {
        assert!(drive.join(name).is_file(), "{name}");
    }
    let hillshade = dir.path().join("hillshade.tif");
    barchan()
        .args(["raster", "hillshade", text(&drive.join("dem.tif"))])
        .args(["--out", text(&hillshade)])
        .assert()
        .success();
    json(&[
        "data",
        "synth",
        spec,
        "--random-scenes",
        "--out",
        text(&shapes),
    ]);
    assert!(shapes.join("disparity/000001.png").is_file());
    assert!(!shapes.join("dem.tif").exists());
    let message = refused(&[
        "data",
        "synth",
        text(&drive),
        "--random-scenes",
        "--out",
        "x",
    ]);
    assert!(message.contains("--random-scenes"), "{message}");
}

#[test]
fn scans_of_a_beach_become_clouds() {
    let dir = tempfile::tempdir().unwrap();
    let part = dir.path().join("part1");
    let spec = "synth:seed=5,frames=3,width=96,height=64,rectified=false";
    json(&[
        "data",
        "synth",
        spec,
        "--layout",
        "katwijk",
        "--out",
        text(&part),
    ]);
    let out = dir.path().join("scans");
    let scans = |more: &[&str]| {
        let args = ["data", "scans", text(&part), "--out", text(&out)];
        json(&[&args[..], more].concat())
    };
    let found = scans(&[]);
    assert_eq!(found[0]["sensor"], "ToF");
    assert_eq!(found[1]["sensor"], "Velodyne");
    for sensor in [&found[0], &found[1]] {
        assert_eq!(sensor["scans"], 3);
        assert!(sensor["points"].as_u64().unwrap() > 3000, "{sensor}");
    }
    let cloud = out.join("velodyne/Velodyne_2015_11_26_12_00_00_200.ply");
    assert!(cloud.is_file() && out.join("tof/ToF_2015_11_26_12_00_00_000.ply").is_file());

    // A camera that stands still from noon on: two of three scans lie between its poses.
    let poses = dir.path().join("poses.tum");
    std::fs::write(
        &poses,
        "1448539200 0 0 0 0 0 0 1\n1448539200.3 0 0 0 0 0 0 1\n",
    )
    .unwrap();
    let joined = scans(&["--poses", text(&poses), "--voxel", "0.1"]);
    assert_eq!(joined[1]["scans"], 2);
    let points = |summary: &serde_json::Value| summary["points"].as_u64().unwrap();
    assert!(points(&joined[1]) > 500 && points(&joined[1]) < points(&found[1]));
    assert!(out.join("velodyne.ply").is_file());

    std::fs::remove_file(part.join("tof.tum")).unwrap();
    let args = ["data", "scans", text(&part), "--out", text(&out)];
    let message = refused(&[&args[..], &["--poses", text(&poses)]].concat());
    assert!(message.contains("tof.tum"), "{message}");
    let message = refused(&["data", "scans", text(&out), "--out", text(&part)]);
    assert!(message.contains("Velodyne_TIME_range.png"), "{message}");
}
