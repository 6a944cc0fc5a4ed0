use std::path::Path;

use crate::formats::ON_DISK;
use crate::{Corrected, Correction, DataError, StereoSource, synth};

/// How to write a rendered traverse.
const SYNTH: &str = "synth:seed=1,frames=60";

/// What [`open`] understands: how it is written, and what is looked for.
fn formats() -> Vec<(String, &'static str)> {
    let on_disk = ON_DISK
        .iter()
        .map(|f| (format!("{}:PATH", f.name), f.layout));
    let synth = (SYNTH.to_owned(), "no files: a rendered traverse");
    on_disk.chain([synth]).collect()
}

/// Opens a dataset: `FORMAT:PATH`, or a plain path whose format is found out. A [`Correction`] that
/// lies in its folder is applied.
///
/// # Errors
/// When the format is unknown, the path is missing, or the dataset's layout or its correction is
/// broken; the message says what was looked for.
pub fn open(spec: &str) -> Result<Box<dyn StereoSource>, DataError> {
    let source = open_as_stored(spec)?;
    let correction = dataset_folder(spec).map(|folder| folder.join(Correction::FILE));
    match correction.filter(|file| file.is_file()) {
        Some(file) => Ok(Box::new(Corrected::new(source, Correction::load(&file)?)?)),
        None => Ok(source),
    }
}

/// The folder that a dataset lies in; `None` of a rendered one.
pub fn dataset_folder(spec: &str) -> Option<&Path> {
    if Path::new(spec).exists() {
        return Some(Path::new(spec));
    }
    let (format, rest) = spec.split_once(':')?;
    (format != "synth").then_some(Path::new(rest))
}

/// [`open`] without any correction.
///
/// # Errors
/// As [`open`].
pub fn open_as_stored(spec: &str) -> Result<Box<dyn StereoSource>, DataError> {
    let path = Path::new(spec);
    let known = || -> String {
        let names: Vec<String> = formats().into_iter().map(|(name, _)| name).collect();
        names.join(", ")
    };
    if !path.exists()
        && let Some((name, rest)) = spec
            .split_once(':')
            .or((spec == "synth").then_some((spec, "")))
    {
        if name == "synth" {
            return synth::open(rest);
        }
        let Some(format) = ON_DISK.iter().find(|f| f.name == name) else {
            let message = format!("unknown format \"{name}\"; known: {}", known());
            return Err(layout(spec, &message));
        };
        if !Path::new(rest).is_dir() {
            let message = format!("{rest}: no such folder; expected {}", format.layout);
            return Err(layout(spec, &message));
        }
        return Ok(Box::new((format.open)(Path::new(rest))?));
    }
    if !path.is_dir() {
        let what = if path.exists() {
            "a file, not a folder"
        } else {
            "no such folder"
        };
        let message = format!("{what}. A dataset is a PATH or one of {}", known());
        return Err(layout(spec, &message));
    }
    if let Some(format) = ON_DISK.iter().find(|f| (f.detect)(path)) {
        return Ok(Box::new((format.open)(path)?));
    }
    let looked: Vec<String> = ON_DISK
        .iter()
        .map(|f| format!("\n  {}: {}", f.name, f.layout))
        .collect();
    let message = format!("not a dataset that is known; looked for{}", looked.concat());
    Err(layout(spec, &message))
}

fn layout(spec: &str, message: &str) -> DataError {
    DataError::Layout {
        spec: spec.into(),
        message: message.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(spec: &str) -> String {
        open(spec).err().map(|e| e.to_string()).unwrap_or_default()
    }

    #[test]
    fn errors_say_what_was_looked_for() {
        let dir = tempfile::tempdir().unwrap();
        let spec = dir.path().to_str().unwrap();
        assert!(message(spec).contains("rig.toml"), "{}", message(spec));
        assert!(
            message("katwjik:x").contains("known: kitti-odometry:PATH"),
            "{}",
            message("katwjik:x")
        );
        assert!(
            message("/no/such/place").contains("no such folder"),
            "{}",
            message("/no/such/place")
        );
        assert!(message("folder:/no/such/place").contains("/no/such/place"));
    }
}
