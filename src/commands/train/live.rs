//! What a terminal shows of a training: progress, losses, small pictures in coloured half-blocks.

use std::fmt::Write as _;

use barchan_train::{Explained, LogLine, Scored};
use console::{Term, colors_enabled_stderr, true_colors_enabled_stderr};
use image::imageops::{FilterType, resize};
use image::{Rgb, RgbImage};
use indicatif::{ProgressBar, ProgressState, ProgressStyle};

use super::told_of;
use crate::output::Output;
use crate::preview::explained_sheet;

/// A bar, and below it what the training does. Nothing of it where standard error is no terminal.
pub struct Live {
    bar: ProgressBar,
    losses: Vec<f32>,
    terms: String,
    first: Option<Scored>,
    held_out: String,
    pictures: String,
}

/// Characters of the curve of losses.
const CURVE: usize = 40;
/// Most characters of a picture of a pair's four.
const WIDEST: usize = 40;

impl Live {
    /// `first` is the look at the held-out pairs before the first step, where there was one.
    pub fn new(output: &Output, [done, total]: [usize; 2], first: Option<Scored>) -> Self {
        let bar = output.progress("train", total);
        let template = "{prefix} [{bar:30}] {pos}/{len}  {speed} steps/s, {eta} left\n{msg}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            let speed = |state: &ProgressState, to: &mut dyn std::fmt::Write| {
                // Nobody hears of it if the bar cannot be drawn.
                let _ = write!(to, "{:.2}", state.per_sec());
            };
            bar.set_style(style.with_key("speed", speed).progress_chars("=> "));
        }
        bar.set_position(done as u64);
        bar.reset_eta();
        Self {
            bar,
            losses: vec![],
            terms: String::new(),
            first,
            held_out: String::new(),
            pictures: String::new(),
        }
    }

    /// Whether nobody looks: lines are wanted instead.
    pub fn is_hidden(&self) -> bool {
        self.bar.is_hidden()
    }

    pub fn step(&mut self, line: &LogLine) {
        self.losses.push(line.loss);
        self.terms = line.terms.to_string();
        self.bar.inc(1);
        self.draw();
    }

    pub fn validated(&mut self, scored: &Scored, best: &Scored, pairs: &[Explained]) {
        if self.is_hidden() {
            return;
        }
        let first = *self.first.get_or_insert(*scored);
        self.held_out = format!("held-out pairs: {}", told_of(scored));
        if scored.step > first.step {
            let _ = write!(
                self.held_out,
                " (at first {:.4}, best {:.4} after step {})",
                first.validation.photometric, best.validation.photometric, best.step
            );
        }
        if colors_enabled_stderr() {
            let (rows, columns) = Term::stderr().size();
            // Bar, losses, held-out pairs and a title stand above.
            let room = [usize::from(columns), usize::from(rows).saturating_sub(6)];
            self.pictures = pictures(pairs, room, true_colors_enabled_stderr());
        }
        self.draw();
    }

    /// A line above that stays.
    pub fn say(&self, line: &str) {
        self.bar.println(line);
    }

    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn draw(&self) {
        let mut message = String::new();
        if let Some(loss) = self.losses.last() {
            let curve = curve(&self.losses, CURVE);
            let _ = write!(message, "loss {loss:.4}  {curve}  {}", self.terms);
        }
        for part in [&self.held_out, &self.pictures] {
            if !part.is_empty() {
                let _ = write!(message, "\n{part}");
            }
        }
        self.bar.set_message(message);
    }
}

/// The first pair as the network explains it, under a title each; nothing where the terminal is too small.
fn pictures(pairs: &[Explained], [columns, rows]: [usize; 2], true_colour: bool) -> String {
    const TITLES: [&str; 4] = ["left image", "disparity", "right, warped", "what is wrong"];
    const SMALLEST: usize = 14;
    let Some(pair) = pairs.first() else {
        return String::new();
    };
    let (width, height) = pair.frame.left.dimensions();
    // A half-block is about as high as wide.
    let highest = 2 * rows * width as usize / height.max(1) as usize;
    let wide = (columns.saturating_sub(1) / 4).min(WIDEST).min(highest);
    if wide < SMALLEST {
        return String::new();
    }
    let high = (wide * height as usize / width.max(1) as usize).max(2);
    let sheet = explained_sheet(std::slice::from_ref(pair));
    let small = resize(&sheet, 4 * wide as u32, high as u32, FilterType::Triangle);
    let mut text = TITLES.map(|t| format!("{t:<wide$.wide$}")).concat();
    for line in half_blocks(&small, true_colour) {
        text.push('\n');
        text.push_str(&line);
    }
    text
}

/// Two rows of pixels a line: the upper is the colour of a half-block, the lower that of what is behind it.
fn half_blocks(image: &RgbImage, true_colour: bool) -> Vec<String> {
    let (width, height) = image.dimensions();
    let code = |ground: u8, pixel: Option<&Rgb<u8>>| match pixel {
        // Below the last row.
        None => format!("\x1b[{}m", ground + 1),
        Some(Rgb([r, g, b])) if true_colour => format!("\x1b[{ground};2;{r};{g};{b}m"),
        Some(Rgb(rgb)) => {
            // The 6 x 6 x 6 colours that every terminal of 256 has.
            let [r, g, b] = rgb.map(|v| (u32::from(v) * 5 + 127) / 255);
            format!("\x1b[{ground};5;{}m", 16 + 36 * r + 6 * g + b)
        }
    };
    (0..height)
        .step_by(2)
        .map(|y| {
            let mut line = String::new();
            for x in 0..width {
                line += &code(38, Some(image.get_pixel(x, y)));
                line += &code(48, image.get_pixel_checked(x, y + 1));
                line.push('▀');
            }
            line + "\x1b[0m"
        })
        .collect()
}

/// Means of stretches of a series as bars from its least to its greatest; a stretch that has no number is a blank.
fn curve(values: &[f32], length: usize) -> String {
    const BARS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let stretch = values.len().div_ceil(length).max(1);
    let means = values.chunks(stretch);
    let means: Vec<f32> = means
        .map(|c| c.iter().sum::<f32>() / c.len() as f32)
        .collect();
    let finite = || means.iter().copied().filter(|m| m.is_finite());
    let (low, high) = (
        finite().fold(f32::MAX, f32::min),
        finite().fold(f32::MIN, f32::max),
    );
    means
        .iter()
        .map(|mean| match mean.is_finite() {
            true => {
                let share = (mean - low) / (high - low).max(f32::MIN_POSITIVE);
                BARS[((share * 7.0).round() as usize).min(7)]
            }
            false => ' ',
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use console::strip_ansi_codes;

    #[test]
    fn half_blocks_carry_every_pixel() {
        let image = RgbImage::from_fn(3, 5, |x, y| Rgb([x as u8, y as u8, 200]));
        let lines = half_blocks(&image, true);
        assert_eq!(lines.len(), 3);
        for (y, line) in lines.iter().enumerate() {
            assert_eq!(strip_ansi_codes(line), "▀▀▀");
            for x in 0..3 {
                assert!(line.contains(&format!("\x1b[38;2;{x};{};200m", 2 * y)));
                let below = format!("\x1b[48;2;{x};{};200m", 2 * y + 1);
                // The last line has nothing below.
                assert_eq!(line.contains(&below), y < 2, "{x}, {y}");
            }
            assert!(line.ends_with("\x1b[0m"));
        }
    }

    #[test]
    fn terminals_of_256_colours_get_the_nearest() {
        let image = RgbImage::from_fn(1, 2, |_, y| match y {
            0 => Rgb([255, 0, 128]),
            _ => Rgb([0, 0, 0]),
        });
        let lines = half_blocks(&image, false);
        assert_eq!(lines, ["\x1b[38;5;199m\x1b[48;5;16m▀\x1b[0m"]);
    }

    #[test]
    fn a_curve_falls_with_the_losses_and_never_is_longer_than_it_may() {
        let falling: Vec<f32> = (0..1000).map(|k| 1.0 / (1.0 + k as f32)).collect();
        let drawn = curve(&falling, 40);
        assert_eq!(drawn.chars().count(), 40);
        assert!(drawn.starts_with('█') && drawn.ends_with('▁'));
        assert_eq!(curve(&[], 40), "");
        assert_eq!(curve(&[f32::NAN, 1.0, 1.0], 40), " ▁▁");
    }
}
