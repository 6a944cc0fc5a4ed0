use plotters::coord::Shift;
use plotters::prelude::*;

use crate::ReportError;

/// Most samples of a line that are drawn. Where there are more, each stretch is drawn by its least and its greatest.
pub const MAX_SAMPLES: usize = 2000;

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// One sample joined to the next.
    Line,
    /// A mark for each.
    Marks,
}

/// Samples that belong together.
#[derive(Clone, Debug)]
pub struct Series {
    /// What the legend says.
    pub name: String,
    /// How it is drawn.
    pub style: Style,
    /// Horizontal and vertical value; values that are not finite are passed over.
    pub samples: Vec<(f64, f64)>,
}

/// Series over common axes.
#[derive(Clone, Debug)]
pub struct Chart {
    /// Above the chart.
    pub title: String,
    /// What the horizontal axis is, with its unit.
    pub horizontal: String,
    /// What the vertical axis is, with its unit.
    pub vertical: String,
    /// Whether both axes have the same scale: a map.
    pub plan: bool,
    /// What is drawn.
    pub series: Vec<Series>,
}

const PALETTE: [RGBColor; 10] = [
    RGBColor(31, 93, 160),
    RGBColor(214, 96, 26),
    RGBColor(46, 125, 60),
    RGBColor(150, 60, 140),
    RGBColor(90, 90, 90),
    RGBColor(190, 30, 45),
    RGBColor(23, 165, 175),
    RGBColor(200, 155, 20),
    RGBColor(120, 80, 50),
    RGBColor(230, 120, 180),
];

impl Chart {
    /// The chart as SVG.
    ///
    /// # Errors
    /// When it cannot be drawn.
    pub fn svg(&self) -> Result<String, ReportError> {
        let size = if self.plan { (620, 620) } else { (620, 300) };
        let mut svg = String::new();
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        self.draw(&area, size).map_err(|e| ReportError::Chart {
            title: self.title.clone(),
            message: e.to_string(),
        })?;
        drop(area);
        Ok(svg)
    }

    fn draw<'a>(
        &self,
        area: &DrawingArea<SVGBackend<'a>, Shift>,
        size: (u32, u32),
    ) -> Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>> {
        /// Pixels of the labels on the left, and of those below.
        const LABELS: [u32; 2] = [62, 42];
        const MARGIN: u32 = 10;
        const TITLE: u32 = 28;
        let series: Vec<(&Series, Vec<(f64, f64)>)> =
            self.series.iter().map(|s| (s, thinned(s))).collect();
        let all = || series.iter().flat_map(|(_, samples)| samples);
        let mut x = range(all().map(|s| s.0));
        let mut y = range(all().map(|s| s.1));
        if self.plan {
            let pixels = |of: u32, labels: u32| f64::from(of - labels - 2 * MARGIN);
            let wide = pixels(size.0, LABELS[0]);
            let high = pixels(size.1, LABELS[1] + TITLE);
            let metres = ((x.end - x.start) / wide).max((y.end - y.start) / high);
            x = around(&x, metres * wide);
            y = around(&y, metres * high);
        }
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, ("sans-serif", 17))
            .margin(MARGIN)
            .x_label_area_size(LABELS[1])
            .y_label_area_size(LABELS[0])
            .build_cartesian_2d(x, y)?;
        chart
            .configure_mesh()
            .x_desc(&self.horizontal)
            .y_desc(&self.vertical)
            .label_style(("sans-serif", 13))
            .light_line_style(TRANSPARENT)
            .bold_line_style(RGBColor(225, 225, 225))
            .draw()?;
        for (k, (series, samples)) in series.into_iter().enumerate() {
            let colour = PALETTE[k % PALETTE.len()];
            let drawn = match series.style {
                Style::Line => {
                    chart.draw_series(LineSeries::new(samples, colour.stroke_width(2)))?
                }
                Style::Marks => chart.draw_series(
                    samples
                        .into_iter()
                        .map(|at| Circle::new(at, 4, colour.filled())),
                )?,
            };
            drawn.label(&series.name).legend(move |(x, y)| {
                Rectangle::new([(x, y - 4), (x + 14, y + 4)], colour.filled())
            });
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperRight)
            .background_style(WHITE.mix(0.8))
            .border_style(RGBColor(200, 200, 200))
            .label_font(("sans-serif", 13))
            .draw()?;
        area.present()
    }
}

/// At most [`MAX_SAMPLES`], peaks kept.
pub(crate) fn thinned(series: &Series) -> Vec<(f64, f64)> {
    let finite = |s: &&(f64, f64)| s.0.is_finite() && s.1.is_finite();
    let samples: Vec<(f64, f64)> = series.samples.iter().filter(finite).copied().collect();
    if samples.len() <= MAX_SAMPLES {
        return samples;
    }
    let stretch = samples.len().div_ceil(MAX_SAMPLES / 2);
    let mut kept = Vec::with_capacity(MAX_SAMPLES);
    for part in samples.chunks(stretch) {
        let by_height = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
        let (low, high) = (part.iter().min_by(by_height), part.iter().max_by(by_height));
        let mut ends: Vec<(f64, f64)> = low.into_iter().chain(high).copied().collect();
        ends.sort_by(|a, b| a.0.total_cmp(&b.0));
        kept.extend(ends);
    }
    kept
}

/// From the least to the greatest with a little room; something even of nothing.
fn range(values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if low > high {
        return 0.0..1.0;
    }
    let room = (0.05 * (high - low)).max(1e-3 * high.abs()).max(1e-6);
    low - room..high + room
}

fn around(range: &std::ops::Range<f64>, length: f64) -> std::ops::Range<f64> {
    let middle = 0.5 * (range.start + range.end);
    middle - 0.5 * length..middle + 0.5 * length
}
