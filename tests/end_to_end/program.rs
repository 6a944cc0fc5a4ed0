//! What the end-to-end tests share.

use std::path::{Path, PathBuf};

use assert_cmd::Command;

/// The program under test.
pub fn barchan() -> Command {
    Command::new(env!("CARGO_BIN_EXE_barchan"))
}

/// Runs it, demands success, and reads its JSON.
pub fn json(args: &[&str]) -> serde_json::Value {
    let output = barchan().args(args).arg("--json").output().unwrap();
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Runs it, demands exit status 2 and a plain message, which is returned.
pub fn refused(args: &[&str]) -> String {
    let output = barchan().args(args).output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    assert!(
        message.starts_with("error: ") || message.contains("\nerror: "),
        "{args:?}: {message}"
    );
    assert!(!message.contains("panicked"), "{args:?}: {message}");
    message
}

/// A rendered sequence in `folder` layout.
pub fn rendered(dir: &Path, frames: usize) -> PathBuf {
    let data = dir.join("data");
    let spec = format!("synth:seed=3,frames={frames},width=192,height=128");
    barchan()
        .args(["data", "synth", &spec, "--out", text(&data)])
        .assert()
        .success();
    data
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}
