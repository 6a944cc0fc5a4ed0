//! Maps as safetensors files, for a later run to go on in and for Python to look into.

use std::collections::BTreeMap;

use barchan_geometry::{RectifiedRig, Se3};
use nalgebra::{Point3, Quaternion, Translation3, UnitQuaternion};
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};

use crate::features::{Features, Keypoint};
use crate::map::{Keyframe, Map, MapPoint, PointId};
use crate::patch::Patch;

/// Why a file is not the map that is wanted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not a map that can be gone on in: {0}")]
pub struct MapFileError(String);

impl Map {
    /// The bytes of a safetensors file. Rows of `keyframe.*` are key frames, rows of `feature.*` their
    /// features one after the other, rows of `point.*` map points: poses as translation and
    /// quaternion (x, y, z, w) that map world points to the left camera, key points as (u, v, scale,
    /// sigma), unknown disparities not numbers, points that nothing sees -1.
    pub fn to_bytes(&self, rig: &RectifiedRig) -> Result<Vec<u8>, MapFileError> {
        let frames = || self.keyframes.iter();
        let features = || frames().flat_map(|k| 0..k.points.len()).count();
        let (k, f, p) = (self.keyframes.len(), features(), self.points.len());
        let points = || self.points.values();
        let names: Vec<&str> = frames().map(|k| k.name.as_str()).collect();
        let known = |d: &Option<f64>| d.unwrap_or(f64::NAN);
        let keypoints = || frames().flat_map(|k| &k.features.keypoints);
        let patches = points().flat_map(|p| match &p.patch {
            Some(patch) => patch.to_numbers().to_vec(),
            None => vec![f32::NAN; Patch::NUMBERS],
        });
        let parts: Vec<(&str, Dtype, Vec<usize>, Vec<u8>)> = vec![
            ("rig", Dtype::F64, vec![1, 8], doubles(numbers_of(rig))),
            (
                "keyframe.frame",
                Dtype::I64,
                vec![k, 1],
                integers(frames().map(|k| k.frame)),
            ),
            (
                "keyframe.time",
                Dtype::F64,
                vec![k, 1],
                doubles(frames().map(|k| k.time)),
            ),
            (
                "keyframe.submap",
                Dtype::I64,
                vec![k, 1],
                integers(frames().map(|k| k.submap)),
            ),
            (
                "keyframe.T_cam_world",
                Dtype::F64,
                vec![k, 7],
                doubles(frames().flat_map(|k| {
                    let (t, q) = (k.T_cam_world.translation.vector, k.T_cam_world.rotation);
                    [t.x, t.y, t.z, q.i, q.j, q.k, q.w]
                })),
            ),
            (
                "keyframe.carried",
                Dtype::F64,
                vec![k, 2],
                doubles(frames().flat_map(|k| {
                    let (translation, rotation) = k.carried.unwrap_or((f64::NAN, f64::NAN));
                    [translation, rotation]
                })),
            ),
            (
                "keyframe.features",
                Dtype::I64,
                vec![k, 1],
                integers(frames().map(|k| k.points.len())),
            ),
            (
                "keyframe.descriptor_bits",
                Dtype::I64,
                vec![k, 1],
                integers(frames().map(|k| k.features.bits as usize)),
            ),
            (
                "keyframe.names",
                Dtype::U8,
                vec![names.join("\n").len(), 1],
                names.join("\n").into_bytes(),
            ),
            (
                "feature.keypoint",
                Dtype::F64,
                vec![f, 4],
                doubles(keypoints().flat_map(|k| [k.u, k.v, k.scale, k.sigma])),
            ),
            (
                "feature.descriptor",
                Dtype::U8,
                vec![f, 64],
                frames()
                    .flat_map(|k| k.features.descriptors.iter().flatten().copied())
                    .collect(),
            ),
            (
                "feature.disparity",
                Dtype::F64,
                vec![f, 1],
                doubles(frames().flat_map(|k| k.disparities.iter().map(known))),
            ),
            (
                "feature.proof_disparity",
                Dtype::F64,
                vec![f, 1],
                doubles(frames().flat_map(|k| k.proof_disparities.iter().map(known))),
            ),
            (
                "feature.point",
                Dtype::I64,
                vec![f, 1],
                frames()
                    .flat_map(|k| &k.points)
                    .flat_map(|p| p.map_or(-1, |id| id as i64).to_le_bytes())
                    .collect(),
            ),
            (
                "point.id",
                Dtype::I64,
                vec![p, 1],
                integers(self.points.keys().copied()),
            ),
            (
                "point.position",
                Dtype::F64,
                vec![p, 3],
                doubles(points().flat_map(|p| [p.position.x, p.position.y, p.position.z])),
            ),
            (
                "point.descriptor",
                Dtype::U8,
                vec![p, 64],
                points().flat_map(|p| p.descriptor).collect(),
            ),
            (
                "point.scale",
                Dtype::F64,
                vec![p, 1],
                doubles(points().map(|p| p.scale)),
            ),
            (
                "point.colour",
                Dtype::U8,
                vec![p, 3],
                points().flat_map(|p| p.colour).collect(),
            ),
            (
                "point.patch",
                Dtype::F32,
                vec![p, Patch::NUMBERS],
                patches.flat_map(f32::to_le_bytes).collect(),
            ),
        ];
        let failed = |e: safetensors::SafeTensorError| MapFileError(e.to_string());
        let views: Result<Vec<_>, _> = parts
            .iter()
            .map(|(name, kind, shape, data)| {
                Ok((
                    *name,
                    TensorView::new(*kind, shape.clone(), data).map_err(failed)?,
                ))
            })
            .collect();
        serialize(views?, None).map_err(failed)
    }

    /// Reads what [`Map::to_bytes`] writes, for the same rig.
    ///
    /// # Errors
    /// When the bytes are of something else or damaged, or the map was made with another rig.
    pub fn from_bytes(bytes: &[u8], rig: &RectifiedRig) -> Result<Self, MapFileError> {
        let bad = |message: &str| MapFileError(message.to_owned());
        let file = SafeTensors::deserialize(bytes).map_err(|e| MapFileError(e.to_string()))?;
        let file = Tables(file);
        let made_with = file.doubles("rig", 8)?;
        let same = |(a, b): (&f64, f64)| (a - b).abs() <= 1e-9 * b.abs().max(1.0);
        if !made_with.iter().zip(numbers_of(rig)).all(same) {
            return Err(bad("it was made with another rig"));
        }

        let ids = file.integers("point.id")?;
        let positions = file.doubles("point.position", 3)?;
        let looks = file.bytes("point.descriptor", 64)?;
        let scales = file.doubles("point.scale", 1)?;
        let colours = file.bytes("point.colour", 3)?;
        let patches = file.floats("point.patch", Patch::NUMBERS)?;
        let rows = [
            positions.len() / 3,
            looks.len() / 64,
            scales.len(),
            colours.len() / 3,
        ];
        if rows.iter().any(|r| *r != ids.len()) || patches.len() != ids.len() * Patch::NUMBERS {
            return Err(bad("its points are not all of equal number"));
        }
        let mut points = BTreeMap::<PointId, MapPoint>::new();
        for (i, id) in ids.iter().enumerate() {
            let position = Point3::from_slice(&positions[3 * i..3 * i + 3]);
            let patch = &patches[i * Patch::NUMBERS..(i + 1) * Patch::NUMBERS];
            if !position.iter().all(|x| x.is_finite()) || !scales[i].is_finite() {
                return Err(bad("a point is nowhere"));
            }
            let point = MapPoint {
                position,
                descriptor: std::array::from_fn(|b| looks[64 * i + b]),
                scale: scales[i],
                patch: Patch::from_numbers(patch),
                colour: std::array::from_fn(|c| colours[3 * i + c]),
                observations: Vec::new(),
            };
            points.insert(*id, point);
        }

        let frames = file.integers("keyframe.frame")?;
        let times = file.doubles("keyframe.time", 1)?;
        let submaps = file.integers("keyframe.submap")?;
        let poses = file.doubles("keyframe.T_cam_world", 7)?;
        let carried = file.doubles("keyframe.carried", 2)?;
        let counts = file.integers("keyframe.features")?;
        let bits = file.integers("keyframe.descriptor_bits")?;
        let names = String::from_utf8(file.bytes("keyframe.names", 1)?.to_vec())
            .map_err(|_| bad("a name is no text"))?;
        let names: Vec<&str> = names.split('\n').collect();
        let rows = [
            times.len(),
            submaps.len(),
            poses.len() / 7,
            carried.len() / 2,
            counts.len(),
            bits.len(),
        ];
        if rows.iter().any(|r| *r != frames.len()) || names.len() != frames.len().max(1) {
            return Err(bad("its key frames are not all of equal number"));
        }
        let keypoints = file.doubles("feature.keypoint", 4)?;
        let looks = file.bytes("feature.descriptor", 64)?;
        let disparities = file.doubles("feature.disparity", 1)?;
        let proofs = file.doubles("feature.proof_disparity", 1)?;
        let seen = file.signed("feature.point")?;
        let rows = [
            keypoints.len() / 4,
            looks.len() / 64,
            disparities.len(),
            proofs.len(),
        ];
        let all = counts.iter().try_fold(0usize, |sum, c| sum.checked_add(*c));
        if rows.iter().any(|r| *r != seen.len()) || all != Some(seen.len()) {
            return Err(bad("its features are not all of equal number"));
        }

        let mut map = Self::default();
        let mut start = 0;
        for (k, count) in counts.iter().enumerate() {
            let range = start..start + count;
            start += count;
            let pose = &poses[7 * k..7 * k + 7];
            let turn = Quaternion::new(pose[6], pose[3], pose[4], pose[5]);
            let whole = pose.iter().all(|x| x.is_finite()) && (turn.norm() - 1.0).abs() < 1e-6;
            if !whole || bits[k] > 512 {
                return Err(bad("a key frame has no pose or no descriptors"));
            }
            let known = |d: &[f64]| {
                d[range.clone()]
                    .iter()
                    .map(|d| d.is_finite().then_some(*d))
                    .collect()
            };
            let at = |f: usize| Keypoint {
                u: keypoints[4 * f],
                v: keypoints[4 * f + 1],
                scale: keypoints[4 * f + 2],
                sigma: keypoints[4 * f + 3],
            };
            let mut frame = Keyframe {
                frame: frames[k],
                name: names[k].to_owned(),
                time: times[k],
                submap: submaps[k],
                T_cam_world: Se3::from_parts(
                    Translation3::new(pose[0], pose[1], pose[2]),
                    UnitQuaternion::new_unchecked(turn),
                ),
                carried: Some((carried[2 * k], carried[2 * k + 1]))
                    .filter(|(a, b)| a.is_finite() && b.is_finite()),
                features: Features {
                    keypoints: range.clone().map(at).collect(),
                    descriptors: (range.clone())
                        .map(|f| std::array::from_fn(|b| looks[64 * f + b]))
                        .collect(),
                    bits: bits[k] as u32,
                },
                disparities: known(&disparities),
                proof_disparities: known(&proofs),
                points: vec![None; *count],
            };
            for (feature, id) in seen[range.clone()].iter().enumerate() {
                let Ok(id) = PointId::try_from(*id) else {
                    continue;
                };
                let point = points
                    .get_mut(&id)
                    .ok_or_else(|| bad("a point is missing"))?;
                point.observations.push((k, feature));
                frame.points[feature] = Some(id);
            }
            map.keyframes.push(frame);
        }
        map.next = points.keys().next_back().map_or(0, |id| id + 1);
        map.points = points;
        Ok(map)
    }
}

fn numbers_of(rig: &RectifiedRig) -> [f64; 8] {
    let (width, height) = (rig.width as f64, rig.height as f64);
    [
        width,
        height,
        rig.fx,
        rig.fy,
        rig.cx,
        rig.cy,
        rig.baseline,
        rig.doffs,
    ]
}

fn doubles(values: impl IntoIterator<Item = f64>) -> Vec<u8> {
    values.into_iter().flat_map(f64::to_le_bytes).collect()
}

fn integers(values: impl IntoIterator<Item = usize>) -> Vec<u8> {
    values
        .into_iter()
        .flat_map(|v| (v as i64).to_le_bytes())
        .collect()
}

/// Tables of a safetensors file.
struct Tables<'a>(SafeTensors<'a>);

impl Tables<'_> {
    /// The bytes of a table of so many columns.
    fn rows(&self, name: &str, kind: Dtype, columns: usize) -> Result<&[u8], MapFileError> {
        let table = self
            .0
            .tensor(name)
            .map_err(|e| MapFileError(e.to_string()))?;
        if table.dtype() != kind || table.shape().len() != 2 || table.shape()[1] != columns {
            return Err(MapFileError(format!(
                "{name} is no table of {columns} columns"
            )));
        }
        Ok(table.data())
    }

    fn bytes(&self, name: &str, columns: usize) -> Result<&[u8], MapFileError> {
        self.rows(name, Dtype::U8, columns)
    }

    fn doubles(&self, name: &str, columns: usize) -> Result<Vec<f64>, MapFileError> {
        let (chunks, _) = self.rows(name, Dtype::F64, columns)?.as_chunks();
        Ok(chunks.iter().map(|b| f64::from_le_bytes(*b)).collect())
    }

    fn floats(&self, name: &str, columns: usize) -> Result<Vec<f32>, MapFileError> {
        let (chunks, _) = self.rows(name, Dtype::F32, columns)?.as_chunks();
        Ok(chunks.iter().map(|b| f32::from_le_bytes(*b)).collect())
    }

    fn signed(&self, name: &str) -> Result<Vec<i64>, MapFileError> {
        let (chunks, _) = self.rows(name, Dtype::I64, 1)?.as_chunks();
        Ok(chunks.iter().map(|b| i64::from_le_bytes(*b)).collect())
    }

    /// Whole numbers that count or name something.
    fn integers(&self, name: &str) -> Result<Vec<usize>, MapFileError> {
        let number = |v: i64| {
            usize::try_from(v).map_err(|_| MapFileError(format!("{name} has the number {v}")))
        };
        self.signed(name)?.into_iter().map(number).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig() -> RectifiedRig {
        RectifiedRig {
            width: 320,
            height: 240,
            fx: 250.0,
            fy: 250.0,
            cx: 160.0,
            cy: 120.0,
            baseline: 0.12,
            doffs: 0.0,
        }
    }

    fn map() -> Map {
        let mut map = Map::default();
        for k in 0..3usize {
            let at = |f: usize| Keypoint {
                u: 10.5 * f as f64,
                v: 7.0,
                scale: 1.2,
                sigma: 0.5,
            };
            map.keyframes.push(Keyframe {
                frame: 5 * k,
                name: format!("frame {k}"),
                time: 0.1 * k as f64,
                submap: k / 2,
                T_cam_world: Se3::new([0.1 * k as f64, 0.2, 0.3].into(), [0.0, 0.1, 0.2].into()),
                carried: (k == 2).then_some((0.25, 0.01)),
                features: Features {
                    keypoints: (0..4).map(at).collect(),
                    descriptors: (0..4).map(|f| [(16 * k + f) as u8; 64]).collect(),
                    bits: 256,
                },
                disparities: vec![None, Some(3.25), Some(-1.0), None],
                proof_disparities: vec![Some(2.0), Some(3.0), None, None],
                points: vec![None; 4],
            });
        }
        let image = image::ImageBuffer::from_fn(40, 40, |x, y| image::Luma([(x * y) as f32]));
        let patch = Patch::cut(&image, [20.0, 20.0].into(), 1.2, 3.0);
        assert!(patch.is_some());
        let a = map.add_point(0, 1, Point3::new(1.0, 2.0, 3.0), [1, 2, 3], patch);
        map.observe(1, 0, a);
        let b = map.add_point(1, 2, Point3::new(-1.0, 0.5, 9.0), [4, 5, 6], None);
        map.observe(2, 3, b);
        map
    }

    #[test]
    fn maps_come_back_as_they_were() {
        let bytes = map().to_bytes(&rig()).unwrap();
        let back = Map::from_bytes(&bytes, &rig()).unwrap();
        assert_eq!(format!("{back:?}"), format!("{:?}", map()));
        assert_eq!(back.to_bytes(&rig()).unwrap(), bytes);
        let nothing = Map::default().to_bytes(&rig()).unwrap();
        assert!(
            Map::from_bytes(&nothing, &rig())
                .unwrap()
                .keyframes
                .is_empty()
        );
    }

    #[test]
    fn what_is_damaged_or_of_another_rig_is_refused() {
        let bytes = map().to_bytes(&rig()).unwrap();
        let other = RectifiedRig {
            baseline: 0.2,
            ..rig()
        };
        let error = Map::from_bytes(&bytes, &other).unwrap_err().to_string();
        assert!(error.contains("another rig"), "{error}");
        for length in [0, 7, 100, bytes.len() - 1] {
            assert!(Map::from_bytes(&bytes[..length], &rig()).is_err());
        }
        // Any one byte may be wrong: an error or another map, and never a panic.
        for k in (0..bytes.len()).step_by(3) {
            let mut broken = bytes.clone();
            broken[k] ^= 0xff;
            let _ = Map::from_bytes(&broken, &rig());
        }
    }
}
