//! ONNX files of other people, made to their published contracts with a known matcher inside: absolute
//! differences, cut, averaged over windows, and the soft minimum over disparities.

use std::path::Path;

use barchan_onnx::proto::{Attribute, Model, ValueInfo};
use barchan_onnx::{GraphBuilder, Message};

/// How images come in.
#[derive(Clone, Copy, PartialEq)]
pub enum Inputs {
    /// One input, both images stacked.
    Stacked,
    /// Two inputs.
    Two,
    /// Both images at half and at full size.
    Four,
}

/// What a file is like.
#[derive(Clone)]
pub struct Stereo {
    pub inputs: Inputs,
    /// Of the inputs, in order: left and right of the small pair if there is one, then of the full one.
    pub names: Vec<&'static str>,
    pub grey: bool,
    pub nhwc: bool,
    /// The right image comes first, whatever the names say.
    pub right_first: bool,
    /// Mean and deviation that are undone, for values that were `(v - mean) / std`.
    pub mean: [f32; 3],
    pub std: [f32; 3],
    /// Width and height; free when absent.
    pub size: Option<[usize; 2]>,
    /// Sides must be multiples of this.
    pub multiple: usize,
    pub free_batch: bool,
    pub disparities: usize,
    /// The output is this times the disparity.
    pub factor: f32,
    /// The output is a share of the width.
    pub share: bool,
    /// The output is so many times smaller.
    pub coarse: usize,
    pub output: &'static str,
    /// A second channel, zero: the output is a flow.
    pub flow: bool,
    pub output_nhwc: bool,
    /// Outputs `confidence` and `sigma` as our own export has them.
    pub own: bool,
    /// Looks at no image but the left.
    pub blind_of_right: bool,
}

pub const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);

impl Default for Stereo {
    fn default() -> Self {
        Self {
            inputs: Inputs::Two,
            names: vec!["left", "right"],
            grey: false,
            nhwc: false,
            right_first: false,
            mean: [0.0; 3],
            std: [1.0; 3],
            size: Some([192, 128]),
            multiple: 1,
            free_batch: false,
            disparities: 32,
            factor: 1.0,
            share: false,
            coarse: 1,
            output: "output",
            flow: false,
            output_nhwc: false,
            own: false,
            blind_of_right: false,
        }
    }
}

impl Stereo {
    /// HITNet as published: `input` `[1, 6, H, W]` or `[1, 2, H, W]` in 0..1, left first;
    /// `reference_output_disparity` `[1, H, W, 1]`.
    pub fn hitnet(grey: bool) -> Self {
        Self {
            inputs: Inputs::Stacked,
            names: vec!["input"],
            grey,
            output: "reference_output_disparity",
            output_nhwc: true,
            ..Self::default()
        }
    }

    /// CREStereo as published: RGB in 0..255, a flow whose channel 0 is the disparity; with four inputs
    /// the pair at half size comes first.
    pub fn crestereo(four: bool) -> Self {
        Self {
            inputs: if four { Inputs::Four } else { Inputs::Two },
            names: match four {
                true => vec!["init_left", "init_right", "next_left", "next_right"],
                false => vec!["left", "right"],
            },
            std: [1.0 / 255.0; 3],
            flow: true,
            ..Self::default()
        }
    }

    pub fn write(&self, path: &Path) {
        std::fs::write(path, self.model().encode_to_vec()).unwrap();
    }

    pub fn model(&self) -> Model {
        let mut g = GraphBuilder::default();
        let mut inputs = Vec::new();
        let stack = if self.inputs == Inputs::Stacked { 2 } else { 1 };
        let channels = stack * if self.grey { 1 } else { 3 };
        for (k, name) in self.names.iter().enumerate() {
            let shrink = if self.inputs == Inputs::Four && k < 2 {
                2
            } else {
                1
            };
            let side = |axis: usize, free: &str| match self.size {
                Some(size) => (size[axis] / shrink).to_string(),
                None => free.to_owned(),
            };
            let batch = if self.free_batch { "B" } else { "1" };
            let (h, w, c) = (side(1, "H"), side(0, "W"), channels.to_string());
            let dims = match self.nhwc {
                false => [batch, &c, &h, &w],
                true => [batch, &h, &w, &c],
            };
            inputs.push(ValueInfo::float(name, dims));
        }
        // Planes of grey, 0 to 1, of each image.
        let mut planes = Vec::new();
        for name in &self.names {
            let mut x = (*name).to_owned();
            if self.nhwc {
                x = g.plain(
                    "Transpose",
                    &[&x],
                    vec![Attribute::ints("perm", &[0, 3, 1, 2])],
                );
            }
            let each = channels / stack;
            for k in 0..stack {
                let mut part = x.clone();
                if stack == 2 {
                    let (from, to) = (
                        g.ints(&[(k * each) as i64]),
                        g.ints(&[((k + 1) * each) as i64]),
                    );
                    let axis = g.ints(&[1]);
                    part = g.plain("Slice", &[&x, &from, &to, &axis], vec![]);
                }
                planes.push(self.luma(&mut g, &part));
            }
        }
        if self.right_first {
            planes.chunks_mut(2).for_each(|pair| pair.swap(0, 1));
        }
        if self.blind_of_right {
            planes[1] = planes[0].clone();
        }
        let full = &planes[planes.len() - 2..];
        let mut disparity = self.matched(&mut g, &full[0], &full[1], self.disparities);
        if self.blind_of_right {
            // Far above and near below: what a habit of the ground says.
            let ramp = (0..128).map(|y| 2.0 + y as f32 / 8.0);
            let ramp = g.floats("ramp", &[1, 1, 128, 1], ramp);
            let none = g.scalar(0.0);
            let zero = g.plain("Mul", &[&disparity, &none], vec![]);
            disparity = g.plain("Add", &[&zero, &ramp], vec![]);
        }
        if self.inputs == Inputs::Four {
            let half = self.matched(&mut g, &planes[0], &planes[1], self.disparities / 2);
            let scales = g.floats("scales", &[4], [1.0, 1.0, 2.0, 2.0]);
            let up = g.plain(
                "Resize",
                &[&half, "", &scales],
                vec![Attribute::string("mode", "linear")],
            );
            // Nine tenths of the full disparity, a tenth of twice the half one.
            let (a, b) = (g.scalar(0.9), g.scalar(0.2));
            let fine = g.plain("Mul", &[&disparity, &a], vec![]);
            let coarse = g.plain("Mul", &[&up, &b], vec![]);
            disparity = g.plain("Add", &[&fine, &coarse], vec![]);
        }
        if self.multiple > 1 {
            let block = || vec![Attribute::int("blocksize", self.multiple as i64)];
            let deep = g.plain("SpaceToDepth", &[&disparity], block());
            disparity = g.plain("DepthToSpace", &[&deep], block());
        }
        if self.coarse > 1 {
            let k = [self.coarse; 2];
            disparity = g.plain(
                "AveragePool",
                &[&disparity],
                vec![
                    Attribute::ints("kernel_shape", &k),
                    Attribute::ints("strides", &k),
                ],
            );
        }
        if self.share {
            let shape = g.plain("Shape", &[&full[0]], vec![Attribute::int("start", 3)]);
            let width = g.plain("Cast", &[&shape], vec![Attribute::int("to", 1)]);
            disparity = g.plain("Div", &[&disparity, &width], vec![]);
        }
        let factor = g.scalar(self.factor);
        let mut out = g.plain("Mul", &[&disparity, &factor], vec![]);
        let mut outputs = Vec::new();
        let free = |name: &str| ValueInfo::float(name, ["b", "x", "y", "z"]);
        if self.own {
            for name in ["confidence", "sigma"] {
                let value = g.scalar(if name == "sigma" { 0.5 } else { 0.75 });
                let none = g.scalar(0.0);
                let zero = g.plain("Mul", &[&out, &none], vec![]);
                g.node(name, "Add", &[&zero, &value], vec![]);
                outputs.push(free(name));
            }
        }
        if self.flow {
            let none = g.scalar(0.0);
            let zero = g.plain("Mul", &[&out, &none], vec![]);
            out = g.plain("Concat", &[&out, &zero], vec![Attribute::int("axis", 1)]);
        }
        match self.output_nhwc {
            true => g.node(
                self.output,
                "Transpose",
                &[&out],
                vec![Attribute::ints("perm", &[0, 2, 3, 1])],
            ),
            false => g.node(self.output, "Identity", &[&out], vec![]),
        };
        outputs.insert(0, free(self.output));
        g.finish("stereo", inputs, outputs, "", [])
    }

    /// What the network was trained on, in 0 to 1 and cut to it, as one plane.
    fn luma(&self, g: &mut GraphBuilder, x: &str) -> String {
        let count = if self.grey { 1 } else { 3 };
        let std = g.floats("std", &[1, count, 1, 1], self.std.into_iter().take(count));
        let mean = g.floats("mean", &[1, count, 1, 1], self.mean.into_iter().take(count));
        let scaled = g.plain("Mul", &[x, &std], vec![]);
        let value = g.plain("Add", &[&scaled, &mean], vec![]);
        let (low, high) = (g.scalar(0.0), g.scalar(1.0));
        let value = g.plain("Clip", &[&value, &low, &high], vec![]);
        let mut grey = value;
        if !self.grey {
            let weights = g.floats("weights", &[1, 3, 1, 1], [1.0 / 3.0; 3]);
            grey = g.plain("Conv", &[&grey, &weights], vec![]);
        }
        // The cameras differ in gain: what matters is how a pixel stands out.
        let around = g.plain(
            "AveragePool",
            &[&grey],
            vec![
                Attribute::ints("kernel_shape", &[9; 2]),
                Attribute::ints("pads", &[4; 4]),
            ],
        );
        g.plain("Sub", &[&grey, &around], vec![])
    }

    fn matched(&self, g: &mut GraphBuilder, left: &str, right: &str, range: usize) -> String {
        let mut costs = Vec::new();
        let most = g.scalar(0.1);
        for d in 0..range {
            let mut shifted = right.to_owned();
            if d > 0 {
                let pads = g.ints(&[0, 0, 0, d as i64, 0, 0, 0, 0]);
                let padded = g.plain(
                    "Pad",
                    &[right, &pads],
                    vec![Attribute::string("mode", "edge")],
                );
                let (from, to, axis) = (g.ints(&[0]), g.ints(&[-(d as i64)]), g.ints(&[3]));
                shifted = g.plain("Slice", &[&padded, &from, &to, &axis], vec![]);
            }
            let difference = g.plain("Sub", &[left, &shifted], vec![]);
            let cost = g.plain("Abs", &[&difference], vec![]);
            costs.push(g.plain("Min", &[&cost, &most], vec![]));
        }
        let costs: Vec<&str> = costs.iter().map(String::as_str).collect();
        let mut volume = g.plain("Concat", &costs, vec![Attribute::int("axis", 1)]);
        for (kernel, pads) in [([1, 7], [0, 3, 0, 3]), ([7, 1], [3, 0, 3, 0])] {
            volume = g.plain(
                "AveragePool",
                &[&volume],
                vec![
                    Attribute::ints("kernel_shape", &kernel),
                    Attribute::ints("pads", &pads),
                ],
            );
        }
        let sharp = g.scalar(-1500.0);
        let score = g.plain("Mul", &[&volume, &sharp], vec![]);
        let share = g.plain("Softmax", &[&score], vec![Attribute::int("axis", 1)]);
        let values = g.floats(
            "disparities",
            &[1, range, 1, 1],
            (0..range).map(|d| d as f32),
        );
        g.plain("Conv", &[&share, &values], vec![])
    }
}
