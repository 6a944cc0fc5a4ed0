//! Bad input: a plain message that names the file, exit status 2, nothing half-written.

use std::path::{Path, PathBuf};

use crate::program::{barchan, refused, rendered, text};

struct Case {
    dir: tempfile::TempDir,
    data: PathBuf,
}

impl Case {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let data = rendered(dir.path(), 4);
        Self { dir, data }
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("out")
    }

    /// Every command that reads data refuses it, names `wanted`, and leaves nothing behind.
    fn every_reader_refuses(&self, data: &Path, wanted: &[&str]) {
        let out = self.out();
        for command in [vec!["infer"], vec!["slam"], vec!["train", "--epochs", "1"]] {
            let args = [command, vec!["--data", text(data), "--out", text(&out)]].concat();
            let message = refused(&args);
            for word in wanted {
                assert!(
                    message.contains(word),
                    "{args:?}: \"{word}\" is not in: {message}"
                );
            }
            let left: Vec<String> = self
                .dir
                .path()
                .read_dir()
                .unwrap()
                .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
                .filter(|n| n.starts_with("out"))
                .collect();
            assert!(left.is_empty(), "{args:?} left {left:?}");
        }
    }
}

#[test]
fn a_missing_folder() {
    let case = Case::new();
    let nowhere = case.dir.path().join("nowhere");
    case.every_reader_refuses(&nowhere, &["nowhere"]);
}

#[test]
fn one_image_missing() {
    let case = Case::new();
    std::fs::remove_file(case.data.join("right/000002.png")).unwrap();
    case.every_reader_refuses(&case.data, &["000002"]);
}

#[test]
fn two_sizes() {
    let case = Case::new();
    let path = case.data.join("right/000001.png");
    image::open(&path)
        .unwrap()
        .crop_imm(0, 0, 100, 90)
        .save(&path)
        .unwrap();
    case.every_reader_refuses(&case.data, &["000001.png", "100", "192"]);
}

#[test]
fn a_truncated_png() {
    let case = Case::new();
    let path = case.data.join("left/000003.png");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    case.every_reader_refuses(&case.data, &["000003.png"]);
}

#[test]
fn a_zero_baseline() {
    let case = Case::new();
    let path = case.data.join("rig.toml");
    let rig = std::fs::read_to_string(&path).unwrap();
    let line = rig.lines().find(|l| l.starts_with("baseline")).unwrap();
    std::fs::write(&path, rig.replace(line, "baseline = 0.0")).unwrap();
    case.every_reader_refuses(&case.data, &["rig.toml", "baseline"]);
}

#[test]
fn not_an_onnx() {
    let case = Case::new();
    let model = case.dir.path().join("model.onnx");
    std::fs::write(&model, b"this is no network").unwrap();
    let out = case.out();
    for command in ["infer", "slam"] {
        let message = refused(&[
            command,
            "--data",
            text(&case.data),
            "--model",
            text(&model),
            "--out",
            text(&out),
        ]);
        assert!(
            message.contains("model.onnx") && message.contains("cure"),
            "{message}"
        );
        assert!(!out.exists());
    }
}

#[test]
fn weights_that_are_none() {
    let case = Case::new();
    let model = case.dir.path().join("model.safetensors");
    std::fs::write(&model, b"neither are these").unwrap();
    let onnx = case.dir.path().join("x.onnx");
    let message = refused(&["export", text(&model), "--out", text(&onnx)]);
    assert!(
        message.contains("model.safetensors") && message.contains("cure"),
        "{message}"
    );
    assert!(!onnx.exists());
}

#[test]
fn a_run_that_is_none() {
    let case = Case::new();
    let message = refused(&["map", text(&case.data), "--out", text(&case.out())]);
    assert!(
        message.contains("keyframes.tum") && message.contains("barchan slam"),
        "{message}"
    );
    assert!(!case.out().exists());
}

#[test]
fn other_peoples_files_are_not_replaced() {
    let case = Case::new();
    let out = case.out();
    std::fs::create_dir(&out).unwrap();
    std::fs::write(out.join("thesis.txt"), "years of work").unwrap();
    let message = refused(&["infer", "--data", text(&case.data), "--out", text(&out)]);
    assert!(message.contains("--out"), "{message}");
    assert_eq!(
        std::fs::read_to_string(out.join("thesis.txt")).unwrap(),
        "years of work"
    );
}

#[test]
fn a_run_is_not_overwritten() {
    let case = Case::new();
    let run = case.out();
    let args = [
        "train",
        "--data",
        text(&case.data),
        "--steps",
        "1",
        "--crop",
        "64",
        "64",
        "--out",
        text(&run),
    ];
    barchan().args(args).assert().success();
    let before = std::fs::read(run.join("weights.safetensors")).unwrap();
    let message = refused(&args);
    assert!(message.contains("--resume"), "{message}");
    assert_eq!(
        std::fs::read(run.join("weights.safetensors")).unwrap(),
        before
    );
}

#[test]
fn a_matcher_with_no_range() {
    let case = Case::new();
    for model in ["sgm:x", "sgm:0", "bm:99999"] {
        let (data, out) = (text(&case.data), case.out());
        let args = [
            "infer",
            "--data",
            data,
            "--model",
            model,
            "--out",
            text(&out),
        ];
        let message = refused(&args);
        assert!(
            message.contains(model) && message.contains("1 to 2048"),
            "{message}"
        );
        assert!(!out.exists());
    }
}

#[test]
fn a_report_of_what_is_no_run() {
    let case = Case::new();
    let message = refused(&["report", text(&case.data)]);
    assert!(
        message.contains("trajectory.tum") && message.contains("barchan slam"),
        "{message}"
    );
    assert!(!case.data.join("report.html").exists());
}
