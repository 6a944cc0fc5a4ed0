//! Pictures for people.

use barchan_datasets::check::Report;
use barchan_datasets::{Plane, Rgb, StereoFrame};
use barchan_geometry::nalgebra::{Matrix3, Vector3};
use barchan_train::Explained;
use image::imageops::{FilterType, replace, resize};
use image::{ImageError, ImageFormat, RgbImage};

/// The left image beside its disparity in colour: far is blue, near is red, unknown is black.
/// `range` fixes the colours, so that the frames of a sequence compare.
pub fn disparity_beside_image(left: &Rgb, disparity: &Plane, range: (f32, f32)) -> RgbImage {
    let (width, height) = left.dimensions();
    RgbImage::from_fn(2 * width, height, |x, y| {
        if x < width {
            return byte(left.get_pixel(x, y));
        }
        disparity_colour(disparity.get_pixel(x - width, y).0[0], range)
    })
}

/// Disparity in colour: far is blue, near is red, unknown is black.
pub fn disparity_picture(disparity: &Plane, range: (f32, f32)) -> RgbImage {
    let (width, height) = disparity.dimensions();
    RgbImage::from_fn(width, height, |x, y| {
        disparity_colour(disparity.get_pixel(x, y).0[0], range)
    })
}

/// How probable it is that a disparity is right to a pixel, in grey: certain is white, unknown is black. `sigma` is the
/// deviation of errors that are spread as Laplace's distribution has it.
pub fn certainty_picture(disparity: &Plane, sigma: &Plane) -> RgbImage {
    let (width, height) = disparity.dimensions();
    RgbImage::from_fn(width, height, |x, y| {
        let known = disparity.get_pixel(x, y).0[0].is_finite();
        let sigma = sigma.get_pixel_checked(x, y).map_or(f32::NAN, |s| s.0[0]);
        let share = 1.0 - (-std::f32::consts::SQRT_2 / sigma).exp();
        // NaN becomes 0.
        let grey = if known { (255.0 * share) as u8 } else { 0 };
        image::Rgb([grey; 3])
    })
}

fn disparity_colour(disparity: f32, (low, high): (f32, f32)) -> image::Rgb<u8> {
    match disparity.is_finite() {
        true => turbo((disparity - low) / (high - low).max(1e-6)),
        false => image::Rgb([0; 3]),
    }
}

/// 0..=1 as an 8-bit grey image.
pub fn share(share: &Plane) -> image::GrayImage {
    let (width, height) = share.dimensions();
    image::GrayImage::from_fn(width, height, |x, y| {
        image::Luma([(share.get_pixel(x, y).0[0].clamp(0.0, 1.0) * 255.0).round() as u8])
    })
}

/// Left image, right image and true disparity (black where unknown) of each pair, a pair a row.
pub fn contact_sheet(pairs: &[(StereoFrame, Option<Plane>)]) -> RgbImage {
    /// Width of one picture, pixels.
    const WIDTH: u32 = 400;
    let tile = |image: &RgbImage| {
        let height = (image.height() * WIDTH).div_ceil(image.width().max(1));
        resize(image, WIDTH, height.max(1), FilterType::Triangle)
    };
    let rows: Vec<Vec<RgbImage>> = pairs
        .iter()
        .map(|(frame, truth)| {
            let mut row = vec![tile(&bytes(&frame.left)), tile(&bytes(&frame.right))];
            if let Some(truth) = truth {
                let both = disparity_beside_image(&frame.left, truth, disparity_range(truth));
                let (width, height) = frame.left.dimensions();
                let disparity = image::imageops::crop_imm(&both, width, 0, width, height);
                // Unknown and known pixels must not blend.
                let height = row[0].height();
                row.push(resize(
                    &disparity.to_image(),
                    WIDTH,
                    height,
                    FilterType::Nearest,
                ));
            }
            row
        })
        .collect();
    let columns = rows.iter().map(Vec::len).max().unwrap_or(1) as u32;
    let height: u32 = rows.iter().map(|row| row[0].height()).sum();
    let mut sheet = RgbImage::new(columns * WIDTH, height.max(1));
    let mut y = 0;
    for row in &rows {
        for (column, image) in row.iter().enumerate() {
            replace(&mut sheet, image, (column as u32 * WIDTH).into(), y);
        }
        y += i64::from(row[0].height());
    }
    sheet
}

/// What a network makes of pairs, a pair a row: the left image, its disparity, the right image warped
/// by it (which should look like the left), and in red what is wrong: the error where the truth is
/// known, full red at five pixels, else how far the warped image is from the left one.
pub fn explained_sheet(pairs: &[Explained]) -> RgbImage {
    let rows: Vec<[RgbImage; 4]> = pairs
        .iter()
        .map(|pair| {
            let (left, disparity) = (&pair.frame.left, &pair.disparity);
            // The truth's colours where there is one, so that pictures of a run compare.
            let range = disparity_range(pair.truth.as_ref().unwrap_or(disparity));
            let (width, height) = left.dimensions();
            let coloured = disparity_picture(disparity, range);
            let wrong = RgbImage::from_fn(width, height, |x, y| {
                let share = match &pair.truth {
                    Some(truth) => {
                        let error = disparity.get_pixel(x, y).0[0] - truth.get_pixel(x, y).0[0];
                        error.abs() / FULL_ERROR
                    }
                    None => {
                        let (a, b) = (left.get_pixel(x, y).0, pair.warped.get_pixel(x, y).0);
                        a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum()
                    }
                };
                // Unknown is black: NaN becomes 0.
                image::Rgb([(255.0 * share.clamp(0.0, 1.0)) as u8, 0, 0])
            });
            [bytes(left), coloured, bytes(&pair.warped), wrong]
        })
        .collect();
    let column = rows.iter().map(|row| row[0].width()).max().unwrap_or(1);
    let height: u32 = rows.iter().map(|row| row[0].height()).sum();
    let mut sheet = RgbImage::new(4 * column, height.max(1));
    let mut y = 0;
    for row in &rows {
        for (k, image) in row.iter().enumerate() {
            replace(&mut sheet, image, (k as u32 * column).into(), y);
        }
        y += i64::from(row[0].height());
    }
    sheet
}

/// An error of so many pixels is drawn in full red.
const FULL_ERROR: f32 = 5.0;

/// A picture as the bytes of a PNG file.
pub fn png(image: &RgbImage) -> Result<Vec<u8>, ImageError> {
    let mut bytes = std::io::Cursor::new(vec![]);
    image.write_to(&mut bytes, ImageFormat::Png)?;
    Ok(bytes.into_inner())
}

/// The matches of one frame: above, where they lie in the left and in the right image; below, how far
/// rows of the right image are off, ten times as long, as they are and after correction. Green is
/// within half a pixel, red beyond.
pub fn row_errors(frame: &StereoFrame, report: &Report) -> RgbImage {
    let (left, right) = (bytes(&frame.left), bytes(&frame.right));
    let mut dark = left.clone();
    dark.pixels_mut().for_each(|p| p.0 = p.0.map(|v| v / 2));
    let (width, height) = left.dimensions();
    let mut panels = [left, right, dark.clone(), dark];
    let to_corrected = report
        .correction
        .and_then(|correction| correction.right_homography.try_inverse())
        .unwrap_or(Matrix3::identity());
    // Marks that can be seen in a picture of any size.
    let half = (width / 320).max(1) as i32;
    for [[x, y], to] in &report.sample.matches {
        let corrected = to_corrected * Vector3::new(to[0], to[1], 1.0);
        let colour = turbo((x / f64::from(width)) as f32);
        dot(&mut panels[0], *x, *y, half, colour);
        dot(&mut panels[1], to[0], to[1], half, colour);
        for (panel, row) in [(2, to[1]), (3, corrected.y / corrected.z)] {
            let error = row - y;
            let colour = if error.abs() <= 0.5 {
                image::Rgb([90, 220, 90])
            } else {
                image::Rgb([255, 70, 60])
            };
            let length = (10.0 * error).abs().min(f64::from(height)) as i32;
            for k in 0..=length {
                dot(
                    &mut panels[panel],
                    *x,
                    y + f64::from(k) * error.signum(),
                    half - 1,
                    colour,
                );
            }
            dot(&mut panels[panel], *x, *y, half, colour);
        }
    }
    let mut picture = RgbImage::new(2 * width, 2 * height);
    for (k, panel) in panels.iter().enumerate() {
        let (column, row) = (k as u32 % 2, k as u32 / 2);
        replace(
            &mut picture,
            panel,
            (column * width).into(),
            (row * height).into(),
        );
    }
    picture
}

/// A pair side by side, darkened, and a line for each match: its place in the left and in the right
/// image, and its colour.
pub fn matches_over_pair(
    frame: &StereoFrame,
    matches: &[([[f64; 2]; 2], image::Rgb<u8>)],
) -> RgbImage {
    let (width, height) = frame.left.dimensions();
    let mut picture = RgbImage::new(2 * width, height);
    replace(&mut picture, &bytes(&frame.left), 0, 0);
    replace(&mut picture, &bytes(&frame.right), width.into(), 0);
    picture
        .pixels_mut()
        .for_each(|p| p.0 = p.0.map(|v| v / 3 * 2));
    let half = (width / 640).max(1) as i32;
    for ([[u, v], [u_right, v_right]], colour) in matches {
        let (du, dv) = (u_right + f64::from(width) - u, v_right - v);
        let steps = du.abs().max(dv.abs()).ceil().max(1.0);
        for k in 0..=steps as u32 {
            let share = f64::from(k) / steps;
            dot(&mut picture, u + share * du, v + share * dv, 0, *colour);
        }
        dot(&mut picture, *u, *v, half, *colour);
        dot(&mut picture, u + du, v + dv, half, *colour);
    }
    picture
}

/// A square mark of `2 half + 1` pixels.
pub fn dot(image: &mut RgbImage, x: f64, y: f64, half: i32, colour: image::Rgb<u8>) {
    let (cx, cy) = (x.round() as i32, y.round() as i32);
    for y in cy - half..=cy + half {
        for x in cx - half..=cx + half {
            if x >= 0 && y >= 0 && x < image.width() as i32 && y < image.height() as i32 {
                image.put_pixel(x as u32, y as u32, colour);
            }
        }
    }
}

/// An image in 8 bits.
pub fn bytes(image: &Rgb) -> RgbImage {
    RgbImage::from_fn(image.width(), image.height(), |x, y| {
        byte(image.get_pixel(x, y))
    })
}

fn byte(pixel: &image::Rgb<f32>) -> image::Rgb<u8> {
    image::Rgb(pixel.0.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8))
}

/// From blue at 0 to red at 1.
pub fn turbo(share: f32) -> image::Rgb<u8> {
    let colour = colorous::TURBO.eval_continuous(f64::from(share.clamp(0.0, 1.0)));
    image::Rgb([colour.r, colour.g, colour.b])
}

/// The 2nd and 98th percentile of the known disparities; 0 to 1 where none is known.
pub fn disparity_range(disparity: &Plane) -> (f32, f32) {
    let mut known: Vec<f32> = disparity
        .iter()
        .copied()
        .filter(|d| d.is_finite())
        .collect();
    known.sort_by(f32::total_cmp);
    match known.len() {
        0 => (0.0, 1.0),
        n => (known[n / 50], known[n - 1 - n / 50]),
    }
}
