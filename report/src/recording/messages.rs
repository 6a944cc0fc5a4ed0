//! Messages that Foxglove knows by the names of their schemas, and these schemas, in JSON.
//!
//! After <https://docs.foxglove.dev/docs/sdk/schemas>: bytes are base64, numbers in them little-endian.

use barchan_geometry::Se3;
use serde::Serialize;
use serde_json::{Value, json};

/// Seconds and nanoseconds since 1970.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Time {
    pub sec: u32,
    pub nsec: u32,
}

impl Time {
    /// `None` where a recording has no such time.
    pub fn new(seconds: f64) -> Option<Self> {
        let whole = seconds.floor();
        let nanoseconds = ((seconds - whole) * 1e9).round();
        // What rounds up to a second is the next one.
        let (whole, nanoseconds) = match nanoseconds < 1e9 {
            true => (whole, nanoseconds),
            false => (whole + 1.0, 0.0),
        };
        let known = (0.0..=f64::from(u32::MAX)).contains(&whole);
        known.then_some(Self {
            sec: whole as u32,
            nsec: nanoseconds as u32,
        })
    }

    pub fn nanoseconds(self) -> u64 {
        u64::from(self.sec) * 1_000_000_000 + u64::from(self.nsec)
    }
}

/// A message and what Foxglove calls it.
pub trait Message: Serialize {
    /// The schema's name.
    const NAME: &'static str;
    /// The type of each of its fields, as JSON schema.
    fn fields() -> Value;
}

#[derive(Serialize)]
pub struct Vector3 {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Serialize)]
pub struct Vector2 {
    pub x: f64,
    pub y: f64,
}

#[derive(Serialize)]
pub struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

#[derive(Serialize)]
pub struct Pose {
    pub position: Vector3,
    pub orientation: Quaternion,
}

impl From<[f64; 3]> for Vector3 {
    fn from([x, y, z]: [f64; 3]) -> Self {
        Self { x, y, z }
    }
}

impl From<&Se3> for Pose {
    fn from(pose: &Se3) -> Self {
        let q = pose.rotation.coords;
        Self {
            position: <[f64; 3]>::from(pose.translation.vector).into(),
            orientation: Quaternion {
                x: q.x,
                y: q.y,
                z: q.z,
                w: q.w,
            },
        }
    }
}

#[derive(Serialize)]
pub struct FrameTransform<'a> {
    pub timestamp: Time,
    pub parent_frame_id: &'a str,
    pub child_frame_id: &'a str,
    pub translation: Vector3,
    pub rotation: Quaternion,
}

#[derive(Serialize)]
pub struct PosesInFrame<'a> {
    pub timestamp: Time,
    pub frame_id: &'a str,
    pub poses: Vec<Pose>,
}

#[derive(Serialize)]
pub struct CompressedImage<'a> {
    pub timestamp: Time,
    pub frame_id: &'a str,
    pub data: String,
    pub format: &'static str,
}

/// Of an image without distortion.
#[derive(Serialize)]
#[allow(non_snake_case)]
pub struct CameraCalibration<'a> {
    pub timestamp: Time,
    pub frame_id: &'a str,
    pub width: usize,
    pub height: usize,
    pub distortion_model: &'static str,
    pub D: [f64; 0],
    pub K: [f64; 9],
    pub R: [f64; 9],
    pub P: [f64; 12],
}

/// A number inside packed bytes.
#[derive(Serialize)]
pub struct PackedElementField {
    name: &'static str,
    offset: u32,
    r#type: u8,
}

impl PackedElementField {
    const UINT8: u8 = 1;
    const FLOAT32: u8 = 7;

    pub fn float32(name: &'static str, offset: u32) -> Self {
        Self {
            name,
            offset,
            r#type: Self::FLOAT32,
        }
    }

    /// Red, green, blue and alpha, a byte each, from this byte on.
    pub fn colour(offset: u32) -> [Self; 4] {
        let names = ["red", "green", "blue", "alpha"];
        let mut offset = offset..;
        names.map(|name| Self {
            name,
            offset: offset.next().unwrap_or_default(),
            r#type: Self::UINT8,
        })
    }
}

#[derive(Serialize)]
pub struct PointCloud<'a> {
    pub timestamp: Time,
    pub frame_id: &'a str,
    pub pose: Pose,
    pub point_stride: u32,
    pub fields: Vec<PackedElementField>,
    pub data: String,
}

/// Cells in the x-y plane of its pose, row after row from the least y on, each from the least x on.
#[derive(Serialize)]
pub struct Grid<'a> {
    pub timestamp: Time,
    pub frame_id: &'a str,
    pub pose: Pose,
    pub column_count: usize,
    pub cell_size: Vector2,
    pub row_stride: usize,
    pub cell_stride: usize,
    pub fields: Vec<PackedElementField>,
    pub data: String,
}

impl Message for FrameTransform<'_> {
    const NAME: &'static str = "foxglove.FrameTransform";
    fn fields() -> Value {
        json!({
            "timestamp": time(), "parent_frame_id": text(), "child_frame_id": text(),
            "translation": numbers(&["x", "y", "z"]), "rotation": numbers(&["x", "y", "z", "w"]),
        })
    }
}

impl Message for PosesInFrame<'_> {
    const NAME: &'static str = "foxglove.PosesInFrame";
    fn fields() -> Value {
        json!({ "timestamp": time(), "frame_id": text(), "poses": list(pose()) })
    }
}

impl Message for CompressedImage<'_> {
    const NAME: &'static str = "foxglove.CompressedImage";
    fn fields() -> Value {
        json!({ "timestamp": time(), "frame_id": text(), "data": bytes(), "format": text() })
    }
}

impl Message for CameraCalibration<'_> {
    const NAME: &'static str = "foxglove.CameraCalibration";
    fn fields() -> Value {
        let matrix = |count: usize| json!({ "type": "array", "items": { "type": "number" }, "minItems": count, "maxItems": count });
        json!({
            "timestamp": time(), "frame_id": text(), "width": whole(), "height": whole(),
            "distortion_model": text(), "D": list(json!({ "type": "number" })),
            "K": matrix(9), "R": matrix(9), "P": matrix(12),
        })
    }
}

impl Message for PointCloud<'_> {
    const NAME: &'static str = "foxglove.PointCloud";
    fn fields() -> Value {
        json!({
            "timestamp": time(), "frame_id": text(), "pose": pose(), "point_stride": whole(),
            "fields": list(packed_field()), "data": bytes(),
        })
    }
}

impl Message for Grid<'_> {
    const NAME: &'static str = "foxglove.Grid";
    fn fields() -> Value {
        json!({
            "timestamp": time(), "frame_id": text(), "pose": pose(), "column_count": whole(),
            "cell_size": numbers(&["x", "y"]), "row_stride": whole(), "cell_stride": whole(),
            "fields": list(packed_field()), "data": bytes(),
        })
    }
}

/// The JSON schema of a message.
pub fn schema<M: Message>() -> Value {
    let mut schema = object(M::fields());
    schema["title"] = M::NAME.into();
    schema
}

fn object(fields: Value) -> Value {
    let names = fields.as_object().map(|f| f.keys().cloned().collect());
    let names: Vec<String> = names.unwrap_or_default();
    json!({ "type": "object", "properties": fields, "required": names })
}

fn time() -> Value {
    let mut time = object(json!({
        "sec": whole(),
        "nsec": { "type": "integer", "minimum": 0, "maximum": 999_999_999 },
    }));
    // Foxglove takes an object of this title for a time.
    time["title"] = "time".into();
    time
}

fn text() -> Value {
    json!({ "type": "string" })
}

fn whole() -> Value {
    json!({ "type": "integer", "minimum": 0 })
}

fn bytes() -> Value {
    json!({ "type": "string", "contentEncoding": "base64" })
}

fn list(items: Value) -> Value {
    json!({ "type": "array", "items": items })
}

fn numbers(names: &[&str]) -> Value {
    let fields = names
        .iter()
        .map(|n| ((*n).to_owned(), json!({ "type": "number" })));
    object(Value::Object(fields.collect()))
}

fn pose() -> Value {
    object(json!({
        "position": numbers(&["x", "y", "z"]),
        "orientation": numbers(&["x", "y", "z", "w"]),
    }))
}

fn packed_field() -> Value {
    object(json!({ "name": text(), "offset": whole(), "type": whole() }))
}
