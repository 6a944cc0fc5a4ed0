//! The methods of `barchan slam` beside stereo, and all of them side by side.

use std::path::Path;

use crate::program::{json, refused, rendered, text};

/// What a run of any method leaves.
const FILES: [&str; 9] = [
    "config.toml",
    "keyframes.csv",
    "keyframes.tum",
    "log.jsonl",
    "map.ply",
    "rig.toml",
    "summary.json",
    "trajectory.kitti",
    "trajectory.tum",
];

fn slam(data: &Path, out: &Path, more: &[&str]) -> serde_json::Value {
    let mut command = vec![
        "slam",
        "--data",
        text(data),
        "--model",
        "bm",
        "--out",
        text(out),
    ];
    command.extend_from_slice(more);
    let summary = json(&command);
    for file in FILES {
        assert!(out.join(file).is_file(), "{more:?}: no {file}");
    }
    summary
}

#[test]
fn every_method_leaves_a_run_that_the_other_commands_take() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 12);
    let run = |name: &str| dir.path().join(name);

    let icp = slam(&data, &run("icp"), &["--method", "icp"]);
    assert_eq!((&icp["frames"], &icp["tracked"]), (&12.into(), &12.into()));
    // The truth in units of half a metre stands for structure from motion.
    let truth = std::fs::read_to_string(data.join("groundtruth.tum")).unwrap();
    let halved: String = (truth.lines().filter(|l| !l.starts_with('#')))
        .map(|line| {
            let numbers: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
            let scaled = |(k, n): (usize, &f64)| if (1..4).contains(&k) { 2.0 * n } else { *n };
            let words: Vec<String> = numbers
                .iter()
                .enumerate()
                .map(|n| scaled(n).to_string())
                .collect();
            words.join(" ") + "\n"
        })
        .collect();
    let poses = run("poses.tum");
    std::fs::write(&poses, halved).unwrap();
    let more = ["--method", "combined", "--poses", text(&poses)];
    let combined = slam(&data, &run("combined"), &more);
    let factor = combined["scale"]["factor"].as_f64().unwrap();
    assert!((factor - 0.5).abs() < 0.02, "{factor}");

    for name in ["icp", "combined"] {
        let map = run(&format!("{name}-map"));
        // Small images know little of the ground well: voxels of the default size would be few.
        let made = json(&[
            "map",
            text(&run(name)),
            "--voxel",
            "0.05",
            "--out",
            text(&map),
        ]);
        assert!(made["voxels"].as_u64().unwrap() > 1000);
        json(&["report", text(&run(name)), "--map", text(&map)]);
        let estimate = run(name).join("trajectory.tum");
        let gt = data.join("groundtruth.tum");
        let score = json(&[
            "eval",
            "trajectory",
            "--est",
            text(&estimate),
            "--gt",
            text(&gt),
        ]);
        let share = score["ate_rmse"].as_f64().unwrap() / score["length"].as_f64().unwrap();
        assert!(share < 0.1, "{name}: {score}");
    }
    // Its settings come back as they went.
    let config = run("icp").join("config.toml");
    let more = ["--method", "icp", "--config", text(&config)];
    slam(&data, &run("again"), &more);
    assert_eq!(
        std::fs::read(config).unwrap(),
        std::fs::read(run("again").join("config.toml")).unwrap()
    );
}

#[test]
fn methods_side_by_side_in_one_table() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 8);
    let (earlier, out) = (dir.path().join("earlier"), dir.path().join("compare"));
    slam(&data, &earlier, &["--method", "icp"]);
    let given = format!("earlier={}", text(&earlier));
    let found = json(&[
        "compare",
        "--data",
        text(&data),
        "--method",
        "stereo",
        "--method",
        "icp",
        "--model",
        "bm",
        "--run",
        &given,
        "--out",
        text(&out),
    ]);
    let rows = found["rows"].as_array().unwrap();
    let names: Vec<&str> = rows.iter().map(|r| r["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["earlier", "stereo-bm", "icp-bm"]);
    for row in rows {
        assert_eq!(row["failed"], "", "{row}");
        assert_eq!(row["frames"], 8);
        for key in [
            "ate",
            "ate_percent",
            "drift_percent",
            "map_rmse",
            "coverage_percent",
            "ms",
        ] {
            assert!(row[key].as_f64().is_some_and(|v| v >= 0.0), "{key}: {row}");
        }
        assert!(
            row["map_rmse"].as_f64().unwrap() < 0.1
                && row["coverage_percent"].as_f64().unwrap() > 20.0
        );
    }
    // The same run twice has the same figures.
    assert_eq!(rows[0]["ate"], rows[2]["ate"]);
    assert_eq!(rows[0]["map_rmse"], rows[2]["map_rmse"]);
    for file in [
        "compare.txt",
        "compare.json",
        "routes.svg",
        "maps.svg",
        "disparities.svg",
        "maps/icp-bm.png",
    ] {
        assert!(out.join(file).is_file(), "no {file}");
    }
    assert!(out.join("runs/stereo-bm/trajectory.tum").is_file());
}

#[test]
fn what_says_nothing_to_a_method_is_refused() {
    let slam = [
        "slam",
        "--data",
        "synth:frames=2",
        "--model",
        "bm",
        "--out",
        "none",
    ];
    let with = |more: &[&str]| refused(&[&slam[..], more].concat());
    assert!(with(&["--method", "icp", "--no-loops"]).contains("--method stereo"));
    assert!(with(&["--poses", "x.tum"]).contains("--method combined"));
    assert!(!Path::new("none").exists());
    let twice = ["compare", "--data", "synth:frames=2", "--out", "none"];
    let named = |name: &str| refused(&[&twice[..], &["--run", name]].concat());
    assert!(named("fused").contains("NAME=DIR"));
    assert!(named("../x=y").contains("letters"));
}
