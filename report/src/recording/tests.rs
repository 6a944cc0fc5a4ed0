use std::collections::BTreeMap;
use std::io::Cursor;

use barchan_terrain::{Grid, Raster};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use serde_json::Value;

use super::*;
use crate::ReportError;

/// Somewhere in a country's grid, where 32 bits do not tell centimetres.
const FAR: [f64; 3] = [365_000.25, 5_620_000.5, 40.0];

#[allow(non_snake_case)]
fn T_map_world() -> Se3 {
    let turned = UnitQuaternion::from_scaled_axis(Vector3::new(-1.5, 0.1, 0.2));
    Se3::from_parts(Vector3::from(FAR).into(), turned)
}

fn points() -> Vec<CloudPoint> {
    let point = |k: i32| CloudPoint {
        position: Point3::from(FAR) + Vector3::new(f64::from(k), -2.0, 0.01 * f64::from(k)),
        colour: [k as u8, 200, 7],
        sigma: f32::NAN,
    };
    let mut points: Vec<_> = (0..50).map(point).collect();
    points[3].position.z = f64::NAN;
    points
}

fn relief() -> Relief {
    let grid = Grid {
        width: 3,
        height: 2,
        west: 10.0,
        north: 20.0,
        cell_x: 0.5,
        cell_y: 0.25,
    };
    let raster = |values: Vec<f32>| Raster {
        grid,
        crs: None,
        values,
    };
    Relief {
        elevation: raster(vec![1.0, 2.0, 3.0, 4.0, f32::NAN, 6.0]),
        shade: Raster {
            grid,
            crs: None,
            values: vec![180; 6],
        },
        bound: None,
    }
}

fn told(to: &mut dyn Recording) -> Result<(), ReportError> {
    let rig = RectifiedRig {
        width: 64,
        height: 48,
        fx: 50.0,
        fy: 51.0,
        cx: 32.0,
        cy: 24.0,
        doffs: 0.0,
        baseline: 0.1,
    };
    to.transform(1.25, "map", "world", &T_map_world())?;
    to.route(
        1.25,
        "/route",
        "world",
        &[Se3::identity(), Se3::translation(1.0, 2.0, 3.0)],
    )?;
    to.camera(1.5, "/camera/calibration", "camera", &rig)?;
    to.image(1.5, "/camera/left", "camera", &RgbImage::new(64, 48))?;
    to.cloud(1.5, "/map/cloud", "map", &points())?;
    to.relief(1.999_999_999_9, "/map/relief", "map", &relief())
}

fn file() -> Vec<u8> {
    let mut file = vec![];
    let mut recording = Box::new(FoxgloveRecording::new(&mut file).unwrap());
    told(&mut *recording).unwrap();
    recording.finish().unwrap();
    file
}

/// Takes numbers and texts from bytes, as <https://mcap.dev/spec> lays them out.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, length: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(length);
        self.0 = rest;
        taken
    }
    fn number(&mut self, length: usize) -> u64 {
        let bytes = self.take(length).iter().rev();
        bytes.fold(0, |n, byte| n << 8 | u64::from(*byte))
    }
    fn text(&mut self) -> &'a str {
        let length = self.number(4) as usize;
        std::str::from_utf8(self.take(length)).unwrap()
    }
    fn record(&mut self) -> (u64, Bytes<'a>) {
        let op = self.number(1);
        let length = self.number(8) as usize;
        (op, Bytes(self.take(length)))
    }
    fn records(mut self) -> Vec<(u64, Bytes<'a>)> {
        let mut records = vec![];
        while !self.0.is_empty() {
            records.push(self.record());
        }
        records
    }
}

/// All messages by their topics, found as a viewer finds them, from the end of the file by its indexes, and each
/// held against the schema that comes with it.
fn recorded() -> BTreeMap<String, (String, u64, Value)> {
    const FOOTER: usize = 9 + 20;
    let file = file();
    let (begin, end) = (&file[..8], &file[file.len() - 8..]);
    assert_eq!((begin, end), (&b"\x89MCAP0\r\n"[..], &b"\x89MCAP0\r\n"[..]));
    let footer = file.len() - 8 - FOOTER;
    let (op, mut fields) = Bytes(&file[footer..]).record();
    assert_eq!(op, 2);
    let summary = fields.number(8) as usize;
    let offsets = fields.number(8) as usize;
    let checked = &file[summary..file.len() - 8 - 4];
    assert_eq!(fields.number(4), u64::from(crc32fast::hash(checked)));
    for (op, mut group) in Bytes(&file[offsets..footer]).records() {
        assert_eq!(op, 14);
        let (op, start, length) = (group.number(1), group.number(8), group.number(8));
        let group = &file[start as usize..(start + length) as usize];
        assert!(Bytes(group).records().iter().all(|r| r.0 == op));
    }

    let (mut schemas, mut channels) = (BTreeMap::new(), BTreeMap::new());
    let (mut found, mut counted) = (BTreeMap::new(), 0);
    for (op, mut r) in Bytes(&file[summary..offsets]).records() {
        match op {
            3 => {
                let (id, name, encoding) = (r.number(2), r.text(), r.text());
                assert_eq!(encoding, "jsonschema");
                let types: Value = serde_json::from_str(r.text()).unwrap();
                assert_eq!(types["title"], name);
                schemas.insert(id, (name, types));
            }
            4 => {
                let (id, schema, topic) = (r.number(2), r.number(2), r.text());
                assert_eq!((r.text(), r.text()), ("json", ""));
                channels.insert(id, (topic, schema));
            }
            8 => {
                let [first, last, start, length] = [8; 4].map(|n| r.number(n));
                let [start, length] = [start, length].map(|n| n as usize);
                let (op, mut chunk) = Bytes(&file[start..start + length]).record();
                assert_eq!((op, chunk.number(8), chunk.number(8)), (6, first, last));
                let (size, crc) = (chunk.number(8), chunk.number(4));
                assert_eq!((chunk.text(), chunk.number(8)), ("", size));
                let records = chunk.0;
                assert_eq!(records.len() as u64, size);
                assert_eq!(u64::from(crc32fast::hash(records)), crc);
                let places = r.number(4) as usize;
                let mut places = Bytes(r.take(places));
                while !places.0.is_empty() {
                    let (channel, place) = (places.number(2), places.number(8) as usize);
                    let (op, mut index) = Bytes(&file[place..]).record();
                    assert_eq!((op, index.number(2)), (7, channel));
                    let length = index.number(4) as usize;
                    let mut index = Bytes(index.take(length));
                    while !index.0.is_empty() {
                        let (time, place) = (index.number(8), index.number(8) as usize);
                        assert!((first..=last).contains(&time));
                        let (op, mut message) = Bytes(&records[place..]).record();
                        assert_eq!((op, message.number(2)), (5, channel));
                        message.number(4);
                        assert_eq!((message.number(8), message.number(8)), (time, time));
                        let value: Value = serde_json::from_slice(message.0).unwrap();
                        let (topic, schema) = channels[&channel];
                        let (name, types) = &schemas[&schema];
                        fits(&value, types, name);
                        found.insert(topic.to_owned(), ((*name).to_owned(), time, value));
                        counted += 1;
                    }
                }
            }
            _ => assert_eq!((op, r.number(8)), (11, 6)),
        }
    }
    assert_eq!(counted, 6);
    found
}

/// Panics where a value is not what a schema says.
fn fits(value: &Value, schema: &Value, path: &str) {
    let fits_type = match schema["type"].as_str().unwrap() {
        "object" => {
            let fields = schema["properties"].as_object().unwrap();
            for name in schema["required"].as_array().unwrap() {
                assert!(!value[name.as_str().unwrap()].is_null(), "{path}: {name}");
            }
            for (name, field) in value.as_object().unwrap() {
                assert!(
                    fields.contains_key(name),
                    "{path}: {name} is not in the schema"
                );
                fits(field, &fields[name], &format!("{path}.{name}"));
            }
            true
        }
        "array" => {
            let items = value.as_array().unwrap();
            items.iter().for_each(|v| fits(v, &schema["items"], path));
            schema["minItems"].is_null() || schema["minItems"] == items.len()
        }
        "integer" => value.is_u64(),
        "number" => value.is_number(),
        "string" => value.is_string(),
        other => panic!("{path}: {other}"),
    };
    assert!(fits_type, "{path}: {value} against {schema}");
}

#[test]
fn messages_are_what_their_schemas_say() {
    let recorded = recorded();
    let names: Vec<&str> = recorded.values().map(|(name, ..)| name.as_str()).collect();
    let wanted = [
        "CameraCalibration",
        "CompressedImage",
        "PointCloud",
        "Grid",
        "PosesInFrame",
        "FrameTransform",
    ];
    assert_eq!(names, wanted.map(|n| format!("foxglove.{n}")));
}

#[test]
fn times_are_whole_nanoseconds() {
    let recorded = recorded();
    assert_eq!(recorded["/tf"].1, 1_250_000_000);
    assert_eq!(recorded["/tf"].2["timestamp"]["nsec"], 250_000_000);
    // What rounds up to a second is one.
    assert_eq!(recorded["/map/relief"].1, 2_000_000_000);
    assert_eq!(recorded["/map/relief"].2["timestamp"]["nsec"], 0);
    for time in [-1.0, f64::NAN, 1e300] {
        let mut recording = FoxgloveRecording::new(Cursor::new(vec![])).unwrap();
        let refused = recording.route(time, "/r", "world", &[]);
        assert!(
            matches!(refused, Err(ReportError::Time(_))),
            "{time}: {refused:?}"
        );
    }
}

#[test]
fn a_transform_comes_back() {
    let (_, _, tf) = &recorded()["/tf"];
    let number = |part: &str, axis: &str| tf[part][axis].as_f64().unwrap();
    let place = ["x", "y", "z"].map(|axis| number("translation", axis));
    assert_eq!(place, FAR);
    let q = ["x", "y", "z", "w"].map(|axis| number("rotation", axis));
    let rotation = UnitQuaternion::from_quaternion(q.into());
    assert!(rotation.angle_to(&T_map_world().rotation) < 1e-12);
    assert_eq!(
        [&tf["parent_frame_id"], &tf["child_frame_id"]],
        ["map", "world"]
    );
}

#[test]
fn points_keep_their_places_far_from_the_origin_and_their_colours() {
    let (_, _, cloud) = &recorded()["/map/cloud"];
    let bytes = BASE64_STANDARD
        .decode(cloud["data"].as_str().unwrap())
        .unwrap();
    let stride = cloud["point_stride"].as_u64().unwrap() as usize;
    let offset = |name: &str| {
        let fields = cloud["fields"].as_array().unwrap();
        let field = fields.iter().find(|f| f["name"] == name).unwrap();
        field["offset"].as_u64().unwrap() as usize
    };
    let finite: Vec<CloudPoint> = (points().into_iter())
        .filter(|p| p.position.z.is_finite())
        .collect();
    assert_eq!(bytes.len(), stride * finite.len());
    for (packed, point) in bytes.chunks(stride).zip(&finite) {
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            let at = offset(name);
            let value = f32::from_le_bytes(packed[at..at + 4].try_into().unwrap());
            let origin = cloud["pose"]["position"][name].as_f64().unwrap();
            let off = (origin + f64::from(value) - point.position[axis]).abs();
            assert!(off < 1e-6, "{name}: {off}");
        }
        let colour = ["red", "green", "blue", "alpha"].map(|name| packed[offset(name)]);
        assert_eq!(colour[..3], point.colour);
        assert_eq!(colour[3], 255);
    }
}

#[test]
fn a_grid_begins_in_the_south_west_and_what_is_unknown_is_clear() {
    let (_, _, grid) = &recorded()["/map/relief"];
    let corner = ["x", "y", "z"].map(|axis| grid["pose"]["position"][axis].as_f64().unwrap());
    // Two rows of 0.25 m below 20 m; the lowest height.
    assert_eq!(corner, [10.0, 19.5, 1.0]);
    assert_eq!(grid["column_count"], 3);
    let bytes = BASE64_STANDARD
        .decode(grid["data"].as_str().unwrap())
        .unwrap();
    let heights: Vec<f32> = bytes
        .chunks(8)
        .map(|c| f32::from_le_bytes(c[..4].try_into().unwrap()))
        .collect();
    assert_eq!(heights[0], 4.0);
    assert!(heights[1].is_nan());
    assert_eq!(heights[2..], [6.0, 1.0, 2.0, 3.0]);
    let clear: Vec<u8> = bytes.chunks(8).map(|c| c[7]).collect();
    assert_eq!(clear, [255, 0, 255, 255, 255, 255]);
}

#[test]
fn a_full_disk_is_an_error() {
    /// Takes so many bytes, and no more.
    struct Full(Cursor<Vec<u8>>, usize);
    impl std::io::Write for Full {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            match self.0.get_ref().len() + bytes.len() <= self.1 {
                true => self.0.write(bytes),
                false => Err(std::io::ErrorKind::StorageFull.into()),
            }
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    for room in [0, 10, 100, 1000, 5000] {
        let told = || {
            let mut recording = Box::new(FoxgloveRecording::new(Full(Cursor::new(vec![]), room))?);
            told(&mut *recording)?;
            recording.finish()
        };
        assert!(told().is_err(), "{room}");
    }
}

#[cfg(feature = "rerun")]
#[test]
fn rerun_is_told_the_same() {
    use ::rerun::log::{Chunk, LogMsg};
    let (stream, stored) = super::rerun::builder().memory().unwrap();
    let mut recording = Box::new(RerunRecording::to(stream));
    told(&mut *recording).unwrap();
    recording.finish().unwrap();
    let messages = stored.take().into_iter();
    let chunks = messages.filter_map(|message| match message {
        LogMsg::ArrowMsg(_, message) => Some(Chunk::from_arrow_msg(&message).unwrap()),
        _ => None,
    });
    let found: BTreeMap<String, usize> = chunks
        .map(|c| (c.entity_path().to_string(), c.num_rows()))
        .filter(|(path, _)| !path.starts_with("/__"))
        .collect();
    let wanted = [
        "/camera/image",
        "/camera/image/left",
        "/map/cloud",
        "/map/relief",
        "/map/world",
        "/map/world/route",
    ];
    assert_eq!(found, wanted.map(|path| (path.to_owned(), 1)).into());
}
