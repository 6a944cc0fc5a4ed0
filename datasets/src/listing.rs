//! Which files a folder holds, and which of them belong together.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::DataError;

/// Extensions of images.
pub(crate) const IMAGES: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff", "ppm", "pgm", "pnm"];
/// Extensions of disparity images.
pub(crate) const DISPARITIES: &[&str] = &["png", "pfm"];

/// Stem and path of a file.
pub(crate) type Named = (String, PathBuf);

/// Stem and path of every file of the given extensions, in natural order of the stems.
pub(crate) fn list(dir: &Path, extensions: &[&str]) -> Result<Vec<Named>, DataError> {
    if !dir.is_dir() {
        return Err(DataError::file(dir, "no such folder"));
    }
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(DataError::io(dir))? {
        let path = entry.map_err(DataError::io(dir))?.path();
        let known = path
            .extension()
            .and_then(|e| e.to_str())
            .is_some_and(|e| extensions.contains(&e.to_ascii_lowercase().as_str()));
        let stem = path
            .file_stem()
            .map(|s| s.to_string_lossy().into_owned())
            .unwrap_or_default();
        if known && !stem.starts_with('.') && path.is_file() {
            files.push((stem, path));
        }
    }
    if files.is_empty() {
        return Err(DataError::file(
            dir,
            format!("holds no image ({})", extensions.join(", ")),
        ));
    }
    files.sort_by(|a, b| natural(&a.0, &b.0));
    if let Some(twice) = files.windows(2).find(|w| w[0].0 == w[1].0) {
        let message = format!(
            "and {} have the same stem: remove one",
            twice[1].1.display()
        );
        return Err(DataError::file(&twice[0].1, message));
    }
    Ok(files)
}

/// Orders names as people do: `img2` before `img10`.
pub(crate) fn natural(a: &str, b: &str) -> Ordering {
    let (mut rest_a, mut rest_b) = (a, b);
    loop {
        let (run_a, run_b) = (digits(rest_a), digits(rest_b));
        let order = if !run_a.is_empty() && !run_b.is_empty() {
            let (value_a, value_b) = (run_a.trim_start_matches('0'), run_b.trim_start_matches('0'));
            let order = value_a.len().cmp(&value_b.len()).then(value_a.cmp(value_b));
            (rest_a, rest_b) = (&rest_a[run_a.len()..], &rest_b[run_b.len()..]);
            order
        } else {
            let (mut chars_a, mut chars_b) = (rest_a.chars(), rest_b.chars());
            let (c, d) = (chars_a.next(), chars_b.next());
            if c.is_none() && d.is_none() {
                // 01 and 1: equal as numbers, ordered as text.
                return a.cmp(b);
            }
            (rest_a, rest_b) = (chars_a.as_str(), chars_b.as_str());
            c.cmp(&d)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

/// The digits a text starts with.
fn digits(text: &str) -> &str {
    &text[..text
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(text.len())]
}

/// Pairs by stem when any stem occurs on both sides, else by order: name, left and right.
pub(crate) fn pair_up(
    left: Vec<Named>,
    right: Vec<Named>,
) -> Result<Vec<(String, PathBuf, PathBuf)>, DataError> {
    let folder = |side: &[Named]| {
        side.first()
            .and_then(|(_, path)| path.parent())
            .map(Path::to_owned)
            .unwrap_or_default()
    };
    let (left_dir, right_dir) = (folder(&left), folder(&right));
    let left_stems: BTreeSet<&String> = left.iter().map(|(stem, _)| stem).collect();
    if right.iter().any(|(stem, _)| left_stems.contains(stem)) {
        if let Some((stem, lonely)) = right.iter().find(|(stem, _)| !left_stems.contains(stem)) {
            return Err(no_partner(&left_dir, stem, lonely));
        }
        let mut by_stem: BTreeMap<String, PathBuf> = right.into_iter().collect();
        let partner = |(stem, path): Named| match by_stem.remove(&stem) {
            Some(right) => Ok((stem, path, right)),
            None => Err(no_partner(&right_dir, &stem, &path)),
        };
        return left.into_iter().map(partner).collect();
    }
    if left.len() != right.len() {
        let message = format!(
            "{} images here and {} in {}/, and no names in common: give both sides the same names, or the same number",
            right.len(),
            left.len(),
            left_dir.file_name().unwrap_or_default().to_string_lossy(),
        );
        return Err(DataError::file(&right_dir, message));
    }
    Ok(left
        .into_iter()
        .zip(right)
        .map(|((name, left), (_, right))| (name, left, right))
        .collect())
}

/// `lonely` has no image of its stem in `dir`.
fn no_partner(dir: &Path, stem: &str, lonely: &Path) -> DataError {
    let missing = dir.join(lonely.file_name().unwrap_or_default());
    let message = format!(
        "missing: {} is there, so {}/ needs an image named {stem}",
        lonely.display(),
        dir.file_name().unwrap_or_default().to_string_lossy(),
    );
    DataError::file(&missing, message)
}

/// The folders within a folder, in natural order of their names.
pub(crate) fn folders(dir: &Path) -> Result<Vec<Named>, DataError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(DataError::io(dir))? {
        let path = entry.map_err(DataError::io(dir))?.path();
        if path.is_dir() {
            found.push((name_of(&path), path));
        }
    }
    found.sort_by(|a, b| natural(&a.0, &b.0));
    Ok(found)
}

/// The name of a file or folder, also of `.` and `..`.
pub(crate) fn name_of(path: &Path) -> String {
    let whole = path.canonicalize();
    let path = if path.file_name().is_some() {
        path
    } else {
        whole.as_deref().unwrap_or(path)
    };
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// The file of a stem that a folder has, by the first extension it is found with.
pub(crate) fn with_stem(dir: &Path, stem: &str, extensions: &[&str]) -> Option<PathBuf> {
    let named = |e: &&str| dir.join(format!("{stem}.{e}"));
    extensions.iter().map(named).find(|path| path.is_file())
}
