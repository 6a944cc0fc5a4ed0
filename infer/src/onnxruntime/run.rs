//! From pairs to the inputs of a model and from its outputs to planes, as a [`Contract`] says.

use std::borrow::Cow;

use barchan_datasets::{Rgb, luma};
use image::imageops::{self, FilterType};
use ort::session::{Session, SessionInputValue, SessionOutputs};
use ort::value::Tensor;

use super::contract::{Channels, Contract, Layout, OutputLayout, Side, Unit};

/// Sizes on the way of an image into a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Geometry {
    /// Width and height of the image.
    pub image: [usize; 2],
    /// To which it is resized.
    pub resized: [usize; 2],
    /// To which that is padded, to the right and below: what the model is given.
    pub given: [usize; 2],
}

impl Geometry {
    pub fn new(contract: &Contract, image: [usize; 2]) -> Self {
        let size = &contract.size;
        let fixed = [size.width, size.height];
        let resized = [0, 1].map(|axis| fixed[axis].unwrap_or(image[axis]));
        let given = [0, 1].map(|axis| {
            let padded = || {
                resized[axis]
                    .max(size.at_least)
                    .next_multiple_of(size.multiple)
            };
            fixed[axis].unwrap_or_else(padded)
        });
        Self {
            image,
            resized,
            given,
        }
    }

    /// Pixels of the image that one of the output's unit is.
    pub fn pixels(&self, unit: Unit) -> f64 {
        let of_given = match unit {
            Unit::Pixels => 1.0,
            Unit::Width => self.given[0] as f64,
        };
        of_given * self.image[0] as f64 / self.resized[0] as f64
    }

    /// A plane over what the model was given, read at the pixels of the image: linearly, NaN where a
    /// neighbour is, infinities unknown too.
    pub fn to_image(self, plane: &[f32], [columns, rows]: [usize; 2], factor: f32) -> Vec<f32> {
        let known = |v: f32| if v.is_finite() { v * factor } else { f32::NAN };
        if [columns, rows] == self.given && self.resized == self.image {
            let rows = plane.chunks_exact(columns).take(self.image[1]);
            return rows
                .flat_map(|row| row[..self.image[0]].iter().map(|v| known(*v)))
                .collect();
        }
        // Pixel centres are at integers in all three grids, and their borders coincide.
        let samples = |axis: usize, length: usize| -> Vec<(usize, usize, f32)> {
            let scale = self.resized[axis] as f64 / self.image[axis] as f64 * length as f64
                / self.given[axis] as f64;
            (0..self.image[axis])
                .map(|i| {
                    let at = ((i as f64 + 0.5) * scale - 0.5).clamp(0.0, (length - 1) as f64);
                    let first = at as usize;
                    (
                        first,
                        (first + 1).min(length - 1),
                        (at - first as f64) as f32,
                    )
                })
                .collect()
        };
        let (across, down) = (samples(0, columns), samples(1, rows));
        let mut out = Vec::with_capacity(self.image[0] * self.image[1]);
        // A weight of zero must not let an unknown neighbour in.
        let mix = |a: f32, b: f32, t: f32| if t == 0.0 { a } else { a + t * (b - a) };
        for (y0, y1, ty) in down {
            let (upper, lower) = (&plane[y0 * columns..], &plane[y1 * columns..]);
            out.extend(across.iter().map(|(x0, x1, tx)| {
                let (a, b) = (
                    mix(upper[*x0], upper[*x1], *tx),
                    mix(lower[*x0], lower[*x1], *tx),
                );
                known(mix(a, b, ty))
            }));
        }
        out
    }
}

/// Runs pairs of one size through a model.
pub(crate) fn run<'s>(
    session: &'s mut Session,
    contract: &Contract,
    geometry: &Geometry,
    pairs: &[(&Rgb, &Rgb)],
) -> ort::Result<SessionOutputs<'s>> {
    let given: Vec<[Cow<Rgb>; 2]> = pairs
        .iter()
        .map(|(left, right)| [fitted(left, geometry), fitted(right, geometry)])
        .collect();
    let mut inputs: Vec<(&str, SessionInputValue)> = Vec::new();
    for input in &contract.input {
        let [width, height] = geometry.given.map(|side| side / input.shrink);
        let channels = contract.images.channels.count() * input.images.len();
        let mut data = Vec::with_capacity(pairs.len() * channels * width * height);
        for pair in &given {
            let images: Vec<Cow<Rgb>> = (input.images.iter())
                .map(|side| {
                    let image = &pair[usize::from(*side == Side::Right)];
                    shrunk(image, [width, height])
                })
                .collect();
            append(&mut data, contract, &images);
        }
        let shape = match contract.images.layout {
            Layout::Nchw => [pairs.len(), channels, height, width],
            Layout::Nhwc => [pairs.len(), height, width, channels],
        };
        inputs.push((&input.name, Tensor::from_array((shape, data))?.into()));
    }
    session.run(inputs)
}

/// An image as large as the model wants it.
fn fitted<'a>(image: &'a Rgb, geometry: &Geometry) -> Cow<'a, Rgb> {
    let [width, height] = geometry.resized.map(|side| side as u32);
    let resized = if image.dimensions() == (width, height) {
        Cow::Borrowed(image)
    } else {
        Cow::Owned(imageops::resize(image, width, height, FilterType::Triangle))
    };
    if geometry.given == geometry.resized {
        return resized;
    }
    let row = 3 * width as usize;
    let mut data = Vec::with_capacity(3 * geometry.given[0] * geometry.given[1]);
    for y in 0..geometry.given[1] {
        let from = y.min(height as usize - 1) * row;
        let pixels = &resized.as_raw()[from..from + row];
        data.extend_from_slice(pixels);
        for _ in width as usize..geometry.given[0] {
            data.extend_from_slice(&pixels[row - 3..]);
        }
    }
    let [width, height] = geometry.given.map(|side| side as u32);
    // Three values a pixel by construction.
    Cow::Owned(Rgb::from_raw(width, height, data).unwrap_or_default())
}

fn shrunk<'a>(image: &'a Rgb, [width, height]: [usize; 2]) -> Cow<'a, Rgb> {
    let size = (width as u32, height as u32);
    if image.dimensions() == size {
        return Cow::Borrowed(image);
    }
    Cow::Owned(imageops::resize(
        image,
        size.0,
        size.1,
        FilterType::Triangle,
    ))
}

/// Appends images, stacked along their channels, in the layout and values that are wanted.
fn append(data: &mut Vec<f32>, contract: &Contract, images: &[Cow<Rgb>]) {
    let format = &contract.images;
    let lines: Vec<(f32, f32)> = (format.mean.iter().zip(&format.std))
        .map(|(mean, std)| ((1.0 / std) as f32, (-mean / std) as f32))
        .collect();
    // Each channel of each image: its values, how far apart they lie, and what becomes of them.
    let greys: Vec<_> = match format.channels {
        Channels::Grey => images.iter().map(|image| luma(image)).collect(),
        _ => Vec::new(),
    };
    let mut channels: Vec<(&[f32], usize, (f32, f32))> = Vec::new();
    for (k, image) in images.iter().enumerate() {
        match format.channels {
            Channels::Rgb => {
                channels.extend((0..3).map(|c| (&image.as_raw()[c..], 3, lines[c])));
            }
            Channels::Bgr => {
                channels.extend((0..3).map(|c| (&image.as_raw()[2 - c..], 3, lines[c])));
            }
            Channels::Grey => channels.push((&greys[k].as_raw()[..], 1, lines[0])),
        }
    }
    match format.layout {
        Layout::Nchw => {
            for (values, step, (scale, offset)) in channels {
                data.extend(values.iter().step_by(step).map(|v| scale * v + offset));
            }
        }
        Layout::Nhwc => {
            let pixels = images.first().map_or(0, |i| i.as_raw().len() / 3);
            for pixel in 0..pixels {
                for (values, step, (scale, offset)) in &channels {
                    data.push(scale * values[pixel * step] + offset);
                }
            }
        }
    }
}

/// One plane out of an output: its columns and rows, and its values row by row. Nothing when the
/// output has other axes, or too few pairs or channels.
pub(crate) fn plane(
    dims: &[i64],
    data: &[f32],
    layout: OutputLayout,
    channel: usize,
    pair: usize,
) -> Option<([usize; 2], Vec<f32>)> {
    let letters = layout.letters();
    if letters.len() != dims.len() {
        return None;
    }
    let dims: Vec<usize> = (dims.iter())
        .map(|d| usize::try_from(*d).ok())
        .collect::<Option<_>>()?;
    let mut stride = 1;
    let (mut start, mut columns, mut rows) = (0, (0, 0), (0, 0));
    for (letter, length) in letters.bytes().zip(&dims).rev() {
        match letter {
            b'w' => columns = (*length, stride),
            b'h' => rows = (*length, stride),
            b'c' if channel < *length => start += channel * stride,
            b'n' if pair < *length => start += pair * stride,
            _ => return None,
        }
        stride *= length;
    }
    if stride != data.len() || stride == 0 || (pair > 0 && !letters.contains('n')) {
        return None;
    }
    let mut values = Vec::with_capacity(columns.0 * rows.0);
    for y in 0..rows.0 {
        let row = &data[start + y * rows.1..];
        values.extend(row.iter().step_by(columns.1).take(columns.0));
    }
    Some(([columns.0, rows.0], values))
}

/// How many times smaller than the images a model was given its output is: 1, 2, 3 ... 32. Along a fixed
/// side the last pixel of the output may reach beyond the image. Nothing when it is no whole fraction.
pub(crate) fn resolution(
    contract: &Contract,
    geometry: &Geometry,
    size: [usize; 2],
) -> Option<usize> {
    let fixed = [contract.size.width, contract.size.height];
    (1..=32).find(|times| {
        (0..2).all(|axis| {
            let off = geometry.given[axis].abs_diff(size[axis] * times);
            off == 0 || (fixed[axis].is_some() && off < *times)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnxruntime::contract::ModelSize;

    fn contract(size: ModelSize) -> Contract {
        Contract {
            size,
            ..Contract::own()
        }
    }

    #[test]
    fn a_plane_is_found_whatever_the_order_of_the_axes() {
        // A value tells its place: 1000 n + 100 c + 10 h + w.
        for (layout, dims) in [
            (OutputLayout::Nchw, vec![2, 3, 4, 5]),
            (OutputLayout::Nhwc, vec![2, 4, 5, 3]),
            (OutputLayout::Nhw, vec![2, 4, 5]),
            (OutputLayout::Chw, vec![3, 4, 5]),
            (OutputLayout::Hwc, vec![4, 5, 3]),
            (OutputLayout::Hw, vec![4, 5]),
        ] {
            let letters = layout.letters();
            let total: i64 = dims.iter().product();
            let data: Vec<f32> = (0..total)
                .map(|mut i| {
                    let mut value = 0;
                    for (letter, length) in letters.bytes().zip(&dims).rev() {
                        let weight = match letter {
                            b'n' => 1000,
                            b'c' => 100,
                            b'h' => 10,
                            _ => 1,
                        };
                        value += weight * (i % length);
                        i /= length;
                    }
                    value as f32
                })
                .collect();
            let (pair, channel) = (
                usize::from(letters.contains('n')),
                2 * usize::from(letters.contains('c')),
            );
            let (size, values) = plane(&dims, &data, layout, channel, pair).unwrap();
            assert_eq!(size, [5, 4]);
            for (i, value) in values.iter().enumerate() {
                let expected = 1000 * pair + 100 * channel + 10 * (i / 5) + i % 5;
                assert_eq!(*value, expected as f32, "{letters}");
            }
            assert!(plane(&dims, &data, layout, 3, 0).is_none() || !letters.contains('c'));
            assert!(plane(&dims, &data[1..], layout, 0, 0).is_none());
        }
    }

    #[test]
    fn padding_and_cropping_change_nothing_and_resizing_keeps_a_ramp() {
        let free = contract(ModelSize {
            width: None,
            height: None,
            multiple: 32,
            at_least: 64,
            batch: false,
        });
        let geometry = Geometry::new(&free, [7, 70]);
        assert_eq!(geometry.given, [64, 96]);
        let values: Vec<f32> = (0..64 * 96).map(|i| i as f32).collect();
        let back = geometry.to_image(&values, [64, 96], 1.0);
        assert!((0..7 * 70).all(|i| back[i] == (64 * (i / 7) + i % 7) as f32));

        // A model of another size with a quarter of the resolution: x + 2 y in pixels of the image.
        let fixed = contract(ModelSize {
            width: Some(160),
            height: Some(96),
            multiple: 1,
            at_least: 1,
            batch: false,
        });
        let geometry = Geometry::new(&fixed, [200, 50]);
        assert!((geometry.pixels(Unit::Pixels) - 1.25).abs() < 1e-12);
        assert!((geometry.pixels(Unit::Width) - 200.0).abs() < 1e-12);
        let at = |i: usize, length: usize, image: usize| {
            (i as f32 + 0.5) / length as f32 * image as f32 - 0.5
        };
        let values: Vec<f32> = (0..40 * 24)
            .map(|i| at(i % 40, 40, 200) + 2.0 * at(i / 40, 24, 50))
            .collect();
        let back = geometry.to_image(&values, [40, 24], 2.0);
        for y in 1..49 {
            for x in 2..198 {
                let expected = 2.0 * (x as f32 + 2.0 * y as f32);
                assert!((back[200 * y + x] - expected).abs() < 1e-3, "{x} {y}");
            }
        }
    }
}
