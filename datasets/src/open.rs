use std::path::Path;

use crate::{DataError, Folder, StereoSource, Synth};

/// What [`open`] understands, for help texts.
pub const FORMATS: &[&str] = &["folder:PATH", "synth:seed=1,frames=60"];

/// Opens a dataset: `FORMAT:PATH`, or a plain path whose format is found out.
///
/// # Errors
/// When the format is unknown, the path is missing, or the dataset's layout is broken; the
/// message says what was looked for.
pub fn open(spec: &str) -> Result<Box<dyn StereoSource>, DataError> {
    let path = Path::new(spec);
    if !path.exists()
        && let Some((format, rest)) = spec
            .split_once(':')
            .or((spec == "synth").then_some((spec, "")))
    {
        return match format {
            "folder" => Ok(Box::new(Folder::open(Path::new(rest))?)),
            "synth" => Ok(Box::new(Synth::parse(rest)?)),
            _ => Err(layout(
                spec,
                &format!("unknown format \"{format}\"; known: {}", FORMATS.join(", ")),
            )),
        };
    }
    if !path.exists() {
        return Err(layout(
            spec,
            &format!(
                "no such folder. A dataset is a PATH or one of {}",
                FORMATS.join(", ")
            ),
        ));
    }
    if Folder::detect(path) {
        return Ok(Box::new(Folder::open(path)?));
    }
    Err(layout(
        spec,
        &format!("not a dataset: looked for {}", Folder::LAYOUT),
    ))
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
            message("katwjik:x").contains("known: folder:PATH"),
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
