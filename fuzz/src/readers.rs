//! Every reader of files, and small files that it reads.

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use barchan_datasets::katwijk::RangeSensor;
use barchan_datasets::{
    Correction, Plane, StereoSource, Synth, disparity_file, load_rig, open, parse_rgb, read_planar,
    write_katwijk, write_synth,
};
use barchan_geometry::{RectifiedRig, Rig, Trajectory};
use barchan_onnx::proto::ValueInfo;
use barchan_onnx::{GraphBuilder, Message};
use barchan_slam::{Map, Slam, SlamConfig, Vocabulary};
use barchan_terrain::{Cloud, CloudPoint, Grid, Raster};
use image::{DynamicImage, ImageFormat};
use nalgebra::Point3;

/// Reads a file; whether it was taken. Bytes are those of the file.
type Read = fn(&Path, &[u8]) -> bool;

pub struct Reader {
    pub name: &'static str,
    /// What its files are called.
    pub file: &'static str,
    pub read: Read,
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// A kind of file each.
pub const READERS: &[Reader] = &[
    reader("image", "image", |p, b| parse_rgb(b, p).is_ok(), images),
    reader(
        "disparity-pfm",
        "a.pfm",
        |p, _| disparity_file::read(p).is_ok(),
        || vec![disparity_file::pfm_bytes(&plane())],
    ),
    reader(
        "disparity-png",
        "a.png",
        |p, _| disparity_file::read(p).is_ok(),
        || vec![disparity_file::png_bytes(Path::new("a"), &plane()).unwrap_or_default()],
    ),
    reader(
        "rig",
        "rig.toml",
        |p, _| Rig::load(p).is_ok(),
        || texts(&[&rig_toml(), UNRECTIFIED]),
    ),
    reader("calibration-text", "calib.txt", one_calibration, || {
        texts(&[KITTI, MIDDLEBURY])
    }),
    reader("calibration-yaml", "stereo.yml", one_calibration, || {
        texts(&[OPENCV, ALIASES])
    }),
    reader("calibration-xml", "stereo.xml", one_calibration, || {
        texts(&[OPENCV_XML])
    }),
    reader(
        "calibration-pair",
        "left.yaml",
        |p, _| load_rig(&[p.into(), p.into()]).is_ok(),
        || texts(&[EUROC, ROS, OPENCV]),
    ),
    reader(
        "correction",
        "correction.toml",
        |p, _| Correction::load(p).is_ok(),
        correction,
    ),
    reader(
        "trajectory-tum",
        "a.tum",
        |p, _| Trajectory::read_tum(p).is_ok(),
        || texts(&["# time tx ty tz qx qy qz qw\n0 0 0 0 0 0 0 1\n1.5 1 2 3 0 0 0.1 0.99\n"]),
    ),
    reader(
        "trajectory-kitti",
        "a.kitti",
        |p, _| Trajectory::read_kitti(p, None).is_ok(),
        || texts(&["1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 2 0 0 1 3\n"]),
    ),
    reader(
        "trajectory-csv",
        "gt.csv",
        |p, _| read_planar(p).is_ok(),
        || texts(&["time,x,y,dx,dy\n0,0,0,0,0\n0.5,1.5,-2,0.1,0.1\n"]),
    ),
    reader(
        "sensors",
        "imu.csv",
        |_, b| FOLDER.opens_with("imu.csv", b),
        || FOLDER.table("imu.csv"),
    ),
    reader(
        "gnss",
        "gnss.csv",
        |_, b| FOLDER.opens_with("gnss.csv", b),
        || FOLDER.table("gnss.csv"),
    ),
    reader(
        "times",
        "times.txt",
        |_, b| FOLDER.opens_with("times.txt", b),
        || texts(&["0\n0.1\n"]),
    ),
    reader(
        "katwijk-imu",
        "imu.txt",
        |_, b| KATWIJK.opens_with("imu.txt", b),
        || KATWIJK.table("imu.txt"),
    ),
    reader(
        "katwijk-wheels",
        "odometry.txt",
        |_, b| KATWIJK.opens_with("odometry.txt", b),
        || KATWIJK.table("odometry.txt"),
    ),
    reader(
        "katwijk-fixes",
        "gps-latlong.txt",
        |_, b| KATWIJK.opens_with("gps-latlong.txt", b),
        || KATWIJK.table("gps-latlong.txt"),
    ),
    reader(
        "katwijk-scans",
        "Velodyne_2015_11_26_12_00_00_000_range.png",
        |path, bytes| {
            let azimuth = "Velodyne_2015_11_26_12_00_00_000_azimuth.png";
            std::fs::write(path.with_file_name(azimuth), bytes).is_ok()
                && RangeSensor::Velodyne.read(path).is_ok()
        },
        scan,
    ),
    reader(
        "onnx",
        "a.onnx",
        |_, b| barchan_onnx::inspect::check(b.to_vec().into()).is_ok(),
        onnx,
    ),
    reader(
        "slam-map",
        "map.safetensors",
        |_, b| Map::from_bytes(b, &TRACKED.0).is_ok(),
        || vec![TRACKED.1.clone()],
    ),
    reader(
        "slam-config",
        "config.toml",
        |_, b| std::str::from_utf8(b).is_ok_and(|t| toml::from_str::<SlamConfig>(t).is_ok()),
        || texts(&[&toml::to_string(&SlamConfig::default()).unwrap_or_default()]),
    ),
    reader(
        "vocabulary",
        "words.txt",
        |_, b| std::str::from_utf8(b).is_ok_and(|t| t.parse::<Vocabulary>().is_ok()),
        vocabulary,
    ),
    reader(
        "cloud-ply",
        "a.ply",
        |p, _| Cloud::read_ply(p).is_ok(),
        || {
            let binary = written("a.ply", |p| cloud().write_ply(p).is_ok());
            let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0 1 2 3\n1 1 1 4 5 6\n3 0 1 0\n";
            vec![binary, text.into()]
        },
    ),
    reader(
        "cloud-las",
        "a.las",
        |p, _| Cloud::read_las(p).is_ok(),
        || vec![written("a.las", |p| cloud().write_las(p).is_ok())],
    ),
    reader(
        "cloud-laz",
        "a.laz",
        |p, _| Cloud::read_las(p).is_ok(),
        || vec![written("a.laz", |p| cloud().write_las(p).is_ok())],
    ),
    reader(
        "raster",
        "a.tif",
        |p, _| Raster::<f32>::read(p).is_ok(),
        raster,
    ),
];

const fn reader(
    name: &'static str,
    file: &'static str,
    read: Read,
    seeds: fn() -> Vec<Vec<u8>>,
) -> Reader {
    Reader {
        name,
        file,
        read,
        seeds,
    }
}

fn one_calibration(path: &Path, _: &[u8]) -> bool {
    load_rig(&[path.into()]).is_ok()
}

fn texts(texts: &[&str]) -> Vec<Vec<u8>> {
    texts.iter().map(|t| t.as_bytes().to_vec()).collect()
}

/// What a writer leaves in a file of this name.
fn written(name: &str, write: impl FnOnce(&Path) -> bool) -> Vec<u8> {
    let dir = tempfile::tempdir().ok();
    let path = dir.as_ref().map(|d| d.path().join(name));
    let bytes = path.and_then(|p| write(&p).then(|| std::fs::read(&p).ok())?);
    bytes.unwrap_or_default()
}

fn plane() -> Plane {
    Plane::from_fn(13, 7, |x, y| match (x + y) % 5 {
        0 => image::Luma([f32::NAN]),
        _ => image::Luma([0.3 * x as f32 + y as f32]),
    })
}

/// A short turn of a scanner of 16 lasers.
fn scan() -> Vec<Vec<u8>> {
    let ranges = image::ImageBuffer::from_fn(24, 16, |x, y| image::Luma([(x * 900 + y) as u16]));
    let mut bytes = Cursor::new(vec![]);
    let written = DynamicImage::ImageLuma16(ranges).write_to(&mut bytes, ImageFormat::Png);
    written.map_or(vec![], |()| vec![bytes.into_inner()])
}

fn images() -> Vec<Vec<u8>> {
    let colour = image::RgbImage::from_fn(16, 9, |x, y| image::Rgb([x as u8 * 9, y as u8 * 20, 7]));
    let colour = DynamicImage::from(colour);
    let images = [
        (ImageFormat::Png, colour.clone()),
        (ImageFormat::Png, colour.to_luma16().into()),
        (ImageFormat::Png, colour.to_rgba16().into()),
        (ImageFormat::Jpeg, colour.clone()),
        (ImageFormat::Tiff, colour.clone()),
        (ImageFormat::Pnm, colour.clone()),
        (ImageFormat::Pnm, colour.to_luma8().into()),
    ];
    images
        .into_iter()
        .map(|(format, image)| {
            let mut bytes = Cursor::new(vec![]);
            // One that cannot be written is an empty file, which is a seed as well.
            let _ = image.write_to(&mut bytes, format);
            bytes.into_inner()
        })
        .collect()
}

fn cloud() -> Cloud {
    let point = |i: i32| CloudPoint {
        position: Point3::new(f64::from(i) * 0.1, f64::from(i % 7), -1.5),
        colour: [i as u8, 3, 200],
        sigma: 0.01,
    };
    Cloud {
        points: (0..60).map(point).collect(),
    }
}

fn raster() -> Vec<Vec<u8>> {
    let raster = Raster {
        grid: Grid {
            width: 12,
            height: 9,
            west: 100.0,
            north: 50.0,
            cell_x: 0.5,
            cell_y: 0.5,
        },
        crs: None,
        values: (0..108).map(|i| i as f32 * 0.1).collect(),
    };
    vec![written("a.tif", |p| raster.write(p).is_ok())]
}

fn onnx() -> Vec<Vec<u8>> {
    let mut graph = GraphBuilder::default();
    let weights = graph.floats("weights", &[1, 3, 1, 1], [0.1, 0.2, 0.3]);
    let grey = graph.plain("Conv", &["left", &weights], vec![]);
    let shape = graph.ints(&[0, -1]);
    graph.node("disparity", "Reshape", &[&grey, &shape], vec![]);
    let input = vec![ValueInfo::float("left", ["1", "3", "h", "w"])];
    let output = vec![ValueInfo::float_of_any_shape("disparity")];
    let model = graph.finish("fuzz", input, output, "", []);
    vec![model.encode_to_vec()]
}

fn vocabulary() -> Vec<Vec<u8>> {
    let text = "3 2 0 0\n0 0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32 0.5\n1 1 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32 0.7\n";
    texts(&[text])
}

fn correction() -> Vec<Vec<u8>> {
    texts(&[
        "swapped = false\nright_frame_shift = 1\nright_homography = [[1.0, 0.0, 0.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]]\n",
    ])
}

/// A rendered sequence of two pairs: its rig, the map that SLAM makes of it, and where it is.
static TRACKED: LazyLock<(RectifiedRig, Vec<u8>)> = LazyLock::new(|| {
    let synth = synth();
    let rig = *synth.rig();
    let config = SlamConfig {
        features: 40,
        min_inliers: 5,
        ..SlamConfig::default()
    };
    let mut slam = Slam::new(rig, config, None);
    for i in 0..2 {
        if let Ok(frame) = synth.frame(i) {
            // A lost frame leaves a smaller map.
            let _ = slam.track(frame);
        }
    }
    (rig, slam.finish().map.to_bytes(&rig).unwrap_or_default())
});

fn synth() -> Box<dyn StereoSource> {
    let open = open("synth:seed=3,frames=2,width=96,height=64");
    open.unwrap_or_else(|e| unreachable!("a rendered sequence needs no file: {e}"))
}

/// A rendered data set whose other files are replaced.
struct Rendered {
    format: &'static str,
    /// `None` where it could not be written.
    dir: LazyLock<Option<tempfile::TempDir>>,
}

static FOLDER: Rendered = Rendered {
    format: "folder",
    dir: LazyLock::new(|| written_data(|s, d| write_synth(s, d, |_| ()).is_ok())),
};
static KATWIJK: Rendered = Rendered {
    format: "katwijk",
    dir: LazyLock::new(|| written_data(|s, d| write_katwijk(s, d, 0.0, |_| ()).is_ok())),
};

fn written_data(write: impl FnOnce(&Synth, &Path) -> bool) -> Option<tempfile::TempDir> {
    let dir = tempfile::tempdir().ok()?;
    let source = Synth::parse("seed=3,frames=2,width=96,height=64").ok()?;
    write(&source, &dir.path().join("d")).then_some(dir)
}

impl Rendered {
    fn path(&self) -> Option<PathBuf> {
        Some(self.dir.as_ref()?.path().join("d"))
    }

    /// Whether it can be read with these bytes for one of its files.
    fn opens_with(&self, name: &str, bytes: &[u8]) -> bool {
        let Some(folder) = self.path() else {
            return false;
        };
        let file = folder.join(name);
        let whole = std::fs::read(&file);
        let read = std::fs::write(&file, bytes).is_ok()
            && open(&format!("{}:{}", self.format, folder.display())).is_ok();
        // The others of the folder are read with it: what is damaged must not stay.
        let restored = match whole {
            Ok(whole) => std::fs::write(&file, whole),
            Err(_) => std::fs::remove_file(&file),
        };
        read && restored.is_ok()
    }

    /// The beginning of one of its tables.
    fn table(&self, name: &str) -> Vec<Vec<u8>> {
        let bytes = self.path().and_then(|f| std::fs::read(f.join(name)).ok());
        let mut bytes = bytes.unwrap_or_default();
        // Whole lines: the seed must be one that is read.
        bytes.truncate(2000);
        let lines = bytes.iter().rposition(|b| *b == b'\n');
        bytes.truncate(lines.map_or(0, |end| end + 1));
        vec![bytes]
    }
}

fn rig_toml() -> String {
    Rig::from(TRACKED.0).to_toml()
}

const UNRECTIFIED: &str = "rectified = false\nwidth = 64\nheight = 48\n[left]\nfx = 50.0\nfy = 50.0\ncx = 32.0\ncy = 24.0\nmodel = \"radtan\"\ndistortion = [-0.2, 0.1, 0.0, 0.0]\n[right]\nfx = 50.0\nfy = 50.0\ncx = 32.0\ncy = 24.0\nmodel = \"equidistant\"\ndistortion = [0.1, 0.0, 0.0, 0.0]\n[right_from_left]\nrotation = [[1,0,0],[0,1,0],[0,0,1]]\ntranslation = [-0.12, 0.0, 0.0]\n";
const KITTI: &str = "S_rect_00: 7.4e+02 5.0e+02\nP_rect_00: 700 0 360 0 0 700 240 0 0 0 1 0\nS_rect_01: 7.4e+02 5.0e+02\nP_rect_01: 700 0 360 -376 0 700 240 0 0 0 1 0\n";
const MIDDLEBURY: &str = "cam0=[718.5 0 360.25; 0 718.5 241.75; 0 0 1]\ncam1=[718.5 0 391.75; 0 718.5 241.75; 0 0 1]\ndoffs=31.5\nbaseline=193\nwidth=740\nheight=500\nndisp=70";
const OPENCV: &str = "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 50., 0., 32., 0., 50., 24., 0., 0., 1. ]\nD1: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ 0., 0., 0., 0., 0. ]\nM2: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 50., 0., 32., 0., 50., 24., 0., 0., 1. ]\nD2: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ 0., 0., 0., 0., 0. ]\nR: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\nT: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ -0.1, 0., 0. ]\n";
const ALIASES: &str =
    "a: &a [1, 1, 1]\nb: &b [*a, *a, *a]\nc: &c [*b, *b, *b]\nd: [*c, *c, {? x : *b}]\nM1: *a\n";
const OPENCV_XML: &str = "<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_width>64</image_width><image_height>48</image_height>\n<P1 type_id=\"opencv-matrix\"><rows>3</rows><cols>4</cols><dt>d</dt><data>50 0 32 0 0 50 24 0 0 0 1 0</data></P1>\n<P2 type_id=\"opencv-matrix\"><rows>3</rows><cols>4</cols><dt>d</dt><data>50 0 32 -5 0 50 24 0 0 0 1 0</data></P2>\n</opencv_storage>\n";
const EUROC: &str = "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\nrate_hz: 20\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50.0, 50.0, 32.0, 24.0]\ndistortion_model: radial-tangential\ndistortion_coefficients: [-0.2, 0.07, 0.0002, 0.00002]\n";
const ROS: &str = "image_width: 64\nimage_height: 48\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [50, 0, 32, 0, 50, 24, 0, 0, 1]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: [50, 0, 32, -5, 0, 50, 24, 0, 0, 0, 1, 0]\n";
