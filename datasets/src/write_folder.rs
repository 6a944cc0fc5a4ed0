use std::path::Path;

use barchan_geometry::{Rig, Trajectory};

use crate::image_file::{encode_png, write_whole};
use crate::sensor_files::write_sensors;
use crate::{DataError, Plane, Rgb, StereoFrame, StereoSource, Synth, disparity_file};

/// Writes a source in the layout of format `folder`: `left/` and `right/` as 8-bit PNG,
/// `rig.toml`, `times.txt`, and truth where the source has it: `groundtruth.tum`, `disparity/` and
/// `disparity_right/` as 16-bit PNG. What else the rover measured is written as `imu.csv`,
/// `odometry.csv`, `gnss.csv` and `imu.tum` (one line: the pose of the rectified left camera in the
/// IMU's frame). `progress` is told how many frames are done after each.
///
/// Everything is written beside `dir` first and renamed at the end, so `dir` is whole or absent.
///
/// # Errors
/// When `dir` exists and is not empty, the pairs are of several rigs, a frame cannot be read, or a
/// file cannot be written.
pub fn write_folder(
    source: &dyn StereoSource,
    dir: &Path,
    progress: impl FnMut(usize),
) -> Result<(), DataError> {
    if let Some(index) = (0..source.len()).find(|i| source.frame_rig(*i) != source.rig()) {
        let message = format!(
            "a folder has one rig, and pair {} is of another than the first: write the scenes one by one",
            source.name(index)
        );
        return Err(DataError::file(dir, message));
    }
    write_beside(dir, |partial| {
        write_files(&Rectified(source), partial, progress)
    })
}

/// [`write_folder`] of a rendered traverse, with what only it knows: images as they were taken and
/// the rig of them (`rectified=false`: reading rectifies them, and the truth is exact for that),
/// `occlusion/` (8-bit PNG: 255 where the right camera does not see what the left image shows) and
/// `rocks.csv`.
///
/// # Errors
/// As [`write_folder`].
pub fn write_synth(
    synth: &Synth,
    dir: &Path,
    progress: impl FnMut(usize),
) -> Result<(), DataError> {
    write_beside(dir, |partial| {
        write_files(synth, partial, progress)?;
        let rocks = synth.rocks().iter().map(|rock| {
            let c = rock.centre;
            format!("{},{},{},{},{}\n", c.x, c.y, c.z, rock.radius, rock.top)
        });
        let header = "x,y,z,radius,top\n".to_owned();
        let table: String = std::iter::once(header).chain(rocks).collect();
        write_whole(&partial.join("rocks.csv"), table.as_bytes())
    })
}

/// What can be written: a source, or a renderer that knows more.
trait Written {
    fn source(&self) -> &dyn StereoSource;

    /// The rig of the images that are written.
    fn rig_of_images(&self) -> Rig;

    /// Names, times and images to write.
    fn images(&self, index: usize) -> Result<StereoFrame, DataError>;

    /// The poses of the left camera that took the images.
    fn poses_of_images(&self) -> Option<Trajectory>;

    fn occlusion(&self, index: usize) -> Result<Option<Plane>, DataError>;
}

struct Rectified<'a>(&'a dyn StereoSource);

impl Written for Rectified<'_> {
    fn source(&self) -> &dyn StereoSource {
        self.0
    }

    fn rig_of_images(&self) -> Rig {
        Rig::from(*self.0.rig())
    }

    fn images(&self, index: usize) -> Result<StereoFrame, DataError> {
        self.0.frame(index)
    }

    fn poses_of_images(&self) -> Option<Trajectory> {
        self.0.true_trajectory().cloned()
    }

    fn occlusion(&self, _: usize) -> Result<Option<Plane>, DataError> {
        Ok(None)
    }
}

impl Written for Synth {
    fn source(&self) -> &dyn StereoSource {
        self
    }

    fn rig_of_images(&self) -> Rig {
        let straight = || Rig::from(*self.rig());
        self.unrectified_rig().cloned().unwrap_or_else(straight)
    }

    fn images(&self, index: usize) -> Result<StereoFrame, DataError> {
        let [left, right] = self.photograph(index)?;
        Ok(StereoFrame {
            index,
            name: self.name(index),
            time: self.time(index),
            left,
            right,
        })
    }

    fn poses_of_images(&self) -> Option<Trajectory> {
        Some(self.trajectory_of_images())
    }

    fn occlusion(&self, index: usize) -> Result<Option<Plane>, DataError> {
        self.true_occlusion(index).map(Some)
    }
}

/// Runs `write` on a folder beside `dir` that takes its place when all went well.
pub(crate) fn write_beside(
    dir: &Path,
    write: impl FnOnce(&Path) -> Result<(), DataError>,
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
    let written =
        write(partial).and_then(|()| std::fs::rename(partial, dir).map_err(DataError::io(dir)));
    if written.is_err() {
        // Best effort: the first error is the one to tell.
        let _ = std::fs::remove_dir_all(partial);
    }
    written
}

fn write_files(
    written: &dyn Written,
    dir: &Path,
    mut progress: impl FnMut(usize),
) -> Result<(), DataError> {
    let source = written.source();
    let [left, right, disparity, disparity_right, occlusion] =
        ["left", "right", "disparity", "disparity_right", "occlusion"].map(|name| dir.join(name));
    for folder in [&left, &right] {
        std::fs::create_dir_all(folder).map_err(DataError::io(folder))?;
    }
    let mut times = String::new();
    for index in 0..source.len() {
        let frame = written.images(index)?;
        let file = format!("{}.png", frame.name);
        write_rgb(&left.join(&file), &frame.left)?;
        write_rgb(&right.join(&file), &frame.right)?;
        for (folder, truth) in [
            (&disparity, source.true_disparity(index)?),
            (&disparity_right, source.true_disparity_right(index)?),
        ] {
            if let Some(truth) = truth {
                std::fs::create_dir_all(folder).map_err(DataError::io(folder))?;
                disparity_file::write_png(&folder.join(&file), &truth)?;
            }
        }
        if let Some(mask) = written.occlusion(index)? {
            std::fs::create_dir_all(&occlusion).map_err(DataError::io(&occlusion))?;
            write_mask(&occlusion.join(&file), &mask)?;
        }
        times += &format!("{}\n", frame.time);
        progress(index + 1);
    }
    write_whole(&dir.join("times.txt"), times.as_bytes())?;
    write_whole(
        &dir.join("rig.toml"),
        written.rig_of_images().to_toml().as_bytes(),
    )?;
    if let Some(truth) = written.poses_of_images() {
        write_whole(&dir.join("groundtruth.tum"), truth.to_tum().as_bytes())?;
    }
    source
        .sensors()
        .map_or(Ok(()), |sensors| write_sensors(dir, sensors))
}

/// Writes 1 as 255 and everything else as 0.
fn write_mask(path: &Path, mask: &Plane) -> Result<(), DataError> {
    let bytes = mask.iter().map(|v| if *v == 1.0 { 255 } else { 0 });
    let (width, height) = mask.dimensions();
    // One value a pixel by construction.
    let stored = image::GrayImage::from_raw(width, height, bytes.collect()).unwrap_or_default();
    write_whole(path, &encode_png(path, &stored.into())?)
}

/// Writes an image as an 8-bit PNG.
pub(crate) fn write_rgb(path: &Path, image: &Rgb) -> Result<(), DataError> {
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
    use crate::Folder;

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
    fn a_crooked_rig_is_written_as_it_is_and_rectified_on_reading() {
        let source =
            Synth::parse("frames=2,width=96,height=72,rectified=false,noise=0,seed=2").unwrap();
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("out");
        write_synth(&source, &dir, |_| ()).unwrap();
        let folder = Folder::open(&dir).unwrap();
        let (read, made) = (folder.frame(1).unwrap(), source.frame(1).unwrap());
        // The rig is the same to the digits of rig.toml.
        assert!((folder.rig().fx - source.rig().fx).abs() < 1e-6);
        assert!((folder.rig().cx - source.rig().cx).abs() < 1e-6);
        for (a, b) in [(read.left, made.left), (read.right, made.right)] {
            let worst = a.iter().zip(b.iter()).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 1.0 / 255.0);
        }
        let truth = |s: &dyn StereoSource| s.true_trajectory().unwrap().poses[1].T_world_cam;
        let apart = barchan_geometry::se3::log(&(truth(&folder).inverse() * truth(&source)));
        assert!(apart.norm() < 1e-6, "{apart}");
        let mask = image::open(dir.join("occlusion/000001.png")).unwrap();
        assert_eq!((mask.width(), mask.height()), (96, 72));
        for name in [
            "imu.csv",
            "odometry.csv",
            "gnss.csv",
            "imu.tum",
            "rocks.csv",
        ] {
            let text = std::fs::read_to_string(dir.join(name)).unwrap_or_default();
            assert!(!text.is_empty(), "{name}");
        }
        assert!(dir.join("disparity_right/000001.png").is_file());
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
