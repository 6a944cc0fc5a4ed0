//! What a sensor study learns is what was planted, and maps take it.

use std::fmt::Write as _;
use std::path::Path;

use crate::program::{json, refused, text};

/// A text cloud of a plane at a depth, tilted, whose depths are off as Kinect's are: a sum of uniform numbers.
fn write_look(path: &Path, depth: f64, tilt: f64, seed: u64) {
    let mut state = seed;
    let mut uniform = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 33) as f64 / (1u64 << 31) as f64
    };
    let sigma = |z: f64| 0.0012 + 0.0019 * (z - 0.4).powi(2);
    let mut body = String::new();
    let (sin, cos) = tilt.sin_cos();
    for (u, v) in (0..120).flat_map(|v| (0..160).map(move |u| (f64::from(u), f64::from(v)))) {
        let (x, y) = ((u - 79.5) / 150.0, (v - 59.5) / 150.0);
        let z = depth * cos / (y * sin + cos);
        let noise: f64 = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        writeln!(body, "{} {} {}", x * z, y * z, z + sigma(z) * noise).unwrap();
    }
    let head = "ply\nformat ascii 1.0\nelement vertex 19200\nproperty double x\nproperty double y\nproperty double z\nend_header\n";
    std::fs::write(path, format!("{head}{body}")).unwrap();
}

#[test]
fn planted_noise_of_clouds_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    let depths = [0.5, 0.9, 1.4, 2.0, 2.7];
    let tilts = [0.0f64, 25.0, -45.0].map(f64::to_radians);
    let mut planes = String::from("name,distance,nx,ny,nz\n");
    let mut clouds = vec![];
    for (i, depth) in depths.into_iter().enumerate() {
        for (j, tilt) in tilts.into_iter().enumerate() {
            let path = dir.path().join(format!("look{i}{j}.ply"));
            write_look(&path, depth, tilt, 7 + 31 * i as u64 + j as u64);
            writeln!(
                planes,
                "look{i}{j},{},0,{},{}",
                depth - 0.004,
                tilt.sin(),
                tilt.cos()
            )
            .unwrap();
            // So all depths are 4 mm too large.
            clouds.push(path);
        }
    }
    let file = dir.path().join("planes.csv");
    std::fs::write(&file, planes).unwrap();
    let out = dir.path().join("study");
    let mut args = vec![
        "noise",
        "--planes",
        text(&file),
        "--out",
        text(&out),
        "--clouds",
    ];
    args.extend(clouds.iter().map(|c| text(c)));
    let study = json(&args);
    assert_eq!(study["looks"], 15);
    for name in [
        "noise.toml",
        "noise.csv",
        "noise.svg",
        "systematic.svg",
        "summary.json",
    ] {
        assert!(out.join(name).is_file(), "{name}");
    }
    let number = |k: &str| study["model"][k].as_f64().unwrap();
    for (z, millimetres) in [(0.5, 1.219), (1.4, 3.1), (2.7, 11.251)] {
        let curve = 1e3 * (number("a") + number("b") * (z - number("c")).powi(2));
        assert!(
            (curve / millimetres - 1.0f64).abs() < 0.06,
            "{z} m: {curve} mm"
        );
    }
    let systematic = study["systematic"].as_f64().unwrap();
    assert!((systematic - 0.004).abs() < 0.0006, "{systematic}");

    let message = refused(&["noise", "--clouds", "missing.ply", "--out", text(&out)]);
    assert!(message.contains("missing.ply"), "{message}");
    std::fs::write(&file, "name,distance\nlook00,-1\n").unwrap();
    let message = refused(&args);
    assert!(message.contains("planes.csv, line 2"), "{message}");
}

#[test]
fn a_matcher_is_studied_on_rendered_walls_and_its_model_makes_the_bounds_of_a_map() {
    let dir = tempfile::tempdir().unwrap();
    let [study, run, map] = ["study", "run", "map"].map(|n| dir.path().join(n));
    let found = json(&[
        "noise",
        "--data",
        "synth:planes,seed=2,frames=10,width=192,height=144",
        "--model",
        "sgm",
        "--out",
        text(&study),
    ]);
    let disparity = found["model"]["disparity"].as_f64().unwrap();
    assert_eq!(found["model"]["kind"], "stereo");
    assert!((0.02..0.5).contains(&disparity), "{found}");

    json(&[
        "slam",
        "--data",
        "synth:seed=3,frames=6,width=192,height=128",
        "--model",
        "sgm",
        "--out",
        text(&run),
    ]);
    let toml = study.join("noise.toml");
    let mapped = |extra: &[&str]| {
        let mut args = vec!["map", text(&run), "--cell", "0.1", "--out", text(&map)];
        args.extend(extra);
        json(&args)
    };
    let width = |map: &serde_json::Value| map["band_width"].as_f64().unwrap();
    let plain = mapped(&["--raw-colours"]);
    assert!(plain["gains"].is_null());
    let studied = mapped(&["--sensor", text(&toml), "--clear-ghosts"]);
    assert!(studied["gains"][0].as_f64().unwrap() > 0.8, "{studied}");
    // What is known of the matcher is less than what is assumed of all.
    assert!(width(&studied) < width(&plain), "{studied} {plain}");

    let laser = dir.path().join("laser.toml");
    std::fs::write(
        &laser,
        "kind = \"laser\"\nrange = 0.5\nconstant = 0.1\nangle = 0.1\n",
    )
    .unwrap();
    let wide = mapped(&["--sensor", text(&laser)]);
    assert!(
        width(&wide) > width(&studied) || wide["elevation_cells"] == 0,
        "{wide}"
    );
    for wrong in [
        "kind = \"sonar\"\n",
        "kind = \"laser\"\nrange = -1\nconstant = 0\nangle = 0\n",
    ] {
        std::fs::write(&laser, wrong).unwrap();
        let message = refused(&[
            "map",
            text(&run),
            "--sensor",
            text(&laser),
            "--out",
            text(&map),
        ]);
        assert!(message.contains("laser.toml"), "{message}");
    }
}
