//! The main job on a rendered sequence with truth: train, export, infer, slam, map, eval.

use std::path::Path;

use barchan_datasets::disparity_file;

use crate::program::{barchan, json, rendered, text};

fn exists(dir: &Path, files: &[&str]) {
    for file in files {
        assert!(
            dir.join(file).exists(),
            "{} is missing in {}",
            file,
            dir.display()
        );
    }
}

#[test]
fn images_become_terrain() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 16);
    let [train, onnx, infer, slam, map] =
        ["train", "a.onnx", "infer", "slam", "map"].map(|n| dir.path().join(n));

    let trained = json(&[
        "train",
        "--data",
        text(&data),
        "--epochs",
        "1",
        "--finetune",
        "--preset",
        "tiny",
        "--out",
        text(&train),
    ]);
    assert!(
        trained["photometric_after"].as_f64() < trained["photometric_before"].as_f64(),
        "{trained}"
    );
    exists(
        &train,
        &[
            "config.toml",
            "log.jsonl",
            "summary.json",
            "weights.safetensors",
        ],
    );
    barchan()
        .args(["export", text(&train), "--out", text(&onnx)])
        .assert()
        .success();

    let inferred = json(&[
        "infer",
        "--data",
        text(&data),
        "--model",
        text(&onnx),
        "--out",
        text(&infer),
    ]);
    assert_eq!(inferred["frames"], 16);
    assert!(inferred["density"].as_f64().unwrap() > 0.5, "{inferred}");
    exists(
        &infer,
        &[
            "disparity/000000.png",
            "confidence/000000.png",
            "preview/000000.png",
            "cloud/000000.ply",
        ],
    );
    let score = json(&[
        "eval",
        "disparity",
        "--pred",
        text(&infer.join("disparity")),
        "--gt",
        text(&data),
    ]);
    assert!(
        score["estimated"]["bad2"].as_f64().unwrap() < 20.0,
        "{score}"
    );

    let tracked = json(&[
        "slam",
        "--data",
        text(&data),
        "--model",
        text(&onnx),
        "--out",
        text(&slam),
    ]);
    assert_eq!(tracked["tracked"], 16, "{tracked}");
    exists(
        &slam,
        &[
            "trajectory.tum",
            "trajectory.kitti",
            "keyframes.tum",
            "map.ply",
            "summary.json",
            "config.toml",
            "log.jsonl",
        ],
    );
    let gt = data.join("groundtruth.tum");
    let score = json(&[
        "eval",
        "trajectory",
        "--est",
        text(&slam.join("trajectory.tum")),
        "--gt",
        text(&gt),
    ]);
    let (ate, length) = (
        score["ate_rmse"].as_f64().unwrap(),
        score["length"].as_f64().unwrap(),
    );
    assert!(ate < 0.02 * length, "{score}");

    let mapped = json(&["map", text(&slam), "--out", text(&map)]);
    exists(&map, &["cloud.ply", "dem.tif", "hillshade.tif"]);
    assert!(mapped["voxels"].as_u64().unwrap() > 300, "{mapped}");

    // The hillshade of the map is that of its own DEM.
    let again = dir.path().join("again.tif");
    barchan()
        .args([
            "raster",
            "hillshade",
            text(&map.join("dem.tif")),
            "--out",
            text(&again),
        ])
        .assert()
        .success();
    let read = |path: &Path| barchan_terrain::Raster::<u8>::read(path).unwrap().values;
    assert_eq!(read(&map.join("hillshade.tif")), read(&again));
}

#[test]
fn a_demo_on_ones_own_images_ends_in_a_page() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 8);
    let out = dir.path().join("demo");
    let demo = ["demo", "--data", text(&data), "--out", text(&out)];
    let said = |args: &[&str], commands: &[&str]| {
        let output = barchan().args(args).assert().success();
        let said = String::from_utf8_lossy(&output.get_output().stdout).into_owned();
        for command in commands {
            let command = format!("barchan {command}");
            assert!(said.contains(&command), "{command}: {said}");
        }
        said
    };
    // Every step is a command that can be typed, and the images are offered to the network.
    let steps = ["data check", "slam --data", "map", "report"];
    let offer = said(&demo, &steps);
    assert!(offer.contains("--finetune --out"), "{offer}");
    said(
        &[&demo[..], &["--finetune"]].concat(),
        &[&["train --finetune"], &steps[..]].concat(),
    );
    exists(&out, &["train/weights.safetensors"]);
    exists(
        &out,
        &["slam/trajectory.tum", "map/cloud.ply", "report.html"],
    );
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    for part in ["<svg", "id=\"cloud\"", "id=\"relief\"", "data:image/jpeg"] {
        assert!(page.contains(part), "{part}");
    }

    // The same folder again, with what is known of the truth.
    let again = json(&[
        "report",
        text(&out),
        "--gt",
        text(&data.join("groundtruth.tum")),
        "--out",
        text(&dir.path().join("again.html")),
    ]);
    let again = std::fs::read_to_string(again["out"].as_str().unwrap()).unwrap();
    assert!(again.contains("error of the route"));
}

/// The files for those who run the network without this program.
#[test]
fn the_shipped_onnx_files_are_the_shipped_weights() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 1);
    let disparity = |model: &str| {
        let out = dir.path().join("infer");
        json(&[
            "infer",
            "--data",
            text(&data),
            "--model",
            model,
            "--outlines",
            "0",
            "--no-reject",
            "--out",
            text(&out),
        ]);
        let folder = out.join("disparity");
        disparity_file::read(&folder.join("000000.pfm")).unwrap()
    };
    let here = disparity("rover");
    let file = |name: &str| {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("checkpoints")
            .join(name)
    };
    for (name, most) in [("rover.onnx", 1e-3), ("rover-int8.onnx", 0.1)] {
        let there = disparity(text(&file(name)));
        let pixels = here.as_raw().iter().zip(there.as_raw());
        let mut apart: Vec<f32> = pixels.map(|(a, b)| (a - b).abs()).collect();
        apart.sort_by(f32::total_cmp);
        let median = apart[apart.len() / 2];
        assert!(
            median < most,
            "{name}: {median} px; `make onnx-weights` writes it anew"
        );
    }
}
