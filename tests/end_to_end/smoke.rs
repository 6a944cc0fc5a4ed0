//! Training on the CPU for a few dozen steps, on every CPU device: the loss falls, the network is
//! exported, and ONNX Runtime agrees with Burn on the trained weights.

use crate::program::{barchan, json, rendered, text};
use barchan_datasets::disparity_file;

fn train_export_and_compare(device: &str, steps: usize) {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 6);
    let run = dir.path().join("run");
    let steps_text = steps.to_string();
    let summary = json(&[
        "train",
        "--data",
        text(&data),
        "--steps",
        &steps_text,
        "--epochs",
        "100",
        "--lr",
        "1e-3",
        "--crop",
        "64",
        "96",
        "--max-disparity",
        "32",
        "--device",
        device,
        "--out",
        text(&run),
    ]);
    let before = summary["photometric_before"].as_f64().unwrap();
    let after = summary["photometric_after"].as_f64().unwrap();
    assert!(
        after < before,
        "{device}: held-out photometric loss {before} before, {after} after"
    );

    let log = std::fs::read_to_string(run.join("log.jsonl")).unwrap();
    let losses: Vec<f64> = log
        .lines()
        .filter_map(|l| {
            // Lines of a validation have no loss.
            serde_json::from_str::<serde_json::Value>(l).unwrap()["loss"].as_f64()
        })
        .collect();
    assert_eq!(losses.len(), steps);
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (first, last) = (
        mean(&losses[..steps / 4]),
        mean(&losses[steps - steps / 4..]),
    );
    assert!(
        last < first,
        "{device}: loss {first} in the first quarter, {last} in the last"
    );

    let onnx = dir.path().join("net.onnx");
    barchan()
        .args(["export", text(&run), "--out", text(&onnx)])
        .assert()
        .success();
    let frames = 6;
    for (model, out) in [(text(&run), "burn"), (text(&onnx), "onnx")] {
        let out = dir.path().join(out);
        let summary = json(&[
            "infer",
            "--data",
            text(&data),
            "--model",
            model,
            "--no-reject",
            "--outlines",
            "0",
            "--out",
            text(&out),
        ]);
        assert_eq!(summary["frames"], frames);
        assert_eq!(summary["density"], 1.0);
    }
    let mut differences = Vec::new();
    for frame in 0..frames {
        let read = |engine: &str| {
            disparity_file::read(
                &dir.path()
                    .join(format!("{engine}/disparity/{frame:06}.pfm")),
            )
            .unwrap()
        };
        differences.extend(
            read("burn")
                .iter()
                .zip(read("onnx").iter())
                .map(|(a, b)| (a - b).abs()),
        );
    }
    differences.sort_by(f32::total_cmp);
    let (median, maximum) = (
        differences[differences.len() / 2],
        differences[differences.len() - 1],
    );
    println!(
        "{device}: ONNX Runtime against Burn: median {median:.2e} px, maximum {maximum:.2e} px"
    );
    assert!(
        median <= 1e-3 && maximum <= 1e-2,
        "{device}: median {median} px, maximum {maximum} px"
    );
}

#[test]
fn flex() {
    train_export_and_compare("flex", 40);
}

#[test]
fn ndarray() {
    train_export_and_compare("ndarray", 24);
}

/// In builds with libtorch (`make tch`).
#[cfg(feature = "tch")]
#[test]
fn tch() {
    train_export_and_compare("tch", 40);
}
