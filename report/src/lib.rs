//! A run for people to look at: as one HTML file that needs no network (figures, charts, pictures, a cloud that turns,
//! a relief that tells heights), or as a recording that a viewer plays.
//!
//! What it is for: a [`Report`] is filled by whoever knows what a run holds, and [`Report::html`] makes the page; a
//! [`Chart`] and a [`Sheet`] of pictures are SVG files alone as well. A [`Recording`] is told a run piece by piece:
//! [`FoxgloveRecording`] for Foxglove, and with the feature `rerun` `RerunRecording` for Rerun.
//!
//! What it promises: everything is inside the page; text is escaped, whatever names the data has; the size is
//! bounded (at most [`MAX_POINTS`] points, [`MAX_CELLS`] cells and [`MAX_SAMPLES`] marks a line), and the page says where that
//! left something out. A recording is written as it is told, in memory that does not grow with the run.
//!
//! What it never does: read runs, or judge them.

mod chart;
mod cloud;
mod recording;
mod relief;
mod sheet;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use image::{ImageFormat, RgbImage};
use minijinja::value::Serde;
use minijinja::{AutoEscape, Environment};
use serde::Serialize;

pub use chart::{Chart, MAX_SAMPLES, Series, Style};
pub use cloud::{Cloud3d, MAX_POINTS};
#[cfg(feature = "rerun")]
pub use recording::RerunRecording;
pub use recording::{FoxgloveRecording, Recording};
pub use relief::{MAX_CELLS, Relief};
pub use sheet::Sheet;

/// Why a page or a recording could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A picture could not be encoded.
    #[error("a picture of the report: {0}")]
    Picture(#[from] image::ImageError),
    /// A chart could not be drawn.
    #[error("the chart {title:?}: {message}")]
    Chart {
        /// Its title.
        title: String,
        /// What the plotting library said.
        message: String,
    },
    /// The page could not be put together.
    #[error("the page of the report: {0}")]
    Page(#[from] minijinja::Error),
    /// The recording could not be written.
    #[error("the recording: {0}")]
    Recording(#[from] std::io::Error),
    /// What the Rerun viewer's library said.
    #[cfg(feature = "rerun")]
    #[error("Rerun: {0}")]
    Rerun(#[from] ::rerun::RecordingStreamError),
    /// The viewer, or its file, took not all of it.
    #[error("the recording: {0}")]
    Viewer(String),
    /// A message could not be put together.
    #[error("a message of the recording: {0}")]
    Message(#[from] serde_json::Error),
    /// A recording has no such time.
    #[error("the recording: time is {0} s, expected 0 (the beginning of 1970) to 4294967295")]
    Time(f64),
}

/// What a page shows, in this order; empty parts are left away.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Headline.
    pub title: String,
    /// Where it comes from: a line below the headline.
    pub source: String,
    /// What a reader must know before believing anything.
    pub warnings: Vec<String>,
    /// Name and value of the figures that matter.
    pub figures: Vec<(String, String)>,
    /// Lines and marks over axes.
    pub charts: Vec<Chart>,
    /// The ground in colour.
    pub cloud: Option<Cloud3d>,
    /// Heights.
    pub relief: Option<Relief>,
    /// Pictures with a caption each.
    pub pictures: Vec<(String, RgbImage)>,
    /// What happened: at which frame, and what.
    pub events: Vec<(String, String)>,
    /// The configuration, as text.
    pub config: String,
}

#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    source: &'a str,
    warnings: &'a [String],
    figures: &'a [(String, String)],
    charts: Vec<String>,
    cloud: Option<cloud::Packed>,
    relief: Option<relief::Packed>,
    pictures: Vec<(&'a str, String)>,
    events: &'a [(String, String)],
    config: &'a str,
    style: &'static str,
    cloud_script: &'static str,
    relief_script: &'static str,
}

impl Report {
    /// The page.
    ///
    /// # Errors
    /// When a picture or a chart cannot be made.
    pub fn html(&self) -> Result<String, ReportError> {
        let mut pages = Environment::new();
        pages.set_auto_escape_callback(|_| AutoEscape::Html);
        let page = Page {
            title: &self.title,
            source: &self.source,
            warnings: &self.warnings,
            figures: &self.figures,
            charts: (self.charts.iter().map(Chart::svg)).collect::<Result<_, _>>()?,
            cloud: self.cloud.as_ref().and_then(Cloud3d::pack),
            relief: self.relief.as_ref().map(Relief::pack).transpose()?,
            pictures: (self.pictures.iter())
                .map(|(caption, picture)| Ok((caption.as_str(), jpeg(picture)?)))
                .collect::<Result<_, ReportError>>()?,
            events: &self.events,
            config: &self.config,
            style: include_str!("page.css"),
            cloud_script: include_str!("cloud.js"),
            relief_script: include_str!("relief.js"),
        };
        Ok(pages.render_str(include_str!("page.html"), Serde(page))?)
    }
}

fn jpeg(picture: &RgbImage) -> Result<String, ReportError> {
    data_uri(picture, ImageFormat::Jpeg)
}

fn jpeg_bytes(picture: &RgbImage) -> Result<Vec<u8>, ReportError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Jpeg)?;
    Ok(bytes.into_inner())
}

fn data_uri(picture: &RgbImage, format: ImageFormat) -> Result<String, ReportError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format)?;
    let kind = format.to_mime_type();
    Ok(format!("data:{kind};base64,{}", base64(bytes.get_ref())))
}

fn base64(bytes: &[u8]) -> String {
    BASE64_STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests;
