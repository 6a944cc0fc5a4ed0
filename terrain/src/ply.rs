use std::io::BufReader;
use std::path::Path;

use nalgebra::Point3;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    Addable, ElementDef, Encoding, Ply, Property, PropertyAccess, PropertyAccessResult,
    PropertyDef, PropertyType, ScalarType,
};
use ply_rs_bw::writer::Writer;

use crate::atomic::write_atomically;
use crate::{Cloud, CloudPoint, TerrainError};

impl Cloud {
    /// Writes a binary PLY: `float x y z`, `uchar red green blue`, and `float sigma` when any point
    /// knows its deviation. Opens in CloudCompare, MeshLab and Open3D.
    ///
    /// # Errors
    /// When the file cannot be written; an older file of that name then stays as it was.
    pub fn write_ply(&self, path: &Path) -> Result<(), TerrainError> {
        let mut vertex = ElementDef::new("vertex".into());
        let sigma = self
            .points
            .iter()
            .any(|p| p.sigma.is_finite())
            .then_some("sigma");
        let floats = ["x", "y", "z"].into_iter().map(|n| (n, ScalarType::Float));
        let colours = ["red", "green", "blue"]
            .into_iter()
            .map(|n| (n, ScalarType::UChar));
        let sigma = sigma.into_iter().map(|n| (n, ScalarType::Float));
        for (name, scalar) in floats.chain(colours).chain(sigma) {
            vertex
                .properties
                .add(PropertyDef::new(name.into(), PropertyType::Scalar(scalar)));
        }
        let mut ply = Ply::<CloudPoint>::new();
        ply.header.encoding = Encoding::BinaryLittleEndian;
        ply.header
            .comments
            .push("Barchan point cloud, metres".into());
        ply.header.elements.add(vertex);
        ply.payload.insert("vertex".into(), self.points.clone());
        write_atomically(path, |out| {
            Writer::new()
                .write_ply(out, &mut ply)
                .map_err(TerrainError::io(path))
                .map(|_| ())
        })
    }

    /// Reads the points of a PLY file, text or binary: `x y z` of any number type, and where present
    /// `red green blue` and `sigma`. Other properties and elements are passed over.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged, or holds no points with x, y and z.
    pub fn read_ply(path: &Path) -> Result<Self, TerrainError> {
        let bad = |message: String| TerrainError::Ply {
            path: path.to_owned(),
            message,
        };
        let file = std::fs::File::open(path).map_err(TerrainError::io(path))?;
        let mut reader = Reader::new(BufReader::with_capacity(1 << 20, file));
        let points = Parser::<CloudPoint>::new();
        let header = points
            .read_header(&mut reader)
            .map_err(|e| bad(e.to_string()))?;
        for (_, element) in &header.elements {
            if element.name == "vertex" {
                let missing = ["x", "y", "z"]
                    .into_iter()
                    .find(|n| !element.properties.contains_key(*n));
                if let Some(name) = missing {
                    return Err(bad(format!("its vertices have no property {name}")));
                }
                let points = points.read_payload_for_element(&mut reader, element, &header);
                return Ok(Self {
                    points: points.map_err(|e| bad(e.to_string()))?,
                });
            }
            Parser::<Skipped>::new()
                .read_payload_for_element(&mut reader, element, &header)
                .map_err(|e| bad(e.to_string()))?;
        }
        Err(bad("it has no element vertex".into()))
    }
}

impl PropertyAccess for CloudPoint {
    fn new() -> Self {
        Self {
            position: Point3::origin(),
            colour: [0; 3],
            sigma: f32::NAN,
        }
    }

    fn get_float(&self, name: &str) -> Option<f32> {
        match name {
            "x" => Some(self.position.x as f32),
            "y" => Some(self.position.y as f32),
            "z" => Some(self.position.z as f32),
            "sigma" => Some(self.sigma),
            _ => None,
        }
    }

    fn get_uchar(&self, name: &str) -> Option<u8> {
        match name {
            "red" => Some(self.colour[0]),
            "green" => Some(self.colour[1]),
            "blue" => Some(self.colour[2]),
            _ => None,
        }
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        let number = match value {
            Property::Double(v) => Some(v),
            ref other => other.to_f32_lossy().map(f64::from),
        };
        match (name, number) {
            ("x", Some(v)) => self.position.x = v,
            ("y", Some(v)) => self.position.y = v,
            ("z", Some(v)) => self.position.z = v,
            ("sigma", Some(v)) => self.sigma = v as f32,
            ("red", _) => self.colour[0] = value.to_u8_color_lossy().unwrap_or(0),
            ("green", _) => self.colour[1] = value.to_u8_color_lossy().unwrap_or(0),
            ("blue", _) => self.colour[2] = value.to_u8_color_lossy().unwrap_or(0),
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

/// An element that is read past: its bytes must be consumed to reach the next.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }

    fn set_property(&mut self, _: &str, _: Property) -> PropertyAccessResult {
        PropertyAccessResult::Set
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(n: usize, sigma: f32) -> Cloud {
        let point = |i: usize| CloudPoint {
            position: Point3::new(
                i as f64 * 0.5,
                -(i as f64) * 0.25,
                f64::from(1.1f32) * i as f64 % 7.0,
            ),
            colour: [i as u8, (i / 256) as u8, 7],
            sigma,
        };
        let as_f32 = |p: CloudPoint| CloudPoint {
            position: p.position.map(|v| f64::from(v as f32)),
            ..p
        };
        Cloud {
            points: (0..n).map(point).map(as_f32).collect(),
        }
    }

    #[test]
    fn round_trip_is_exact() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.ply");
        let with = cloud(1000, 0.125);
        with.write_ply(&path).unwrap();
        assert_eq!(Cloud::read_ply(&path).unwrap(), with);
        let without = cloud(1000, f32::NAN);
        without.write_ply(&path).unwrap();
        let back = Cloud::read_ply(&path).unwrap();
        assert!(back.points.iter().zip(&without.points).all(|(a, b)| {
            a.position == b.position && a.colour == b.colour && a.sigma.is_nan()
        }));
        let bytes = std::fs::read(&path).unwrap();
        let header = b"end_header\n";
        let end = bytes
            .windows(header.len())
            .position(|w| w == header)
            .unwrap()
            + header.len();
        assert_eq!(bytes.len() - end, 1000 * 15);
        Cloud::default().write_ply(&path).unwrap();
        assert_eq!(Cloud::read_ply(&path).unwrap().points.len(), 0);
    }

    #[test]
    fn clouds_of_others_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.ply");
        let text = "ply\nformat ascii 1.0\nelement camera 1\nproperty list uchar int ids\nelement vertex 2\n\
                    property double x\nproperty double y\nproperty double z\nproperty float nx\n\
                    property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n\
                    property list uchar int vertex_indices\nend_header\n2 5 6\n\
                    500000.125 1 2 0.5 10 20 30\n-3 4 5 0.5 255 0 1\n3 0 1 0\n";
        std::fs::write(&path, text).unwrap();
        let points = Cloud::read_ply(&path).unwrap().points;
        assert_eq!(points[0].position, Point3::new(500000.125, 1.0, 2.0));
        assert_eq!(
            (points[0].colour, points[1].colour),
            ([10, 20, 30], [255, 0, 1])
        );
    }

    #[test]
    fn damaged_files_are_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("broken.ply");
        cloud(50, 0.1).write_ply(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let no_z = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n";
        let huge =
            b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\n\
                     property float y\nproperty float z\nend_header\n";
        let none = b"ply\nformat ascii 1.0\nend_header\n";
        let cases = [
            &whole[..whole.len() - 1],
            &whole[..20],
            b"",
            b"P5 nonsense",
            &no_z[..],
            &huge[..],
            &none[..],
        ];
        for bytes in cases {
            std::fs::write(&path, bytes).unwrap();
            let error = Cloud::read_ply(&path).unwrap_err().to_string();
            assert!(error.contains("broken.ply"), "{error}");
        }
        assert!(Cloud::read_ply(&dir.path().join("none.ply")).is_err());
    }
}
