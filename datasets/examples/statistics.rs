//! Compares how sequences look and how hard they are to match, and puts their left images side by
//! side: `cargo run --release -p barchan-datasets --example statistics -- SHEET.png DATA@FRAME...`
use barchan_datasets::{Plane, Rgb, luma, open};

/// What is printed of a pair.
struct Statistics {
    mean: f32,
    deviation: f32,
    /// Length of the gradient of luminance, grey levels a pixel, that half and nine tenths of the
    /// pixels stay below; and the share of pixels under 2.
    gradient: [f32; 2],
    smooth: f32,
    /// Of pixels with a match: the share whose second-best match, more than a pixel away, is nearly
    /// as good; and the median of the best match's ZNCC.
    ambiguous: f32,
    best: f32,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [sheet, data @ ..] = args.as_slice() else {
        return Err("usage: statistics SHEET.png DATA@FRAME...".into());
    };
    println!("| data | mean | deviation | gradient p50 | p90 | below 2 | ambiguous | best ZNCC |");
    println!("|---|---|---|---|---|---|---|---|");
    let mut images = Vec::new();
    for name in data {
        let (spec, index) = name.rsplit_once('@').unwrap_or((name, "0"));
        let frame = open(spec)?.frame(index.parse()?)?;
        let s = statistics(&luma(&frame.left), &luma(&frame.right));
        println!(
            "| {name} | {:.0} | {:.0} | {:.1} | {:.1} | {:.0} % | {:.0} % | {:.2} |",
            s.mean,
            s.deviation,
            s.gradient[0],
            s.gradient[1],
            100.0 * s.smooth,
            100.0 * s.ambiguous,
            s.best
        );
        images.push(frame.left);
    }
    contact_sheet(&images).save(sheet)?;
    Ok(())
}

/// Of the lower two thirds of the images, where the ground is.
fn statistics(left: &Plane, right: &Plane) -> Statistics {
    let (w, h) = left.dimensions();
    let grey = |x: u32, y: u32| left[(x, y)].0[0] * 255.0;
    let (mut values, mut gradients) = (Vec::new(), Vec::new());
    for y in h / 3..h - 1 {
        for x in 1..w - 1 {
            values.push(grey(x, y));
            let dx = (grey(x + 1, y) - grey(x - 1, y)) / 2.0;
            gradients.push(dx.hypot((grey(x, y + 1) - grey(x, y - 1)) / 2.0));
        }
    }
    let n = values.len() as f32;
    let mean = values.iter().sum::<f32>() / n;
    let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt();
    gradients.sort_by(f32::total_cmp);
    let at = |list: &[f32], share: f32| list[(share * (list.len() - 1) as f32) as usize];
    let smooth = gradients.partition_point(|g| *g < 2.0) as f32 / n;

    // Matching of 9 x 9 windows along the row over a quarter of the width.
    const REACH: u32 = 4;
    let window = |image: &Plane, x: u32, y: u32| -> Vec<f32> {
        let pixels = (y - REACH..=y + REACH)
            .flat_map(|j| (x - REACH..=x + REACH).map(move |i| image[(i, j)].0[0]));
        let list: Vec<f32> = pixels.collect();
        let mean = list.iter().sum::<f32>() / list.len() as f32;
        let norm = list
            .iter()
            .map(|v| (v - mean).powi(2))
            .sum::<f32>()
            .sqrt()
            .max(1e-6);
        list.iter().map(|v| (v - mean) / norm).collect()
    };
    let (mut bests, mut ambiguous) = (Vec::new(), 0.0);
    for y in (h / 3 + REACH..h - REACH).step_by(9) {
        let windows: Vec<Vec<f32>> = (REACH..w - REACH).map(|x| window(right, x, y)).collect();
        for x in (w / 4 + REACH..w - REACH).step_by(9) {
            let here = window(left, x, y);
            let zncc: Vec<f32> = (0..w / 4)
                .map(|d| {
                    let there = &windows[(x - REACH - d) as usize];
                    here.iter().zip(there).map(|(a, b)| a * b).sum()
                })
                .collect();
            let best = (0..zncc.len()).fold(0, |b, d| if zncc[d] > zncc[b] { d } else { b });
            let second = zncc
                .iter()
                .enumerate()
                .filter(|(d, _)| d.abs_diff(best) > 1);
            let second = second.map(|(_, z)| *z).fold(0.0, f32::max);
            ambiguous += f32::from(u8::from(second > 0.9 * zncc[best]));
            bests.push(zncc[best]);
        }
    }
    bests.sort_by(f32::total_cmp);
    Statistics {
        mean,
        deviation,
        gradient: [at(&gradients, 0.5), at(&gradients, 0.9)],
        smooth,
        ambiguous: ambiguous / bests.len() as f32,
        best: at(&bests, 0.5),
    }
}

/// Two columns of images, each shrunk to 640 x 480 at most.
fn contact_sheet(images: &[Rgb]) -> image::RgbImage {
    let (w, h) = (640, 480);
    let mut sheet = image::RgbImage::new(2 * w, (images.len() as u32).div_ceil(2) * h);
    for (k, image) in images.iter().enumerate() {
        let (x0, y0) = (k as u32 % 2 * w, k as u32 / 2 * h);
        let scale = (image.width() as f32 / w as f32).max(image.height() as f32 / h as f32);
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            let from = ((x as f32 * scale) as u32, (y as f32 * scale) as u32);
            if from.0 < image.width() && from.1 < image.height() {
                let grey = image[from].0.map(|v| (v * 255.0) as u8);
                sheet.put_pixel(x0 + x, y0 + y, image::Rgb(grey));
            }
        }
    }
    sheet
}
