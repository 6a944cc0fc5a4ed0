use std::path::{Path, PathBuf};

use barchan_datasets::write_whole;
use serde::{Deserialize, Serialize};

use crate::InferError;

/// How an ONNX file wants its images and what its output means: the content of the `x.toml` that
/// `barchan probe x.onnx` writes beside it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Contract {
    /// Layout and values of the images.
    pub images: ImageFormat,
    /// Which sizes the model takes.
    pub size: ModelSize,
    /// Where the disparity is.
    pub output: OutputFormat,
    /// What each input wants.
    pub input: Vec<InputFormat>,
}

/// Layout and values of the images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageFormat {
    /// Order of the axes.
    pub layout: Layout,
    /// What an image's channels are.
    pub channels: Channels,
    /// A channel's values of 0 to 1 become `(value - mean) / std`, one of each a channel, in the order
    /// of the channels.
    pub mean: Vec<f64>,
    /// See `mean`.
    pub std: Vec<f64>,
}

/// Order of the axes of an input: batch, channels, rows and columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// Channel by channel.
    Nchw,
    /// Pixel by pixel.
    Nhwc,
}

/// The channels of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Channels {
    /// Red first.
    Rgb,
    /// Blue first, as OpenCV reads images.
    Bgr,
    /// Luminance alone.
    Grey,
}

impl Channels {
    /// How many.
    pub fn count(self) -> usize {
        if self == Self::Grey { 1 } else { 3 }
    }
}

/// Which sizes a model takes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSize {
    /// The only width, to which images are resized; any when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width: Option<usize>,
    /// The only height; any when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<usize>,
    /// A free width or height is padded, by repeating its edge to the right and below, to a multiple of
    /// this.
    pub multiple: usize,
    /// A free width or height is padded to this at least.
    pub at_least: usize,
    /// Whether several pairs run at once.
    pub batch: bool,
}

/// What an input wants.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputFormat {
    /// Its name in the ONNX file.
    pub name: String,
    /// The images that are stacked along its channels, in this order.
    pub images: Vec<Side>,
    /// Images are 1 / `shrink` of the model's size in it.
    pub shrink: usize,
}

/// An image of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// The left one.
    Left,
    /// The right one.
    Right,
}

/// Where the disparity is and what its numbers mean.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputFormat {
    /// Name of the output in the ONNX file.
    pub name: String,
    /// Order of its axes.
    pub layout: OutputLayout,
    /// The channel that is the disparity.
    pub channel: usize,
    /// What a value counts.
    pub unit: Unit,
    /// Disparity in the unit is `factor` times the value; negative where the model counts leftwards.
    pub factor: f64,
    /// An output of the same layout with standard deviations in the same unit, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma: Option<String>,
    /// An output of the same layout with a confidence of 0 to 1, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub confidence: Option<String>,
}

/// What a value counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    /// Pixels of the image that the model is given.
    Pixels,
    /// Widths of that image.
    Width,
}

/// Order of the axes of an output: batch, channels, rows and columns, each if there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OutputLayout {
    /// Channel by channel.
    Nchw,
    /// Pixel by pixel.
    Nhwc,
    /// No channels.
    Nhw,
    /// No batch.
    Chw,
    /// No batch, pixel by pixel.
    Hwc,
    /// A plane.
    Hw,
}

impl OutputLayout {
    /// All of them, the usual first.
    pub(crate) const ALL: [Self; 6] = [
        Self::Nchw,
        Self::Nhwc,
        Self::Nhw,
        Self::Chw,
        Self::Hwc,
        Self::Hw,
    ];

    /// The axes by letter.
    pub(crate) fn letters(self) -> &'static str {
        match self {
            Self::Nchw => "nchw",
            Self::Nhwc => "nhwc",
            Self::Nhw => "nhw",
            Self::Chw => "chw",
            Self::Hwc => "hwc",
            Self::Hw => "hw",
        }
    }
}

/// The first words of every `x.toml`, by which one is known.
const MARK: &str = "# Written by `barchan probe`";

impl Contract {
    /// What `barchan export` writes: inputs `left` and `right` `[B, 3, H, W]`, RGB in 0..=1; outputs
    /// `disparity`, `confidence` and `sigma`, `[B, 1, H, W]`, in pixels.
    pub fn own() -> Self {
        let input = |name: &str, side| InputFormat {
            name: name.into(),
            images: vec![side],
            shrink: 1,
        };
        Self {
            images: ImageFormat {
                layout: Layout::Nchw,
                channels: Channels::Rgb,
                mean: vec![0.0; 3],
                std: vec![1.0; 3],
            },
            size: ModelSize {
                width: None,
                height: None,
                multiple: 1,
                at_least: 1,
                batch: true,
            },
            output: OutputFormat {
                name: "disparity".into(),
                layout: OutputLayout::Nchw,
                channel: 0,
                unit: Unit::Pixels,
                factor: 1.0,
                sigma: Some("sigma".into()),
                confidence: Some("confidence".into()),
            },
            input: vec![input("left", Side::Left), input("right", Side::Right)],
        }
    }

    /// Where the contract of an ONNX file lies: `x.toml` beside `x.onnx`.
    pub fn path_beside(onnx: &Path) -> PathBuf {
        onnx.with_extension("toml")
    }

    /// Reads `x.toml`.
    ///
    /// # Errors
    /// When it cannot be read, or a field is missing, unknown or out of range; the message names it.
    pub fn load(path: &Path) -> Result<Self, InferError> {
        let wrong = |message: String| InferError::Model {
            path: path.to_owned(),
            message: format!(
                "{}\n  cure: `barchan probe {}` writes it anew",
                message.trim_end(),
                path.with_extension("onnx").display()
            ),
        };
        let size = std::fs::metadata(path).map_err(|e| wrong(e.to_string()))?;
        if size.len() > 1 << 20 {
            return Err(wrong("larger than any contract of an ONNX file".into()));
        }
        let text = std::fs::read_to_string(path).map_err(|e| wrong(e.to_string()))?;
        let contract: Self = toml::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        contract.check().map_err(wrong)?;
        Ok(contract)
    }

    /// Writes `x.toml`, whole or not at all, with `remarks` for people on top.
    ///
    /// # Errors
    /// When it cannot be written, or something else has that name.
    pub fn save(&self, path: &Path, remarks: &[String]) -> Result<(), InferError> {
        let wrong = |message: String| InferError::Model {
            path: path.to_owned(),
            message,
        };
        if path.exists() && !std::fs::read_to_string(path).is_ok_and(|text| text.starts_with(MARK))
        {
            return Err(wrong(
                "is there already and `barchan probe` has not written it\n  cure: move it away, or rename the ONNX file".into(),
            ));
        }
        let mut text = format!("{MARK}; `barchan` reads it with the ONNX file beside it.\n");
        for remark in remarks {
            text += format!("# {remark}").trim_end();
            text.push('\n');
        }
        text.push('\n');
        text += &toml::to_string(self).map_err(|e| wrong(e.to_string()))?;
        Ok(write_whole(path, text.as_bytes())?)
    }

    /// Whether the numbers make sense.
    fn check(&self) -> Result<(), String> {
        let channels = self.images.channels.count();
        for (field, values) in [("mean", &self.images.mean), ("std", &self.images.std)] {
            if values.len() != channels {
                return Err(format!(
                    "images.{field} has {} numbers, and there are {channels} channels",
                    values.len()
                ));
            }
            if values.iter().any(|v| !v.is_finite()) {
                return Err(format!("images.{field} is {values:?}, expected numbers"));
            }
        }
        if self.images.std.contains(&0.0) {
            return Err("images.std is 0, and values are divided by it".into());
        }
        let within = |field: &str, value: usize, most: usize| {
            if (1..=most).contains(&value) {
                Ok(())
            } else {
                Err(format!("{field} is {value}, expected 1 to {most}"))
            }
        };
        within("size.width", self.size.width.unwrap_or(1), MOST_SIDE)?;
        within("size.height", self.size.height.unwrap_or(1), MOST_SIDE)?;
        let area = self.size.width.unwrap_or(1) * self.size.height.unwrap_or(1);
        within("size.width times size.height", area, MOST_AREA)?;
        within("size.multiple", self.size.multiple, 1024)?;
        within("size.at_least", self.size.at_least, 4096)?;
        let factor = self.output.factor;
        if !factor.is_finite() || factor == 0.0 {
            return Err(format!(
                "output.factor is {factor}, expected a number, not 0"
            ));
        }
        for input in &self.input {
            let field = |name| format!("input \"{}\": {name}", input.name);
            within(&field("shrink"), input.shrink, 16)?;
            within(&field("number of images"), input.images.len(), 2)?;
            let sides = [
                (self.size.width, self.size.multiple),
                (self.size.height, self.size.multiple),
            ];
            if sides
                .iter()
                .any(|(fixed, multiple)| !fixed.unwrap_or(*multiple).is_multiple_of(input.shrink))
            {
                return Err(format!(
                    "{} is {}, which does not divide the model's sizes",
                    field("shrink"),
                    input.shrink
                ));
            }
        }
        let given = |side| self.input.iter().any(|i| i.images.contains(&side));
        if !given(Side::Left) || !given(Side::Right) {
            return Err("the inputs must be given both images of a pair".into());
        }
        Ok(())
    }
}

/// Longest side of a fixed size that is served.
pub(crate) const MOST_SIDE: usize = 16384;
/// Most pixels of a fixed size that is served.
pub(crate) const MOST_AREA: usize = 1 << 24;
