//! Ends at any moment, full disks, folders that cannot be written.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::program::{barchan, json, refused, rendered, text};

struct Case {
    dir: tempfile::TempDir,
    data: PathBuf,
}

impl Case {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let data = rendered(dir.path(), 6);
        Self { dir, data }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn slam(&self, out: &str) -> Vec<String> {
        let args = format!(
            "slam --model sgm:64 --no-check --data {} --out {}",
            text(&self.data),
            text(&self.path(out))
        );
        args.split(' ').map(str::to_owned).collect()
    }

    fn map(&self, run: &str, out: &str) -> Vec<String> {
        let args = format!(
            "map {} --out {}",
            text(&self.path(run)),
            text(&self.path(out))
        );
        args.split(' ').map(str::to_owned).collect()
    }

    /// What lies beside the data whose name starts so.
    fn left(&self, prefix: &str) -> Vec<String> {
        let entries = self.dir.path().read_dir().unwrap();
        let names = entries.map(|e| e.unwrap().file_name().into_string().unwrap());
        names.filter(|n| n.starts_with(prefix)).collect()
    }
}

/// Kills asked for by `make faults`.
fn kills() -> u64 {
    let asked = std::env::var("BARCHAN_KILLS").ok();
    asked.map_or(3, |n| n.parse().unwrap())
}

/// Runs the command again and again and kills it, each time at another moment; after each of them `out` is
/// what an earlier run of it finished.
fn killed_again_and_again(args: &[String], whole: &dyn Fn()) {
    let begun = Instant::now();
    barchan().args(args).assert().success();
    let duration = begun.elapsed();
    whole();
    let mut state = 20_211_u64;
    let mut killed = 0;
    for _ in 0..kills() {
        let mut child = Command::new(env!("CARGO_BIN_EXE_barchan"))
            .args(args)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // Numbers as from dice: Lehmer's generator. Some come too late.
        state = state * 48_271 % 0x7fff_ffff;
        std::thread::sleep(duration.mul_f64(1.1 * state as f64 / f64::from(0x7fff_ffff)));
        killed += u64::from(child.try_wait().unwrap().is_none());
        child.kill().unwrap();
        child.wait().unwrap();
        whole();
    }
    println!("{}: killed {killed} times of {}", args[0], kills());
    assert!(killed > 0);
    barchan().args(args).assert().success();
    whole();
}

#[test]
fn a_killed_slam_leaves_the_run_before() {
    let case = Case::new();
    let run = case.path("run");
    killed_again_and_again(&case.slam("run"), &|| {
        let run = if run.exists() {
            run.clone()
        } else {
            case.path("run.barchan-old")
        };
        let summary = std::fs::read(run.join("summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
        assert_eq!(summary["frames"], 6);
        json(&["map", text(&run), "--out", text(&case.path("check"))]);
    });
    assert_eq!(case.left("run"), ["run"]);
}

#[test]
fn a_killed_map_leaves_the_map_before() {
    let case = Case::new();
    barchan().args(case.slam("run")).assert().success();
    let map = case.path("map");
    killed_again_and_again(&case.map("run", "map"), &|| {
        let map = if map.exists() {
            map.clone()
        } else {
            case.path("map.barchan-old")
        };
        let shaded = case.path("shaded.tif");
        let dem = map.join("dem.tif");
        let args = ["raster", "hillshade", text(&dem), "--out", text(&shaded)];
        barchan().args(args).assert().success();
    });
    assert_eq!(case.left("map"), ["map"]);
}

#[test]
fn what_a_run_ended_between_two_names_had_replaced_is_back() {
    let case = Case::new();
    barchan().args(case.slam("run")).assert().success();
    std::fs::rename(case.path("run"), case.path("run.barchan-old")).unwrap();
    // The next attempt fails, and what was finished before is still there.
    let mut args = case.slam("run");
    args.extend(["--config".into(), text(&case.path("nowhere.toml")).into()]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refused(&args);
    assert_eq!(case.left("run"), ["run"]);
    assert!(case.path("run/summary.json").is_file());
}

/// Runs the command where no file may be larger than some KiB, as on a disk that is full.
fn on_a_full_disk(kib: u32, args: &[String]) -> String {
    let output = Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f $0 && exec \"$@\""])
        // POSIX counts in blocks of 512 bytes, some shells in 1024: this is at most twice as much.
        .args([&kib.to_string(), env!("CARGO_BIN_EXE_barchan")])
        .args(args)
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    assert!(
        message.contains("error: ") && !message.contains("panicked"),
        "{message}"
    );
    message
}

#[test]
fn a_full_disk_is_said_and_leaves_nothing_half_written() {
    let case = Case::new();
    barchan().args(case.slam("run")).assert().success();
    let out = text(&case.path("out")).to_owned();
    let words = |line: &str| line.split(' ').map(str::to_owned).collect::<Vec<_>>();
    let data = text(&case.data);
    let commands = [
        words(&format!("infer --model sgm:64 --data {data} --out {out}")),
        case.slam("out"),
        case.map("run", "out"),
        words(&format!(
            "train --data {data} --steps 1 --crop 64 64 --out {out}"
        )),
        words(&format!("export tiny --out {out}.onnx")),
        words(&format!(
            "view {} --mcap {out}.mcap",
            text(&case.path("run"))
        )),
        words(&format!(
            "report {} --out {out}.html",
            text(&case.path("run"))
        )),
        words(&format!(
            "data synth synth:seed=3,frames=2,width=192,height=128 --out {out}"
        )),
    ];
    for args in commands {
        let message = on_a_full_disk(8, &args);
        assert!(
            message.contains(text(case.dir.path())),
            "{args:?}: {message}"
        );
        assert_eq!(case.left("out"), [""; 0], "{args:?}");
    }
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let case = Case::new();
    barchan().args(case.slam("run")).assert().success();
    // Nobody can make a file there, not even root.
    let nowhere = Path::new("/proc/barchan/out");
    if !Path::new("/proc/self").exists() {
        println!("skipped: there is no /proc");
        return;
    }
    let data = text(&case.data);
    for command in [
        vec!["infer", "--model", "sgm:64", "--data", data],
        vec!["slam", "--model", "sgm:64", "--data", data],
        vec!["train", "--steps", "1", "--data", data],
        vec!["map", text(&case.path("run"))],
        vec!["report", text(&case.path("run"))],
        vec!["data", "synth", "synth:seed=3,frames=2"],
        vec!["export", "tiny"],
    ] {
        let message = refused(&[&command[..], &["--out", text(nowhere)]].concat());
        assert!(message.contains("/proc/barchan"), "{command:?}: {message}");
    }
}

#[test]
fn nothing_needs_a_home() {
    let case = Case::new();
    let out = case.path("out");
    for model in ["sgm:64", "tiny"] {
        let args = [
            "infer",
            "--model",
            model,
            "--data",
            text(&case.data),
            "--out",
            text(&out),
        ];
        let mut command = barchan();
        for variable in ["HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"] {
            command.env(variable, "/proc/barchan");
        }
        command
            .args(args)
            .timeout(Duration::from_secs(120))
            .assert()
            .success();
    }
}
