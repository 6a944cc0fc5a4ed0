use std::path::Path;

use barchan_geometry::{Camera, Rig, Se3};

use super::{known_size, tree};
use crate::DataError;

/// Reads Middlebury's `calib.txt` (2014, 2021, evaluation version 3; ETH3D's two-view sets use it too):
/// lines `name=value` with `cam0`, `cam1` as `[fx 0 cx; 0 fy cy; 0 0 1]`, `baseline` in millimetres,
/// and `width`, `height`. `doffs` is the difference of the principal points.
///
/// # Errors
/// When a value is missing or no number.
pub(crate) fn read_middlebury(path: &Path, size: Option<(usize, usize)>) -> Result<Rig, DataError> {
    parse(path, &tree::read_text(path)?, size)
}

pub(super) fn detect(text: &str) -> bool {
    text.lines().any(|line| value_of(line, "cam0").is_some())
}

fn value_of<'a>(line: &'a str, name: &str) -> Option<&'a str> {
    let (key, value) = line.split_once('=')?;
    (key.trim() == name).then(|| value.trim())
}

pub(super) fn parse(
    path: &Path,
    text: &str,
    size: Option<(usize, usize)>,
) -> Result<Rig, DataError> {
    let numbers = |name: &str, count: usize| {
        let Some(value) = text.lines().find_map(|line| value_of(line, name)) else {
            return Ok(None);
        };
        let numbers: Option<Vec<f64>> = value
            .split([' ', '\t', '[', ']', ';', ','])
            .filter(|w| !w.is_empty())
            .map(|w| w.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        match numbers.filter(|n| n.len() == count) {
            Some(numbers) => Ok(Some(numbers)),
            None => {
                let message = format!("{name} is \"{value:.80}\", expected {count} numbers");
                Err(DataError::file(path, message))
            }
        }
    };
    let needed = |name: &str, count: usize| {
        numbers(name, count)?.ok_or_else(|| {
            let message =
                format!("has no line {name}=...; expected cam0, cam1, baseline, width and height");
            DataError::file(path, message)
        })
    };
    let (left, right) = (needed("cam0", 9)?, needed("cam1", 9)?);
    let camera = |k: &[f64]| Camera::pinhole(k[0], k[4], k[2], k[5]);
    let told = numbers("width", 1)?.zip(numbers("height", 1)?);
    let (width, height) = known_size(
        path,
        told.map(|(w, h)| (w[0] as usize, h[0] as usize)),
        size,
    )?;
    let rig = Rig {
        width,
        height,
        left: camera(&left),
        right: camera(&right),
        T_right_left: Se3::translation(-needed("baseline", 1)?[0] / 1000.0, 0.0, 0.0),
        rectified: true,
    };
    // A file whose doffs contradicts its cameras was edited or resized by hand.
    if let Some(doffs) = numbers("doffs", 1)? {
        let between = rig.right.cx - rig.left.cx;
        if (doffs[0] - between).abs() > 0.01 {
            let message = format!(
                "doffs is {}, but the principal points of cam0 and cam1 differ by {between}",
                doffs[0]
            );
            return Err(DataError::file(path, message));
        }
    }
    rig.validate(path)?;
    Ok(rig)
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::tests::{assert_same, load, message, straight};

    pub(in super::super) fn text() -> String {
        "cam0=[718.5 0 360.25; 0 718.5 241.75; 0 0 1]\r\ncam1=[718.5 0 391.75; 0 718.5 241.75; 0 0 1]\r\ndoffs=31.5\r\nbaseline=193\r\nwidth=740\r\nheight=500\r\nndisp=70".into()
    }

    #[test]
    fn calib_txt_gives_the_rig_back_in_metres() {
        assert_same(&load(&[("calib.txt", text())], None).unwrap(), &straight());
        let without = text().replace("width=740", "");
        let found = load(&[("calib.txt", without.clone())], Some((740, 500)));
        assert_same(&found.unwrap(), &straight());
        assert!(message(&[("calib.txt", without)], None).contains("size of the images"));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (from, to, expected) in [
            ("cam1", "cam2", "cam1=..."),
            ("baseline=193", "baseline=x", "baseline is \"x\""),
            ("baseline=193", "baseline=0", "baseline is 0"),
            ("baseline=193", "baseline=-193", "right"),
            ("width=740", "width=99999999999", "width, height"),
            ("doffs=31.5", "doffs=7", "doffs is 7"),
            ("718.5 0 360.25", "718.5 0", "cam0 is"),
            ("718.5 0 360.25", "-5 0 360.25", "focal length"),
        ] {
            let message = message(&[("calib.txt", text().replacen(from, to, 1))], None);
            assert!(
                message.contains("calib.txt") && message.contains(expected),
                "{message}"
            );
        }
    }
}
