//! Training that is killed, interrupted or poisoned.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::program::{barchan, rendered, text};

/// Steps of a run that is killed.
const STEPS: usize = 24;

/// A run small enough to be killed often, with everything a checkpoint must hold: averaged weights,
/// a rate that drops on the way, flips and asymmetric colours.
fn arguments(data: &Path, out: &Path) -> Vec<String> {
    let words = [
        "train --epochs 9 --drop-epoch 3 --crop 64 96 --max-disparity 32 --batch 1 --average 0.9",
        "--checkpoint-every 3 --validate-every 7 --flip-swap 0.5 --flip-vertical 0.5 --asymmetric 0.5 --blur 1",
        &format!("--steps {STEPS} --data {} --out {}", text(data), text(out)),
    ];
    words
        .iter()
        .flat_map(|w| w.split(' '))
        .map(str::to_owned)
        .collect()
}

fn spawn(args: &[String]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_barchan"))
        .args(args)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Lines of the log of a run.
fn lines(run: &Path) -> usize {
    std::fs::read_to_string(run.join("log.jsonl")).map_or(0, |log| log.lines().count())
}

/// Waits until the log has `more` lines more than now, or the process has ended.
fn wait_for_lines(child: &mut Child, run: &Path, more: usize) -> bool {
    let (start, deadline) = (lines(run), Instant::now() + Duration::from_secs(300));
    while lines(run) < start + more {
        if child.try_wait().unwrap().is_some() {
            return false;
        }
        assert!(Instant::now() < deadline, "no further line in the log");
        std::thread::sleep(Duration::from_millis(2));
    }
    true
}

/// The log without what depends on the clock.
fn log(run: &Path) -> Vec<serde_json::Value> {
    std::fs::read_to_string(run.join("log.jsonl"))
        .unwrap()
        .lines()
        .map(|line| {
            let mut value: serde_json::Value = serde_json::from_str(line).unwrap();
            for clock in ["seconds", "waited"] {
                value.as_object_mut().unwrap().remove(clock);
            }
            value
        })
        .collect()
}

fn weights(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("weights.safetensors")).unwrap()
}

struct Case {
    dir: tempfile::TempDir,
    data: PathBuf,
}

impl Case {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let data = rendered(dir.path(), 12);
        Self { dir, data }
    }

    fn run(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn uninterrupted(&self) -> PathBuf {
        let run = self.run("whole");
        barchan()
            .args(arguments(&self.data, &run))
            .assert()
            .success();
        run
    }
}

#[test]
fn killed_at_any_moment_it_comes_to_the_same_weights() {
    let case = Case::new();
    let whole = case.uninterrupted();
    let run = case.run("killed");
    let resume: Vec<String> = ["train", "--resume", text(&run)].map(str::to_owned).into();
    // Numbers as from dice: Lehmer's generator.
    let mut state = 20_211_u64;
    let mut dice = |sides: u64| {
        state = state * 48_271 % 0x7fff_ffff;
        state % sides
    };
    let mut kills = 0;
    for round in 0..60 {
        let started = run.join("config.toml").exists();
        let args = if started {
            resume.clone()
        } else {
            arguments(&case.data, &run)
        };
        let mut child = spawn(&args);
        // Some lines on, and then anywhere in a step, a checkpoint or a validation; in the first
        // round before there is anything.
        let more = if round == 0 { 0 } else { 1 + dice(6) as usize };
        let alive = wait_for_lines(&mut child, &run, more);
        std::thread::sleep(Duration::from_micros(dice(80_000)));
        if alive && child.try_wait().unwrap().is_none() {
            child.kill().unwrap();
            child.wait().unwrap();
            kills += 1;
            continue;
        }
        let ended = child.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert!(ended.status.success(), "after {kills} kills: {said}");
        break;
    }
    assert!(kills >= 4, "only {kills} kills before the end");
    assert_eq!(log(&whole), log(&run), "after {kills} kills");
    assert!(
        weights(&whole) == weights(&run),
        "after {kills} kills there are other weights"
    );
}

#[test]
fn ctrl_c_saves_and_says_how_to_go_on() {
    let case = Case::new();
    let whole = case.uninterrupted();
    let run = case.run("stopped");
    for signal in ["INT", "TERM"] {
        let args = if signal == "INT" {
            arguments(&case.data, &run)
        } else {
            ["train", "--resume", text(&run)].map(str::to_owned).into()
        };
        let mut child = spawn(&args);
        assert!(wait_for_lines(&mut child, &run, 5));
        let sent = Command::new("kill")
            .args(["-s", signal, &child.id().to_string()])
            .status()
            .unwrap();
        assert!(sent.success());
        let ended = child.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.status.code(), Some(130), "{said}");
        assert!(
            said.contains("--resume") && said.contains(text(&run)),
            "{said}"
        );
        // No step is lost: the checkpoint is that of the last line.
        let last = log(&run).last().unwrap()["step"].as_u64().unwrap();
        assert!(run.join(format!("checkpoints/{last:08}/net.bpk")).exists());
    }
    barchan()
        .args(["train", "--resume", text(&run)])
        .assert()
        .success();
    assert_eq!(log(&whole), log(&run));
    assert!(weights(&whole) == weights(&run), "there are other weights");
}

#[test]
fn what_is_no_number_stops_it_and_is_named() {
    let case = Case::new();
    let run = case.run("wild");
    let mut args = arguments(&case.data, &run);
    args.extend(["--lr".into(), "1e38".into()]);
    let ended = barchan().args(&args).output().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(2), "{said}");
    for word in ["step ", "0000", text(&case.data), "--lr"] {
        assert!(said.contains(word), "\"{word}\" is not in: {said}");
    }
    assert!(!said.contains("panicked"), "{said}");
    assert!(!run.exists(), "half of a run is left");
}

#[test]
fn a_failed_run_leaves_other_peoples_files() {
    let case = Case::new();
    let run = case.run("mine");
    std::fs::create_dir(&run).unwrap();
    std::fs::write(run.join("thesis.txt"), "years of work").unwrap();
    let mut args = arguments(&case.data, &run);
    args.extend(["--lr".into(), "1e38".into()]);
    assert_eq!(
        barchan().args(&args).output().unwrap().status.code(),
        Some(2)
    );
    let left: Vec<_> = run
        .read_dir()
        .unwrap()
        .map(|e| e.unwrap().file_name())
        .collect();
    assert_eq!(left, ["thesis.txt"]);
}
