//! Recordings of runs.

use std::process::Command;

use crate::program::{barchan, json, refused, rendered, text};

#[test]
fn a_run_becomes_a_recording() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 4);
    let [run, map, out] = ["slam", "map", "run.mcap"].map(|name| dir.path().join(name));
    let args = format!(
        "slam --model sgm:64 --no-check --data {} --out {}",
        text(&data),
        text(&run)
    );
    barchan().args(args.split(' ')).assert().success();
    // Without a map, and without key frames that have disparity.
    let said = json(&["view", text(&run), "--mcap", text(&out)]);
    assert_eq!(said[0]["frames"], 4);
    let keyframes = run.join("keyframes/disparity").read_dir().unwrap().count();
    assert_eq!(said[0]["keyframes"], keyframes);
    let alone = std::fs::read(&out).unwrap();
    assert_eq!(said[0]["bytes"], alone.len());
    for end in [&alone[..8], &alone[alone.len() - 8..]] {
        assert_eq!(end, b"\x89MCAP0\r\n");
    }
    let holds = |file: &[u8], what: &str| file.windows(what.len()).any(|w| w == what.as_bytes());
    assert!(holds(&alone, "/camera/points") && !holds(&alone, "/map/cloud"));

    // The folder of a demo: the map beside the run is found.
    barchan()
        .args(["map", text(&run), "--out", text(&map)])
        .assert()
        .success();
    json(&["view", text(dir.path()), "--mcap", text(&out)]);
    let both = std::fs::read(&out).unwrap();
    assert!(holds(&both, "/map/cloud") && holds(&both, "/map/relief"));

    std::fs::remove_dir_all(run.join("keyframes")).unwrap();
    let said = json(&["view", text(&run), "--mcap", text(&out)]);
    assert_eq!(
        (&said[0]["frames"], &said[0]["keyframes"]),
        (&4.into(), &0.into())
    );

    let message = refused(&["view", text(&data), "--mcap", text(&out)]);
    assert!(message.contains("barchan slam"), "{message}");
    let nowhere = dir.path().join("none/run.mcap");
    let message = refused(&["view", text(&run), "--mcap", text(&nowhere)]);
    assert!(message.contains("none/run.mcap"), "{message}");
    if !cfg!(feature = "rerun") {
        let message = refused(&["view", text(&run)]);
        assert!(message.contains("--features rerun"), "{message}");
    }
}

/// A terminal sees pictures while a network is trained, a pipe sees lines.
#[test]
fn training_is_watched_in_a_terminal() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let train = format!(
        "{} train --preset tiny --data synth:seed=1,frames=6,width=128,height=96 --steps 2 --crop 64 96 --out {}",
        env!("CARGO_BIN_EXE_barchan"),
        text(&out)
    );
    let in_terminal = Command::new("script")
        .args([
            "-qec",
            &format!("stty rows 40 cols 120; {train}"),
            "/dev/null",
        ])
        .env("TERM", "xterm-256color")
        .env("COLORTERM", "truecolor")
        .output();
    match in_terminal {
        Err(_) => println!("skipped: there is no `script` to make a terminal with"),
        Ok(seen) => {
            let seen = String::from_utf8_lossy(&seen.stdout).into_owned();
            for what in [
                "▀",
                "\x1b[38;2;",
                "disparity",
                "/2 ",
                " steps/s",
                "left",
                "held-out",
            ] {
                assert!(seen.contains(what), "{what}: {seen}");
            }
            std::fs::remove_dir_all(&out).unwrap();
        }
    }
    let args: Vec<&str> = train.split(' ').skip(1).collect();
    let output = barchan().args(args).assert().success();
    let (said, noted) = (&output.get_output().stdout, &output.get_output().stderr);
    let said = String::from_utf8_lossy(said).into_owned() + &String::from_utf8_lossy(noted);
    assert!(said.contains("step 2/2  loss "), "{said}");
    assert!(!said.contains('\x1b') && !said.contains('▀'), "{said}");
}
