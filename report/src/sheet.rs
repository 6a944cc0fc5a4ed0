use std::fmt::Write as _;

use image::{ImageFormat, RgbImage};

use crate::{ReportError, data_uri};

/// Pictures of one size side by side, each with its name above it.
#[derive(Clone, Debug)]
pub struct Sheet {
    /// Above all.
    pub title: String,
    /// Pictures in a row.
    pub columns: usize,
    /// Name and picture, row by row.
    pub tiles: Vec<(String, RgbImage)>,
}

/// Width of a picture on the sheet, pixels.
const WIDTH: u32 = 400;
/// Room for a name.
const NAME: u32 = 22;
const GAP: u32 = 8;
const TITLE: u32 = 34;

impl Sheet {
    /// The sheet as SVG that carries its pictures.
    ///
    /// # Errors
    /// When a picture cannot be encoded.
    pub fn svg(&self) -> Result<String, ReportError> {
        let columns = self.columns.clamp(1, self.tiles.len().max(1)) as u32;
        let scaled = |p: &RgbImage| (p.height() * WIDTH).div_ceil(p.width().max(1)).max(1);
        let height = self.tiles.iter().map(|(_, p)| scaled(p)).max().unwrap_or(0);
        let rows = (self.tiles.len() as u32).div_ceil(columns);
        let (wide, high) = (
            columns * (WIDTH + GAP) + GAP,
            TITLE + rows * (NAME + height + GAP),
        );
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{wide}\" height=\"{high}\" font-family=\"sans-serif\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
             <text x=\"{GAP}\" y=\"22\" font-size=\"17\">{}</text>\n",
            escaped(&self.title)
        );
        for (k, (name, picture)) in (0u32..).zip(&self.tiles) {
            let x = GAP + k % columns * (WIDTH + GAP);
            let y = TITLE + k / columns * (NAME + height + GAP);
            let uri = data_uri(picture, ImageFormat::Png)?;
            // Writing to a string does not fail.
            let _ = writeln!(
                svg,
                "<text x=\"{x}\" y=\"{}\" font-size=\"13\">{}</text>\n\
                 <image x=\"{x}\" y=\"{}\" width=\"{WIDTH}\" height=\"{}\" href=\"{uri}\"/>",
                y + NAME - 7,
                escaped(name),
                y + NAME,
                scaled(picture),
            );
        }
        Ok(svg + "</svg>\n")
    }
}

/// Text that is no markup.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_picture_is_on_the_sheet_and_names_are_no_markup() {
        let tile = |name: &str| (name.to_owned(), RgbImage::new(40, 30));
        let sheet = Sheet {
            title: "a < b & c".into(),
            columns: 2,
            tiles: vec![tile("one"), tile("<script>"), tile("three")],
        };
        let svg = sheet.svg().unwrap();
        assert_eq!(svg.matches("<image ").count(), 3);
        assert!(svg.contains("a &lt; b &amp; c") && svg.contains("&lt;script&gt;"));
        // Two columns and two rows, with no overlap.
        assert!(
            svg.contains("width=\"824\" height=\"694\""),
            "{}",
            &svg[..120]
        );
        let empty = Sheet {
            tiles: vec![],
            ..sheet
        };
        assert!(empty.svg().unwrap().ends_with("</svg>\n"));
    }
}
