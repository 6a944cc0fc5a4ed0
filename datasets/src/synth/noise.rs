/// Mixes three numbers and a seed into 32 well-spread bits (the finaliser of MurmurHash3).
fn hash(x: u32, y: u32, seed: u32) -> u32 {
    let mut h =
        x.wrapping_mul(0x85eb_ca6b) ^ y.wrapping_mul(0xc2b2_ae35) ^ seed.wrapping_mul(0x27d4_eb2f);
    h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// Whole part towards minus infinity, for values that fit an i32. (`f32::floor` is a function call
/// on processors without SSE 4.1, and this is asked millions of times a frame.)
pub(super) fn floor(v: f32) -> i32 {
    let towards_zero = v as i32;
    towards_zero - i32::from(towards_zero as f32 > v)
}

/// Adds to row `j` of a square image, which repeats, gradient noise (Perlin 2002) of `waves` waves
/// a side; of a standard deviation near 0.2 times `amplitude`.
pub(super) fn add_noise(row: &mut [f32], j: usize, waves: u32, amplitude: f32, seed: u32) {
    let fade = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let side = row.len();
    let scale = waves as f32 / side as f32;
    // The lattice line above the row; in integers, so that the next line takes over exactly.
    let line = |at: usize| at * waves as usize / side;
    let iy = line(j);
    let dy = j as f32 * scale - iy as f32;
    let v = fade(dy);
    let gradient = |x: u32, y: u32| {
        // Two 16-bit halves make a gradient of roughly unit length.
        let bits = hash(x % waves, y % waves, seed);
        let g = |v: u32| (v & 0xffff) as f32 / 32768.0 - 1.0;
        (g(bits), g(bits >> 16))
    };
    let mut i = 0;
    while i < side {
        let ix = line(i);
        let corner = |x: usize, y: usize| gradient((ix + x) as u32, (iy + y) as u32);
        let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)];
        let next = ((ix + 1) * side).div_ceil(waves as usize).min(side);
        for (k, out) in row[i..next].iter_mut().enumerate() {
            let dx = (i + k) as f32 * scale - ix as f32;
            let u = fade(dx);
            let top = lerp(a.0 * dx + a.1 * dy, b.0 * (dx - 1.0) + b.1 * dy, u);
            let bottom = lerp(
                c.0 * dx + c.1 * (dy - 1.0),
                d.0 * (dx - 1.0) + d.1 * (dy - 1.0),
                u,
            );
            *out += amplitude * lerp(top, bottom, v);
        }
        i = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_across_the_border_and_keeps_its_amplitude() {
        for waves in [5, 16, 70] {
            let mut image = vec![vec![0.0; 512]; 512];
            for (j, row) in image.iter_mut().enumerate() {
                add_noise(row, j, waves, 1.0, 3);
            }
            let step = 4.0 * waves as f32 / 512.0;
            for k in 0..512 {
                for i in 0..512 {
                    let here = image[k][i];
                    let (right, below) = (image[k][(i + 1) % 512], image[(k + 1) % 512][i]);
                    assert!(
                        (here - right).abs() < step && (here - below).abs() < step,
                        "{waves} {k} {i}"
                    );
                }
            }
            let power = image.iter().flatten().map(|v| v * v).sum::<f32>() / (512.0 * 512.0);
            assert!((0.1..0.35).contains(&power.sqrt()), "{}", power.sqrt());
        }
    }

    #[test]
    fn floor_is_floor() {
        for v in [-2.0, -1.5, -0.1, 0.0, 0.9, 3.0] {
            assert_eq!(floor(v), v.floor() as i32);
        }
    }
}
