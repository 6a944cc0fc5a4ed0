//! IMU and wheels beside the cameras.

use crate::program::{json, refused, rendered, text};

#[test]
fn sensors_are_listened_to_where_there_are_any_and_unless_told_not_to() {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), 8);
    let run = dir.path().join("run");
    let slam = |more: &[&str]| {
        let begin = ["slam", "--data", text(&data), "--model", "sgm:32", "--out"];
        json(&[&begin[..], &[text(&run)], more].concat())
    };
    let fused = slam(&["--dead-reckoning", "corrected"]);
    assert_eq!(fused["tracked"], 8, "{fused}");
    // Every frame but the first corrects the filter; wheels speak twice a frame.
    assert_eq!(fused["fusion"]["visual"], 7, "{fused}");
    assert_eq!(fused["fusion"]["wheels"], 14, "{fused}");
    assert_eq!(
        (&fused["carried"], &fused["joined"]),
        (&0.into(), &0.into())
    );
    let lines = |name: &str| {
        let file = std::fs::read_to_string(run.join(name)).unwrap();
        file.lines().count()
    };
    assert_eq!(lines("dead_reckoning.tum"), 8);
    assert_eq!(lines("dead_reckoning.csv"), 1 + 8);

    assert!(slam(&["--no-fusion"])["fusion"].is_null());
    assert!(!run.join("dead_reckoning.tum").exists());

    for file in ["imu.csv", "imu.tum", "odometry.csv", "gnss.csv"] {
        std::fs::remove_file(data.join(file)).unwrap();
    }
    assert!(slam(&[])["fusion"].is_null());
    let message = refused(&[
        "slam",
        "--data",
        text(&data),
        "--out",
        text(&run),
        "--dead-reckoning",
        "printed",
    ]);
    assert!(message.contains("needs an IMU"), "{message}");
}
