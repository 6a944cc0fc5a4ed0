//! The formats on disk, one file each: where the images lie and what the calibration beside them
//! says. Everything else is [`PairSource`].

mod euroc;
pub(crate) mod folder;
pub(crate) mod katwijk;
mod kitti_odometry;
mod kitti_stereo;
mod middlebury;
mod sceneflow;

use std::path::Path;

use crate::{DataError, PairSource};

/// A format on disk.
pub(crate) struct Format {
    /// As in `FORMAT:PATH`.
    pub name: &'static str,
    /// What is looked for, in words.
    pub layout: &'static str,
    /// Whether a folder has the layout. Reads no image.
    pub detect: fn(&Path) -> bool,
    /// Lists what a folder holds. Reads no image but the headers that tell a size.
    pub open: fn(&Path) -> Result<PairSource, DataError>,
}

/// Every format, in the order in which they are tried.
pub(crate) const ON_DISK: &[Format] = &[
    kitti_odometry::FORMAT,
    kitti_stereo::FORMAT,
    middlebury::FORMAT,
    sceneflow::FORMAT,
    euroc::FORMAT,
    katwijk::FORMAT,
    katwijk::PAN_CAM,
    folder::FORMAT,
];

/// `dir` has not the layout of `format`.
fn not_here(dir: &Path, format: &Format) -> DataError {
    let message = format!(
        "not the layout of {}: looked for {}",
        format.name, format.layout
    );
    DataError::file(dir, message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{StereoSource, open};
    use std::path::PathBuf;

    /// A grey image of one level, in folders made for it.
    pub(super) fn save_image(path: &Path, (width, height): (u32, u32), level: u8) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        image::GrayImage::from_pixel(width, height, image::Luma([level]))
            .save(path)
            .unwrap();
    }

    /// A text file, in folders made for it.
    pub(super) fn save_text(path: &Path, text: &str) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    /// An image whose header tells its size and whose pixels cannot be read.
    pub(super) fn cut_image(path: &Path) {
        let bytes = std::fs::read(path).unwrap();
        std::fs::write(path, &bytes[..bytes.len() - 20]).unwrap();
    }

    pub(super) fn names(source: &dyn StereoSource) -> Vec<String> {
        (0..source.len()).map(|i| source.name(i)).collect()
    }

    /// The grey levels of the first pixels of a frame.
    pub(super) fn levels(source: &dyn StereoSource, index: usize) -> (u8, u8) {
        let frame = source.frame(index).unwrap();
        let level = |image: &crate::Rgb| (image[(0, 0)].0[0] * 255.0).round() as u8;
        (level(&frame.left), level(&frame.right))
    }

    pub(super) fn message(format: &Format, dir: &Path) -> String {
        (format.open)(dir)
            .err()
            .map(|e| e.to_string())
            .unwrap_or_default()
    }

    /// The one format that finds its layout in a folder.
    pub(super) fn detected(dir: &Path) -> Vec<&'static str> {
        let found = ON_DISK.iter().filter(|f| (f.detect)(dir));
        found.map(|f| f.name).collect()
    }

    /// A folder of the shared data, or nothing where it is absent.
    pub(super) fn shared(name: &str) -> Option<PathBuf> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../shared/data")
            .join(name);
        if !path.exists() {
            println!("skipped: {} is absent", path.display());
        }
        path.exists().then_some(path)
    }

    #[test]
    fn an_empty_folder_is_no_dataset_and_every_format_says_what_it_looked_for() {
        let dir = tempfile::tempdir().unwrap();
        assert!(detected(dir.path()).is_empty());
        let all = open(dir.path().to_str().unwrap())
            .err()
            .unwrap()
            .to_string();
        for format in ON_DISK {
            assert!(
                all.contains(format.name) && all.contains(format.layout),
                "{all}"
            );
            let message = message(format, dir.path());
            assert!(message.contains(dir.path().to_str().unwrap()), "{message}");
            assert!(!message.is_empty());
            let spec = format!("{}:/no/such/place", format.name);
            let absent = open(&spec).err().unwrap().to_string();
            assert!(absent.contains("no such folder") && absent.contains(format.layout));
        }
    }

    #[test]
    fn the_shared_data_is_detected() {
        for (name, expected) in [
            ("kitti00-first21", "kitti-odometry"),
            ("middlebury2003", "middlebury"),
            ("middlebury2003/cones", "middlebury"),
            ("middlebury2014/trainingQ", "middlebury"),
            ("middlebury2014/trainingQ/Motorcycle", "middlebury"),
            ("sceneflow-sample", "sceneflow"),
            ("arena-unlabelled", "folder"),
            ("arena-run1", "folder"),
            ("devon1", "folder"),
        ] {
            if let Some(path) = shared(name) {
                assert_eq!(detected(&path), [expected]);
                let source = open(path.to_str().unwrap()).unwrap();
                assert!(source.frame(source.len() - 1).is_ok(), "{name}");
            }
        }
    }
}
