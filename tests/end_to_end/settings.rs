//! The settings of training: defaults, a file, flags; and what a run shows on the way.

use std::path::Path;

use crate::program::{barchan, json, refused, rendered, text};

fn config(run: &Path) -> toml::Table {
    std::fs::read_to_string(run.join("config.toml"))
        .unwrap()
        .parse()
        .unwrap()
}

/// Starts a run and stops it after its first step; the settings it wrote down.
fn settings(data: &Path, name: &str, more: &[&str]) -> toml::Table {
    let run = data.parent().unwrap().join(name);
    barchan()
        .args(["train", "--data", text(data), "--out", text(&run)])
        .args(["--steps", "1"])
        .args(more)
        .assert()
        .success();
    config(&run)
}

#[test]
fn the_papers_settings_by_default_then_a_file_then_flags() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 3);
    let number = |table: &toml::Table, section: &str, key: &str| {
        let value = &table[section][key];
        value
            .as_float()
            .or(value.as_integer().map(|i| i as f64))
            .unwrap()
    };

    let plain = settings(&data, "plain", &[]);
    assert_eq!(plain["crop"], toml::Value::from(vec![256, 512]));
    assert_eq!(number(&plain, "schedule", "epochs"), 10.0);
    assert_eq!(number(&plain, "schedule", "lr"), 1e-3);
    assert_eq!(number(&plain, "schedule", "drop_epoch"), 7.0);

    let fine = settings(&data, "fine", &["--finetune"]);
    assert_eq!(fine["crop"], toml::Value::from(vec![320, 384]));
    assert_eq!(number(&fine, "schedule", "epochs"), 1.0);
    assert_eq!(number(&fine, "schedule", "lr"), 1e-4);
    assert_eq!(fine["init"].as_str(), Some("rover"));

    // A run's own settings, changed by a part of a file and by flags.
    let whole = dir.path().join("fine/config.toml");
    let again = settings(&data, "again", &["--config", text(&whole)]);
    assert_eq!(again, fine);
    let part = dir.path().join("part.toml");
    std::fs::write(&part, "crop = [64, 96]\n[schedule]\nlr = 0.002\n").unwrap();
    let more = [
        "--config",
        text(&part),
        "--crop",
        "96",
        "64",
        "--set",
        "loss.ssim=0.5",
        "--set",
        "device=ndarray",
        "--supervised",
    ];
    let mixed = settings(&data, "mixed", &more);
    assert_eq!(mixed["crop"], toml::Value::from(vec![96, 64]));
    assert_eq!(number(&mixed, "schedule", "lr"), 0.002);
    assert_eq!(number(&mixed, "loss", "ssim"), 0.5);
    assert_eq!(mixed["device"].as_str(), Some("ndarray"));
    assert_eq!(number(&mixed, "augmentation", "disparity"), 48.0);
}

#[test]
fn wrong_settings_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("my.toml");
    let out = dir.path().join("run");
    std::fs::write(&file, "seed = 3\n[schedule]\nlearning = 1\n").unwrap();
    let train = |more: &[&str]| refused(&[&["train", "--out", text(&out)], more].concat());
    let message = train(&["--config", text(&file)]);
    for word in ["my.toml", "line 3", "learning", "epochs"] {
        assert!(message.contains(word), "\"{word}\" is not in: {message}");
    }
    assert!(train(&["--config", "nowhere.toml"]).contains("nowhere.toml"));
    assert!(train(&["--set", "loss.colour=1"]).contains("colour"));
    assert!(train(&["--set", "loss"]).contains("KEY=VALUE"));
    assert!(train(&["--erase", "2"]).contains("erase"));
    assert!(train(&["--average", "1"]).contains("average"));
    assert!(!out.exists());
}

#[test]
fn a_device_that_is_not_there_is_refused_with_the_cure() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    for device in ["tch", "vulkan"] {
        // Builds that have it, on machines that have it, train.
        let works = json(&["doctor"]).as_array().unwrap().iter().any(|check| {
            check["name"] == format!("train --device {device}") && check["works"] == true
        });
        if !works {
            let message = refused(&["train", "--device", device, "--out", text(&out)]);
            assert!(
                message.contains(device) && message.contains("cure"),
                "{message}"
            );
            assert!(!out.exists());
        }
    }
}

#[test]
fn held_out_pairs_are_scored_and_drawn_on_the_way() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 5);
    let run = dir.path().join("run");
    let summary = json(&[
        "train",
        "--data",
        text(&data),
        "--out",
        text(&run),
        "--supervised",
        "--steps",
        "6",
        "--epochs",
        "9",
        "--crop",
        "64",
        "96",
        "--validate-every",
        "2",
        "--max-disparity",
        "64",
    ]);
    let scored: Vec<serde_json::Value> = std::fs::read_to_string(run.join("log.jsonl"))
        .unwrap()
        .lines()
        .map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap())
        .filter(|v| !v["validation"].is_null())
        .collect();
    let steps: Vec<_> = scored.iter().map(|v| v["step"].as_u64().unwrap()).collect();
    assert_eq!(steps, [0, 2, 4, 6]);
    let error = |v: &serde_json::Value| v["validation"]["accuracy"]["epe"].as_f64().unwrap();
    let best = scored.iter().map(error).fold(f64::INFINITY, f64::min);
    assert_eq!(error(&summary["best"]), best);
    assert_eq!(summary["before"], scored[0]);
    assert_eq!(summary["after"], scored[3]);
    for step in steps {
        let picture = image::open(run.join(format!("samples/{step:08}.png"))).unwrap();
        assert_eq!((picture.width(), picture.height()), (4 * 192, 128));
    }
}
