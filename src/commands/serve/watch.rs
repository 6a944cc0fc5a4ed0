//! Pairs that appear in a folder.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::station::{Pair, Station};

/// How often the folder is looked at.
const POLL: Duration = Duration::from_millis(100);
/// How long an image that cannot be read may still be being written.
const PATIENCE: Duration = Duration::from_secs(2);

/// Answers pairs `left/NAME` and `right/NAME` in the order of their names, until the service stops. Names
/// must grow: what comes later sorts later. With `consume` they are removed when they are answered.
pub fn watch(folder: &Path, consume: bool, station: &Station, stop: &AtomicBool) {
    let mut last: Option<String> = None;
    while !stop.load(Ordering::Relaxed) {
        for name in new_pairs(folder, last.as_deref()) {
            let files = ["left", "right"].map(|side| folder.join(side).join(&name));
            let taken = take(&files, &name, station, stop);
            if stop.load(Ordering::Relaxed) && taken.is_err() {
                return;
            }
            match taken {
                Ok(()) if consume => {
                    for file in &files {
                        if let Err(e) = std::fs::remove_file(file) {
                            station
                                .metrics
                                .watch_failed(&format!("{}: {e}", file.display()));
                        }
                    }
                }
                Ok(()) => {}
                Err(message) => station.metrics.watch_failed(&message),
            }
            last = Some(name);
        }
        std::thread::sleep(POLL);
    }
}

/// Names after `last` that are in both folders. A folder that is not there has none yet.
fn new_pairs(folder: &Path, last: Option<&str>) -> BTreeSet<String> {
    let names = |side: &str| -> BTreeSet<String> {
        let entries = folder.join(side).read_dir().into_iter().flatten();
        let names = entries.filter_map(|e| e.ok()?.file_name().into_string().ok());
        // Hidden and partial files are somebody's who is still writing.
        let whole =
            |n: &String| !n.starts_with('.') && !n.ends_with(".part") && !n.ends_with(".tmp");
        names
            .filter(|n| whole(n) && last.is_none_or(|last| n.as_str() > last))
            .collect()
    };
    &names("left") & &names("right")
}

fn take(
    files: &[PathBuf; 2],
    name: &str,
    station: &Station,
    stop: &AtomicBool,
) -> Result<(), String> {
    let begun = Instant::now();
    let [left, right] = loop {
        let images = files.each_ref().map(|file| {
            let context = |e: &dyn std::fmt::Display| format!("{}: {e}", file.display());
            let bytes = std::fs::read(file).map_err(|e| context(&e))?;
            let named = file.display().to_string();
            station.image(&named, &bytes).map_err(|e| e.text())
        });
        match images {
            [Ok(left), Ok(right)] => break [left, right],
            [Err(e), _] | [_, Err(e)] => {
                if begun.elapsed() > PATIENCE || stop.load(Ordering::Relaxed) {
                    return Err(e);
                }
            }
        }
        std::thread::sleep(POLL);
    };
    let stem = Path::new(name).file_stem().unwrap_or_default();
    let pair = Pair {
        name: Some(stem.to_string_lossy().into_owned()),
        time: None,
        left,
        right,
    };
    let answered = station.process(pair);
    answered
        .map(drop)
        .map_err(|e| format!("{name}: {}", e.text()))
}
