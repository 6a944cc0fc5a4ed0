//! Filters over whole planes. The work of a row is in functions of slices that the compiler turns
//! into vector instructions of the machine at hand; rows are shared among threads.

use std::array::from_fn;

use barchan_datasets::Plane;
use multiversion::multiversion;
use rayon::prelude::*;

/// Fewest rows that are worth a task of their own.
const ROWS: usize = 16;

/// The centre weight of Scharr's derivative, whose outer weights are 1.
const CENTRE: f32 = 10.0 / 3.0;
/// Makes the response of Scharr's kernels with outer samples `spacing` pixels away a derivative
/// times `spacing`: normalised for scale.
const SCHARR: f32 = 0.5 / (CENTRE + 2.0);

/// Row `y` of a plane.
pub(super) fn row(plane: &Plane, y: usize) -> &[f32] {
    let width = plane.width() as usize;
    &plane.as_raw()[y * width..][..width]
}

/// Gaussian blur with a kernel of `N` pixels; the border goes on as it ends.
pub(super) fn blur<const N: usize>(image: &Plane, sigma: f32) -> Plane {
    let radius = N / 2;
    let weight = |k: usize| (-0.5 * ((k as f32 - radius as f32) / sigma).powi(2)).exp();
    let sum: f32 = (0..N).map(weight).sum();
    let kernel: [f32; N] = from_fn(|k| weight(k) / sum);
    let (width, height) = (image.width() as usize, image.height() as usize);
    let mut blurred = Plane::new(image.width(), image.height());
    blurred
        .par_chunks_exact_mut(width)
        .enumerate()
        .with_min_len(ROWS)
        .for_each_init(
            || vec![0.0; width + 2 * radius],
            |column, (y, out)| {
                let rows =
                    from_fn(|k| row(image, (y + k).clamp(radius, height - 1 + radius) - radius));
                weighted_sum(&kernel, rows, &mut column[radius..radius + width]);
                let (first, last) = (column[radius], column[radius + width - 1]);
                column[..radius].fill(first);
                column[radius + width..].fill(last);
                weighted_sum(&kernel, from_fn(|k| &column[k..k + width]), out);
            },
        );
    blurred
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn weighted_sum<const N: usize>(kernel: &[f32; N], rows: [&[f32]; N], out: &mut [f32]) {
    let n = out.len();
    let rows = rows.map(|r| &r[..n]);
    for x in 0..n {
        let mut sum = 0.0;
        for k in 0..N {
            sum += kernel[k] * rows[k][x];
        }
        out[x] = sum;
    }
}

/// Half the size; each pixel the mean of four. An odd last row or column is left away.
pub(super) fn halve(image: &Plane) -> Plane {
    let mut half = Plane::new(image.width() / 2, image.height() / 2);
    let width = half.width() as usize;
    half.par_chunks_exact_mut(width)
        .enumerate()
        .with_min_len(ROWS)
        .for_each(|(y, out)| {
            let (above, below) = (row(image, 2 * y), row(image, 2 * y + 1));
            let pairs = above
                .as_chunks::<2>()
                .0
                .iter()
                .zip(below.as_chunks::<2>().0);
            for (out, (a, b)) in out.iter_mut().zip(pairs) {
                *out = 0.25 * (a[0] + a[1] + b[0] + b[1]);
            }
        });
    half
}

/// Derivatives along rows and columns by Scharr's kernels with samples `spacing` pixels apart, times
/// `spacing`; the border mirrors.
pub(super) fn gradient(image: &Plane, spacing: usize) -> [Plane; 2] {
    let (width, height) = image.dimensions();
    let mut planes = [(); 2].map(|()| Plane::new(width, height));
    let [dx, dy] = &mut planes;
    let width = width as usize;
    dx.par_chunks_exact_mut(width)
        .zip(dy.par_chunks_exact_mut(width))
        .enumerate()
        .with_min_len(ROWS)
        .for_each_init(
            || vec![0.0; width + 2 * spacing],
            |padded, (y, (dx, dy))| {
                let rows = rows_around(image, y, spacing);
                along_row(rows, spacing, padded, dx);
                along_column(rows, spacing, padded, dy);
            },
        );
    planes
}

/// Determinant of the Hessian of the image whose [`gradient`] is given.
pub(super) fn hessian_determinant([dx, dy]: &[Plane; 2], spacing: usize) -> Plane {
    let mut determinant = Plane::new(dx.width(), dx.height());
    let width = dx.width() as usize;
    determinant
        .par_chunks_exact_mut(width)
        .enumerate()
        .with_min_len(ROWS)
        .for_each_init(
            || {
                (
                    vec![0.0; width + 2 * spacing],
                    [(); 3].map(|()| vec![0.0; width]),
                )
            },
            |(padded, [dxx, dxy, dyy]), (y, out)| {
                let (of_dx, of_dy) = (rows_around(dx, y, spacing), rows_around(dy, y, spacing));
                along_row(of_dx, spacing, padded, dxx);
                along_column(of_dx, spacing, padded, dxy);
                along_column(of_dy, spacing, padded, dyy);
                determinant_row(dxx, dxy, dyy, out);
            },
        );
    determinant
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn determinant_row(dxx: &[f32], dxy: &[f32], dyy: &[f32], out: &mut [f32]) {
    for (((out, xx), xy), yy) in out.iter_mut().zip(dxx).zip(dxy).zip(dyy) {
        *out = xx * yy - xy * xy;
    }
}

/// The rows `spacing` above, at and below `y`, mirrored at the border.
fn rows_around(image: &Plane, y: usize, spacing: usize) -> [&[f32]; 3] {
    let last = image.height() as usize - 1;
    let above = y.abs_diff(spacing).min(last);
    let below = last.saturating_sub(last.abs_diff(y + spacing));
    let below = if y + spacing <= last {
        y + spacing
    } else {
        below
    };
    [above, y, below].map(|y| row(image, y))
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn along_row(
    [above, here, below]: [&[f32]; 3],
    spacing: usize,
    padded: &mut [f32],
    out: &mut [f32],
) {
    let n = out.len();
    let (above, here, below) = (&above[..n], &here[..n], &below[..n]);
    let smoothed = &mut padded[spacing..spacing + n];
    for x in 0..n {
        smoothed[x] = SCHARR * (above[x] + below[x] + CENTRE * here[x]);
    }
    mirror(padded, spacing);
    let (before, after) = (&padded[..n], &padded[2 * spacing..][..n]);
    for x in 0..n {
        out[x] = after[x] - before[x];
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn along_column(
    [above, _, below]: [&[f32]; 3],
    spacing: usize,
    padded: &mut [f32],
    out: &mut [f32],
) {
    let n = out.len();
    let (above, below) = (&above[..n], &below[..n]);
    let differences = &mut padded[spacing..spacing + n];
    for x in 0..n {
        differences[x] = SCHARR * (below[x] - above[x]);
    }
    mirror(padded, spacing);
    let (before, here, after) = (
        &padded[..n],
        &padded[spacing..][..n],
        &padded[2 * spacing..][..n],
    );
    for x in 0..n {
        out[x] = before[x] + after[x] + CENTRE * here[x];
    }
}

/// Fills `spacing` places at both ends of a row with what lies as far inside.
fn mirror(padded: &mut [f32], spacing: usize) {
    let last = padded.len() - 1 - spacing;
    for k in 1..=spacing {
        padded[spacing - k] = padded[(spacing + k).min(last)];
        padded[last + k] = padded[(last - k.min(last)).max(spacing)];
    }
}

/// How well each pixel conducts: little across edges (Perona and Malik's second function).
pub(super) fn conductivity(smooth: &Plane, contrast: f32) -> Plane {
    let mut conductivity = Plane::new(smooth.width(), smooth.height());
    let width = smooth.width() as usize;
    conductivity
        .par_chunks_exact_mut(width)
        .enumerate()
        .with_min_len(ROWS)
        .for_each_init(
            || (vec![0.0; width + 2], vec![0.0; width]),
            |(padded, dx), (y, out)| {
                let rows = rows_around(smooth, y, 1);
                along_row(rows, 1, padded, dx);
                along_column(rows, 1, padded, out);
                conductivity_row(dx, out, contrast.powi(-2));
            },
        );
    conductivity
}

/// `out` has the derivative along columns before, and the conductivity after.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn conductivity_row(dx: &[f32], out: &mut [f32], per_squared_contrast: f32) {
    for (out, dx) in out.iter_mut().zip(dx) {
        *out = 1.0 / (1.0 + (dx * dx + *out * *out) * per_squared_contrast);
    }
}

/// An explicit step of diffusion for the time `tau`; nothing flows over the border.
pub(super) fn diffuse(image: &Plane, conductivity: &Plane, tau: f32, diffused: &mut Plane) {
    let (width, last) = (image.width() as usize, image.height() as usize - 1);
    diffused
        .par_chunks_exact_mut(width)
        .enumerate()
        .with_min_len(ROWS)
        .for_each(|(y, out)| {
            let around = [y.saturating_sub(1), y, (y + 1).min(last)];
            let rows = around.map(|y| row(image, y));
            let conducts = around.map(|y| row(conductivity, y));
            diffuse_row(rows, conducts, 0.5 * tau, out);
        });
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn diffuse_row(
    [above, here, below]: [&[f32]; 3],
    [c_above, c_here, c_below]: [&[f32]; 3],
    half_tau: f32,
    out: &mut [f32],
) {
    let n = out.len();
    let (above, here, below) = (&above[..n], &here[..n], &below[..n]);
    let (c_above, c_here, c_below) = (&c_above[..n], &c_here[..n], &c_below[..n]);
    for x in 1..n.max(1) - 1 {
        let (value, c) = (here[x], c_here[x]);
        let vertical =
            (c + c_above[x]) * (above[x] - value) + (c + c_below[x]) * (below[x] - value);
        let left = (c + c_here[x - 1]) * (here[x - 1] - value);
        let right = (c + c_here[x + 1]) * (here[x + 1] - value);
        out[x] = value + half_tau * (vertical + left + right);
    }
    for (x, inner) in [(0, 1.min(n - 1)), (n - 1, n.max(2) - 2)] {
        let (value, c) = (here[x], c_here[x]);
        let vertical =
            (c + c_above[x]) * (above[x] - value) + (c + c_below[x]) * (below[x] - value);
        let side = (c + c_here[inner]) * (here[inner] - value);
        out[x] = value + half_tau * (vertical + side);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plane(width: u32, height: u32, f: impl Fn(f32, f32) -> f32) -> Plane {
        Plane::from_fn(width, height, |x, y| image::Luma([f(x as f32, y as f32)]))
    }

    #[test]
    fn derivatives_of_a_quadric_are_exact_inside() {
        // f = a x^2 + b x y + c y^2: by differences over 2 s pixels, which are exact for quadrics.
        let (a, b, c) = (0.03, -0.02, 0.01);
        let image = plane(60, 50, |x, y| a * x * x + b * x * y + c * y * y);
        for spacing in [1, 2, 4] {
            let s = spacing as f32;
            let derivatives = gradient(&image, spacing);
            let determinant = hessian_determinant(&derivatives, spacing);
            let at = |plane: &Plane| plane.get_pixel(30, 20).0[0];
            let (dx, dy) = (2.0 * a * 30.0 + b * 20.0, b * 30.0 + 2.0 * c * 20.0);
            assert!((at(&derivatives[0]) - s * dx).abs() < 1e-4 * s);
            assert!((at(&derivatives[1]) - s * dy).abs() < 1e-4 * s);
            let exact = (4.0 * a * c - b * b) * s.powi(4);
            assert!((at(&determinant) - exact).abs() < 1e-2 * exact);
        }
    }

    #[test]
    fn diffusion_keeps_the_mean_and_smooths() {
        let image = plane(37, 23, |x, y| ((7.0 * x + 13.0 * y) % 11.0) / 11.0);
        let conducts = plane(37, 23, |x, y| 0.5 + 0.4 * (x * y).sin());
        let mut diffused = Plane::new(37, 23);
        diffuse(&image, &conducts, 0.25, &mut diffused);
        let moments = |p: &Plane| {
            let n = p.len() as f64;
            let mean = p.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
            let variance = p
                .iter()
                .map(|v| (f64::from(*v) - mean).powi(2))
                .sum::<f64>()
                / n;
            (mean, variance)
        };
        let (before, after) = (moments(&image), moments(&diffused));
        assert!((before.0 - after.0).abs() < 1e-6, "{before:?} {after:?}");
        assert!(after.1 < 0.9 * before.1, "{before:?} {after:?}");
    }

    #[test]
    fn borders_mirror_however_small_the_image() {
        for (width, height) in [(1, 1), (2, 3), (3, 1)] {
            let flat = plane(width, height, |_, _| 0.5);
            let [dx, dy] = gradient(&flat, 4);
            assert!(dx.iter().chain(dy.iter()).all(|v| v.abs() < 1e-6));
            assert!(blur::<9>(&flat, 1.6).iter().all(|v| (v - 0.5).abs() < 1e-6));
            let mut diffused = Plane::new(width, height);
            diffuse(&flat, &flat, 0.2, &mut diffused);
            assert_eq!(diffused, flat);
        }
    }
}
