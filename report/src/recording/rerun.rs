use std::collections::BTreeMap;
use std::path::Path;

use barchan_geometry::{RectifiedRig, Se3};
use barchan_terrain::CloudPoint;
use image::RgbImage;
use rerun::{
    EncodedImage, LineStrips3D, Mesh3D, Pinhole, Points3D, Quaternion, RecordingStream,
    RecordingStreamBuilder, Transform3D, TriangleIndices,
};

use super::Recording;
use crate::{Relief, ReportError, jpeg_bytes};

/// A recording for the Rerun viewer: in a file, or in the viewer at once.
pub struct RerunRecording {
    stream: RecordingStream,
    /// Where each frame is in the tree of what is shown: below its parent.
    paths: BTreeMap<String, String>,
}

impl RerunRecording {
    /// Into a file, `.rrd`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn save(path: &Path) -> Result<Self, ReportError> {
        Ok(Self::to(builder().save(path)?))
    }

    /// Into a viewer that is started, or runs already.
    ///
    /// # Errors
    /// When there is no `rerun` on the path.
    pub fn spawn() -> Result<Self, ReportError> {
        Ok(Self::to(builder().spawn()?))
    }

    pub(crate) fn to(stream: RecordingStream) -> Self {
        Self {
            stream,
            paths: BTreeMap::new(),
        }
    }

    /// Where a topic of a frame is in the tree.
    fn path(&self, frame: &str, topic: &str) -> String {
        let frame = self.paths.get(frame).map_or(frame, String::as_str);
        format!("{frame}/{}", name(topic))
    }

    fn log(
        &self,
        time: f64,
        path: &str,
        what: &impl rerun::AsComponents,
    ) -> Result<(), ReportError> {
        self.stream.set_duration_secs("time", time);
        Ok(self.stream.log(path, what)?)
    }
}

pub(crate) fn builder() -> RecordingStreamBuilder {
    RecordingStreamBuilder::new("barchan")
}

/// Places are drawn in 32 bits.
fn single(place: impl Into<[f64; 3]>) -> [f32; 3] {
    place.into().map(|v| v as f32)
}

#[allow(non_snake_case)]
impl Recording for RerunRecording {
    fn transform(
        &mut self,
        time: f64,
        parent: &str,
        child: &str,
        T_parent_child: &Se3,
    ) -> Result<(), ReportError> {
        let path = self.path(parent, child);
        let q = T_parent_child.rotation.coords;
        let rotation = Quaternion::from_xyzw([q.x, q.y, q.z, q.w].map(|v| v as f32));
        let place = single(T_parent_child.translation.vector);
        self.log(
            time,
            &path,
            &Transform3D::from_translation_rotation(place, rotation),
        )?;
        self.paths.insert(child.to_owned(), path);
        Ok(())
    }

    fn route(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        poses: &[Se3],
    ) -> Result<(), ReportError> {
        let places = poses.iter().map(|p| single(p.translation.vector));
        let way = LineStrips3D::new([places.collect::<Vec<_>>()]);
        self.log(time, &self.path(frame, topic), &way)
    }

    fn camera(
        &mut self,
        time: f64,
        _: &str,
        frame: &str,
        rig: &RectifiedRig,
    ) -> Result<(), ReportError> {
        let focal = [rig.fx as f32, rig.fy as f32];
        let size = [rig.width as f32, rig.height as f32];
        let pinhole = Pinhole::from_focal_length_and_resolution(focal, size)
            .with_principal_point([rig.cx as f32, rig.cy as f32]);
        // What is below a pinhole is in its image: points of the camera are beside it.
        self.log(time, &self.path(frame, "image"), &pinhole)
    }

    fn image(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        picture: &RgbImage,
    ) -> Result<(), ReportError> {
        let path = format!("{}/{}", self.path(frame, "image"), name(topic));
        let picture = EncodedImage::from_file_contents(jpeg_bytes(picture)?);
        self.log(time, &path, &picture)
    }

    fn cloud(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        points: &[CloudPoint],
    ) -> Result<(), ReportError> {
        let finite = |p: &&CloudPoint| p.position.iter().all(|v| v.is_finite());
        let places = points.iter().filter(finite);
        let places = places.map(|p| single([p.position.x, p.position.y, p.position.z]));
        let colours = points.iter().filter(finite).map(|p| p.colour);
        let cloud = Points3D::new(places).with_colors(colours);
        self.log(time, &self.path(frame, topic), &cloud)
    }

    fn relief(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        relief: &Relief,
    ) -> Result<(), ReportError> {
        let cells = relief.thinned();
        let (mut places, mut colours) = (vec![], vec![]);
        // The number of each known cell's vertex.
        let mut vertices = vec![None; cells.width * cells.height];
        for (k, vertex) in vertices.iter_mut().enumerate() {
            let (column, row) = (k % cells.width, k / cells.width);
            let height = cells.height_at(column, row);
            if height.is_finite() {
                *vertex = Some(places.len() as u32);
                let east = cells.west + (column as f64 + 0.5) * cells.cell[0];
                let north = cells.north - (row as f64 + 0.5) * cells.cell[1];
                places.push(single([east, north, height.into()]));
                colours.push(cells.colour_at(column, row));
            }
        }
        let mut triangles = vec![];
        for row in 1..cells.height {
            for column in 1..cells.width {
                let at = |row: usize, column: usize| vertices[row * cells.width + column];
                let around = [
                    at(row - 1, column - 1),
                    at(row, column - 1),
                    at(row, column),
                    at(row - 1, column),
                ];
                if let [Some(a), Some(b), Some(c), Some(d)] = around {
                    triangles.push(TriangleIndices::from([a, b, c]));
                    triangles.push(TriangleIndices::from([a, c, d]));
                }
            }
        }
        let mesh = Mesh3D::new(places)
            .with_triangle_indices(triangles)
            .with_vertex_colors(colours);
        self.log(time, &self.path(frame, topic), &mesh)
    }

    fn finish(self: Box<Self>) -> Result<(), ReportError> {
        self.stream
            .flush_blocking()
            .map_err(|e| ReportError::Viewer(e.to_string()))
    }
}

/// The last part of a topic.
fn name(topic: &str) -> &str {
    topic.rsplit('/').next().unwrap_or(topic)
}
