//! Adapting to a stream, and going on with what was learned.

use crate::program::{barchan, json, refused, rendered, text};

#[test]
fn a_stream_is_matched_learned_from_and_its_weights_go_on() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 10);
    let [out, infer] = ["adapted", "infer"].map(|n| dir.path().join(n));
    let summary = json(&[
        "adapt",
        "--data",
        text(&data),
        "--model",
        "tiny:64",
        "--judge-every",
        "4",
        "--compare",
        "--out",
        text(&out),
    ]);
    assert_eq!(summary["pairs"], 10);
    let judged: u64 = ["learned", "kept", "forgotten"]
        .map(|k| summary[k].as_u64().unwrap())
        .iter()
        .sum();
    assert_eq!(judged, 2, "{summary}");
    let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap();
    let lines: Vec<serde_json::Value> = log
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(lines.len(), 10);
    // Before the first judgement the first weights are at work.
    for line in &lines[..4] {
        assert_eq!(line["photometric"], line["photometric_first"], "{line}");
    }
    for line in &lines {
        let name = line["frame"].as_str().unwrap();
        assert!(out.join(format!("disparity/{name}.png")).is_file());
    }

    let weights = out.join("weights.safetensors");
    barchan()
        .args(["infer", "--data", text(&data), "--model", text(&weights)])
        .args(["--out", text(&infer)])
        .assert()
        .success();

    let message = refused(&["adapt", "--model", "tiny", "--out", text(&out)]);
    assert!(message.contains("--data"), "{message}");
    let message = refused(&[
        "adapt",
        "--data",
        text(&data),
        "--model",
        "tiny:63",
        "--out",
        text(&out),
    ]);
    assert!(message.contains("multiple of 16"), "{message}");
}
