use std::collections::BTreeMap;
use std::io::Write;

use barchan_geometry::{RectifiedRig, Se3};
use barchan_terrain::CloudPoint;
use image::RgbImage;

use super::messages::{
    CameraCalibration, CompressedImage, FrameTransform, Grid, Message, PackedElementField,
    PointCloud, Pose, PosesInFrame, Time, Vector2, schema,
};
use super::{Recording, mcap};
use crate::{Relief, ReportError, base64, jpeg_bytes};

/// A recording in an MCAP file whose messages Foxglove knows.
pub struct FoxgloveRecording<W: Write> {
    file: mcap::Writer<W>,
    /// Number of the channel of each topic.
    channels: BTreeMap<String, u16>,
}

impl<W: Write> FoxgloveRecording<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn new(file: W) -> Result<Self, ReportError> {
        Ok(Self {
            file: mcap::Writer::new(file)?,
            channels: BTreeMap::new(),
        })
    }

    fn write<M: Message>(
        &mut self,
        topic: &str,
        time: Time,
        message: &M,
    ) -> Result<(), ReportError> {
        let channel = match self.channels.get(topic) {
            Some(channel) => *channel,
            None => {
                let schema = schema::<M>().to_string();
                let channel = self.file.channel(topic, M::NAME, &schema)?;
                self.channels.insert(topic.to_owned(), channel);
                channel
            }
        };
        let data = serde_json::to_vec(message)?;
        Ok(self.file.message(channel, time.nanoseconds(), &data)?)
    }
}

fn stamp(time: f64) -> Result<Time, ReportError> {
    Time::new(time).ok_or(ReportError::Time(time))
}

/// Without rotation.
fn at(position: [f64; 3]) -> Pose {
    let [x, y, z] = position;
    (&Se3::translation(x, y, z)).into()
}

#[allow(non_snake_case)]
impl<W: Write> Recording for FoxgloveRecording<W> {
    fn transform(
        &mut self,
        time: f64,
        parent: &str,
        child: &str,
        T_parent_child: &Se3,
    ) -> Result<(), ReportError> {
        let timestamp = stamp(time)?;
        let pose = Pose::from(T_parent_child);
        let message = FrameTransform {
            timestamp,
            parent_frame_id: parent,
            child_frame_id: child,
            translation: pose.position,
            rotation: pose.orientation,
        };
        self.write("/tf", timestamp, &message)
    }

    fn route(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        poses: &[Se3],
    ) -> Result<(), ReportError> {
        let timestamp = stamp(time)?;
        let message = PosesInFrame {
            timestamp,
            frame_id: frame,
            poses: poses.iter().map(Pose::from).collect(),
        };
        self.write(topic, timestamp, &message)
    }

    fn camera(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        rig: &RectifiedRig,
    ) -> Result<(), ReportError> {
        let timestamp = stamp(time)?;
        let (fx, fy, cx, cy) = (rig.fx, rig.fy, rig.cx, rig.cy);
        let message = CameraCalibration {
            timestamp,
            frame_id: frame,
            width: rig.width,
            height: rig.height,
            distortion_model: "",
            D: [],
            K: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        };
        self.write(topic, timestamp, &message)
    }

    fn image(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        picture: &RgbImage,
    ) -> Result<(), ReportError> {
        let timestamp = stamp(time)?;
        let message = CompressedImage {
            timestamp,
            frame_id: frame,
            data: base64(&jpeg_bytes(picture)?),
            format: "jpeg",
        };
        self.write(topic, timestamp, &message)
    }

    fn cloud(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        points: &[CloudPoint],
    ) -> Result<(), ReportError> {
        const STRIDE: usize = 16;
        let timestamp = stamp(time)?;
        let finite = |p: &&CloudPoint| p.position.iter().all(|v| v.is_finite());
        // In a country's grid 32 bits do not tell millimetres: they count from the first point.
        let origin = points.iter().find(finite).map(|p| p.position);
        let origin = origin.unwrap_or_default();
        let mut data = Vec::with_capacity(STRIDE * points.len());
        for point in points.iter().filter(finite) {
            let [x, y, z] = (point.position - origin).into();
            let [red, green, blue] = point.colour;
            data.extend([x, y, z].into_iter().flat_map(|v| (v as f32).to_le_bytes()));
            data.extend([red, green, blue, u8::MAX]);
        }
        let mut fields = Vec::from([("x", 0), ("y", 4), ("z", 8)])
            .into_iter()
            .map(|(name, offset)| PackedElementField::float32(name, offset))
            .collect::<Vec<_>>();
        fields.extend(PackedElementField::colour(12));
        let message = PointCloud {
            timestamp,
            frame_id: frame,
            pose: at(origin.into()),
            point_stride: STRIDE as u32,
            fields,
            data: base64(&data),
        };
        self.write(topic, timestamp, &message)
    }

    fn relief(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        relief: &Relief,
    ) -> Result<(), ReportError> {
        const STRIDE: usize = 8;
        let timestamp = stamp(time)?;
        let cells = relief.thinned();
        let mut data = Vec::with_capacity(STRIDE * cells.width * cells.height);
        // Ours run south, Foxglove's north.
        for row in (0..cells.height).rev() {
            for column in 0..cells.width {
                let height = cells.height_at(column, row);
                let [red, green, blue] = cells.colour_at(column, row);
                let alpha = if height.is_finite() { u8::MAX } else { 0 };
                data.extend(height.to_le_bytes());
                data.extend([red, green, blue, alpha]);
            }
        }
        let mut fields = vec![PackedElementField::float32("elevation", 0)];
        fields.extend(PackedElementField::colour(4));
        let [x, y] = cells.cell;
        let south = cells.north - cells.height as f64 * y;
        let message = Grid {
            timestamp,
            frame_id: frame,
            // Below the ground, so that it does not hide the cloud.
            pose: at([cells.west, south, cells.low.into()]),
            column_count: cells.width,
            cell_size: Vector2 { x, y },
            row_stride: STRIDE * cells.width,
            cell_stride: STRIDE,
            fields,
            data: base64(&data),
        };
        self.write(topic, timestamp, &message)
    }

    fn finish(self: Box<Self>) -> Result<(), ReportError> {
        Ok(self.file.finish()?)
    }
}
