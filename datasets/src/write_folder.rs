use std::path::Path;

use barchan_geometry::Rig;

use crate::image_file::{encode_png, write_whole};
use crate::{DataError, Rgb, StereoSource, disparity_file};

/// Writes a source in the layout of format `folder`: `left/` and `right/` as 8-bit PNG,
/// `rig.toml`, `times.txt`, and truth where the source has it (`groundtruth.tum`, `disparity/` as
/// 16-bit PNG). `progress` is told how many frames are done after each.
///
/// Everything is written beside `dir` first and renamed at the end, so `dir` is whole or absent.
///
/// # Errors
/// When `dir` exists and is not empty, a frame cannot be read, or a file cannot be written.
pub fn write_folder(
    source: &dyn StereoSource,
    dir: &Path,
    mut progress: impl FnMut(usize),
) -> Result<(), DataError> {
    if dir
        .read_dir()
        .is_ok_and(|mut entries| entries.next().is_some())
        || dir.is_file()
    {
        return Err(DataError::file(
            dir,
            "exists and is not empty: choose another folder or remove it",
        ));
    }
    let mut partial = dir.as_os_str().to_owned();
    partial.push(".partial");
    let partial = Path::new(&partial);
    let written = write_files(source, partial, &mut progress)
        .and_then(|()| std::fs::rename(partial, dir).map_err(DataError::io(dir)));
    if written.is_err() {
        // Best effort: the first error is the one to tell.
        let _ = std::fs::remove_dir_all(partial);
    }
    written
}

fn write_files(
    source: &dyn StereoSource,
    dir: &Path,
    progress: &mut impl FnMut(usize),
) -> Result<(), DataError> {
    let [left, right, disparity] = ["left", "right", "disparity"].map(|name| dir.join(name));
    for folder in [&left, &right] {
        std::fs::create_dir_all(folder).map_err(DataError::io(folder))?;
    }
    let mut times = String::new();
    for index in 0..source.len() {
        let frame = source.frame(index)?;
        let file = format!("{}.png", frame.name);
        write_rgb(&left.join(&file), &frame.left)?;
        write_rgb(&right.join(&file), &frame.right)?;
        if let Some(truth) = source.true_disparity(index)? {
            std::fs::create_dir_all(&disparity).map_err(DataError::io(&disparity))?;
            disparity_file::write_png(&disparity.join(&file), &truth)?;
        }
        times += &format!("{}\n", frame.time);
        progress(index + 1);
    }
    write_whole(&dir.join("times.txt"), times.as_bytes())?;
    write_whole(
        &dir.join("rig.toml"),
        Rig::from(*source.rig()).to_toml().as_bytes(),
    )?;
    if let Some(truth) = source.true_trajectory() {
        write_whole(&dir.join("groundtruth.tum"), truth.to_tum().as_bytes())?;
    }
    Ok(())
}

/// Writes an image as an 8-bit PNG.
fn write_rgb(path: &Path, image: &Rgb) -> Result<(), DataError> {
    let bytes = image
        .as_raw()
        .iter()
        .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
        .collect();
    let (width, height) = image.dimensions();
    // Three values a pixel by construction.
    let stored = image::RgbImage::from_raw(width, height, bytes).unwrap_or_default();
    write_whole(path, &encode_png(path, &stored.into())?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Folder, Synth};

    #[test]
    fn what_is_written_reads_back() {
        let source = Synth::parse("frames=3,width=64,height=48").unwrap();
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("out");
        let mut told = Vec::new();
        write_folder(&source, &dir, |done| told.push(done)).unwrap();
        assert_eq!(told, [1, 2, 3]);
        assert_eq!(
            parent.path().read_dir().unwrap().count(),
            1,
            "nothing is left beside"
        );

        let folder = Folder::open(&dir).unwrap();
        assert_eq!((folder.len(), folder.rig()), (3, source.rig()));
        for i in 0..3 {
            let (read, made) = (folder.frame(i).unwrap(), source.frame(i).unwrap());
            assert_eq!(
                (read.index, &read.name, read.time),
                (i, &made.name, made.time)
            );
            for (a, b) in [(read.left, made.left), (read.right, made.right)] {
                assert!(
                    a.iter()
                        .zip(b.iter())
                        .all(|(a, b)| (a - b).abs() <= 0.5 / 255.0 + 1e-6)
                );
            }
            let (read, made) = (
                folder.true_disparity(i).unwrap().unwrap(),
                source.true_disparity(i).unwrap().unwrap(),
            );
            for (a, b) in read.iter().zip(made.iter()) {
                assert!((a.is_nan() && b.is_nan()) || (a - b).abs() <= 0.5 / 256.0 + 1e-5);
            }
        }
        let (read, made) = (
            folder.true_trajectory().unwrap(),
            source.true_trajectory().unwrap(),
        );
        for (a, b) in read.poses.iter().zip(&made.poses) {
            let motion = barchan_geometry::se3::log(&(a.T_world_cam.inverse() * b.T_world_cam));
            assert!(motion.norm() < 1e-7 && a.time == b.time);
        }
    }

    #[test]
    fn a_folder_with_something_in_it_is_left_alone() {
        let source = Synth::parse("frames=1,width=32,height=32").unwrap();
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("mine"), "x").unwrap();
        let message = write_folder(&source, dir.path(), |_| ())
            .unwrap_err()
            .to_string();
        assert!(message.contains("not empty"), "{message}");
        assert_eq!(dir.path().read_dir().unwrap().count(), 1);
    }

    #[test]
    fn failure_leaves_nothing_half_written() {
        let parent = tempfile::tempdir().unwrap();
        let (good, out) = (parent.path().join("good"), parent.path().join("out"));
        write_folder(
            &Synth::parse("frames=2,width=32,height=32").unwrap(),
            &good,
            |_| (),
        )
        .unwrap();
        let cut = good.join("right/000001.png");
        let bytes = std::fs::read(&cut).unwrap();
        std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
        let message = write_folder(&Folder::open(&good).unwrap(), &out, |_| ())
            .unwrap_err()
            .to_string();
        assert!(message.contains("000001.png"), "{message}");
        assert_eq!(parent.path().read_dir().unwrap().count(), 1);
    }
}
