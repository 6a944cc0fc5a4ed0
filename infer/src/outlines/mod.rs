//! Outlines of a dense disparity put where the images have them.

mod doubt;
mod judge;
mod opinion;
mod paths;
mod propose;

use barchan_datasets::{Rgb, luma};
use rayon::prelude::*;

use crate::classical::census;
use crate::engine::{DisparityEngine, DisparityMap, InferError};

use doubt::Doubt;
use judge::{Colours, Likeness};
use opinion::Opinion;
pub use opinion::SecondOpinion;
use paths::{Ground, breaks};
use propose::{AROUND, Choices, Moved, OPINION, Surfaces, offsets, propose};

/// Puts outlines where the images have them: a matching window that reaches over an outline fattens the
/// nearer surface, and what works at a quarter of the resolution draws outlines as coarsely.
///
/// Every pixel may take over the surface of a pixel up to ten away, disparity and slope, if full-resolution
/// likeness (census, weighed by colour around the pixel) and the neighbours' choices, along four
/// paths, agree: semi-global matching (Hirschmüller 2008) among few planes, proposed as in PatchMatch stereo
/// (Bleyer 2011). One more surface is what a second opinion takes the pixel for, a matcher that searches all
/// disparities at each pixel: so thin things that the network never saw can come back. What nearer surfaces hide from the right camera is no match at all, and costs as much
/// whatever it is taken for.
///
/// Sigma then says how far off that may be: a power of the product of the sigma that came along, the pixel's own, how
/// far the disparity moved, and the spread of what the pixel might have been; times exponentials of how unlike the
/// images are around the pixel and of whether it is hidden.
#[derive(Clone, Copy, Debug)]
pub struct Outlines {
    /// How often: each pass moves outlines by up to ten pixels.
    pub passes: usize,
}

impl Default for Outlines {
    fn default() -> Self {
        Self { passes: 2 }
    }
}

impl Outlines {
    /// Moves the outlines of `map` to those of the images. Sigma comes along from where a disparity is taken and
    /// grows with what speaks against it; confidence follows from it. Unknown disparity stays unknown. `opinion` is
    /// another matcher's answer, with holes where it knows nothing.
    pub fn sharpen(
        &self,
        left: &Rgb,
        right: &Rgb,
        opinion: Option<&DisparityMap>,
        map: &mut DisparityMap,
    ) {
        let (width, height) = (left.width() as usize, left.height() as usize);
        let fits = [&map.disparity, &map.sigma, &map.confidence]
            .map(|plane| plane.dimensions() == left.dimensions());
        let opinion = opinion.filter(|o| {
            [&o.disparity, &o.sigma].map(|plane| plane.dimensions() == left.dimensions())
                == [true; 2]
        });
        let matched = right.dimensions() == left.dimensions() && fits == [true; 3];
        if self.passes == 0 || width < 2 || height < 2 || !matched {
            return;
        }
        let ((colours, left), right) = rayon::join(
            || (Colours::of(left), census(&luma(left))),
            || census(&luma(right)),
        );
        let seen = [left, right];
        let mut likeness = Likeness::new(&colours, &seen);
        let (breaks, offsets) = (breaks(), offsets());
        let mut surfaces = Surfaces::unknown(width, height);
        let mut moved = Moved::everywhere(width, height);
        let mut rows = vec![Choices::default(); height];
        let mut spread = vec![0.0; width * height];
        let first = (map.disparity.clone(), map.sigma.clone());
        for _ in 0..self.passes {
            let (disparity_before, sigma_before) = (map.disparity.clone(), map.sigma.clone());
            let (disparity_before, sigma_before) =
                (disparity_before.as_raw(), sigma_before.as_raw());
            surfaces.set(disparity_before, width);
            likeness.set_surfaces(disparity_before);
            rows.par_iter_mut().enumerate().for_each(|(y, choices)| {
                let opinion = opinion.map(|o| &o.disparity.as_raw()[y * width..][..width]);
                propose(&surfaces, &offsets, opinion, &moved, [width, y], choices);
                likeness.judge(choices, y);
            });
            let ground = Ground {
                rows: &rows,
                disparity: disparity_before,
                colours: &colours,
                breaks: &breaks,
            };
            let (down, up) = rayon::join(
                || ground.along_columns(true),
                || ground.along_columns(false),
            );
            let planes = (map.disparity.par_chunks_mut(width))
                .zip(map.sigma.par_chunks_mut(width))
                .zip(spread.par_chunks_mut(width));
            let columns = down.par_iter().zip(&up);
            planes.zip(columns).enumerate().for_each(
                |(y, (((disparity, sigma), spread), (down, up)))| {
                    let row = &rows[y];
                    for (k, (best, wide)) in ground.choose(y, down, up).into_iter().enumerate() {
                        let x = row.columns[k] as usize;
                        disparity[x] = row.disparity[k][best];
                        spread[x] = wide;
                        let source = usize::from(row.source[k][best]);
                        if let Some(n) = source.checked_sub(AROUND) {
                            let [dx, dy] = offsets[n];
                            let source =
                                (y.saturating_add_signed(dy) * width + x).saturating_add_signed(dx);
                            sigma[x] = sigma_before[source];
                        } else if let Some(opinion) = opinion.filter(|_| source == OPINION) {
                            sigma[x] = opinion.sigma.as_raw()[y * width + x];
                        }
                    }
                },
            );
            moved.set(disparity_before, map.disparity.as_raw(), width);
        }
        likeness.set_surfaces(map.disparity.as_raw());
        let doubt = Doubt {
            disparity_before: first.0.as_raw(),
            sigma_before: first.1.as_raw(),
            disparity: map.disparity.as_raw(),
            spread: &spread,
        };
        doubt.set(&likeness, width, &mut map.sigma, &mut map.confidence);
    }
}

/// An engine whose outlines are put where the images have them.
pub struct Outlined {
    engine: Box<dyn DisparityEngine>,
    outlines: Outlines,
    opinion: Opinion,
}

impl Outlined {
    /// `engine`, and then [`Outlines::sharpen`] with a second opinion.
    pub fn new(
        engine: Box<dyn DisparityEngine>,
        outlines: Outlines,
        opinion: SecondOpinion,
    ) -> Self {
        Self {
            engine,
            outlines,
            opinion: Opinion::new(opinion),
        }
    }

    fn sharpen(
        &mut self,
        left: &Rgb,
        right: &Rgb,
        map: &mut DisparityMap,
    ) -> Result<(), InferError> {
        let opinion = self.opinion.of(left, right, map)?;
        self.outlines.sharpen(left, right, opinion.as_ref(), map);
        Ok(())
    }
}

impl DisparityEngine for Outlined {
    fn name(&self) -> String {
        self.engine.name()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        let mut map = self.engine.disparity(left, right)?;
        self.sharpen(left, right, &mut map)?;
        Ok(map)
    }

    fn disparity_batch(&mut self, pairs: &[(&Rgb, &Rgb)]) -> Result<Vec<DisparityMap>, InferError> {
        let mut maps = self.engine.disparity_batch(pairs)?;
        for ((left, right), map) in pairs.iter().zip(&mut maps) {
            self.sharpen(left, right, map)?;
        }
        Ok(maps)
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use barchan_datasets::Plane;

    use super::*;

    const WIDTH: u32 = 160;
    const HEIGHT: u32 = 96;

    /// Greys that no two places share.
    fn texture(x: i64, y: i64) -> f32 {
        let mut h = (x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b)) as u64;
        h ^= h >> 13;
        h = h.wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        ((h >> 40) & 0xff) as f32 / 255.0
    }

    /// A square of `near` before a wall of `far`, and the true disparity of the left image.
    fn square_before_wall(near: i64, far: i64) -> (Rgb, Rgb, Plane) {
        let inside = |x: i64, y: i64| (60..110).contains(&x) && (25..70).contains(&y);
        let grey = |v: f32| image::Rgb([v; 3]);
        let wall = |x: i64, y: i64| 0.6 + 0.4 * texture(x, y);
        let front = |x: i64, y: i64| 0.4 * texture(x + 5000, y);
        let left = Rgb::from_fn(WIDTH, HEIGHT, |x, y| {
            let (x, y) = (i64::from(x), i64::from(y));
            grey(if inside(x, y) {
                front(x, y)
            } else {
                wall(x, y)
            })
        });
        let right = Rgb::from_fn(WIDTH, HEIGHT, |x, y| {
            let (x, y) = (i64::from(x), i64::from(y));
            grey(if inside(x + near, y) {
                front(x + near, y)
            } else {
                wall(x + far, y)
            })
        });
        let truth = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            let near_here = inside(i64::from(x), i64::from(y));
            image::Luma([if near_here { near } else { far } as f32])
        });
        (left, right, truth)
    }

    fn map_of(disparity: Plane) -> DisparityMap {
        let sigma = Plane::from_pixel(WIDTH, HEIGHT, image::Luma([0.3]));
        DisparityMap {
            confidence: sigma.clone(),
            sigma,
            disparity,
        }
    }

    fn wrong(map: &DisparityMap, truth: &Plane) -> usize {
        let pairs = map.disparity.as_raw().iter().zip(truth.as_raw());
        pairs.filter(|(d, t)| (*d - *t).abs() > 1.0).count()
    }

    #[test]
    fn a_fattened_square_gets_its_outline_back() {
        let (left, right, truth) = square_before_wall(20, 6);
        // Seven pixels too large on every side, as a window of fifteen makes it.
        let fat = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            let near = (53..117).contains(&x) && (18..77).contains(&y);
            image::Luma([if near { 20.0 } else { 6.0 }])
        });
        let mut map = map_of(fat);
        let before = wrong(&map, &truth);
        Outlines::default().sharpen(&left, &right, None, &mut map);
        let after = wrong(&map, &truth);
        assert!(
            before > 1400 && after < before / 20,
            "{before} wrong, then {after}"
        );
    }

    #[test]
    fn what_was_missed_comes_back_by_a_second_opinion_and_only_if_the_images_agree() {
        let (left, right, truth) = square_before_wall(20, 6);
        // The network saw the wall alone; nothing nearer is around to be proposed.
        let wall = || map_of(Plane::from_pixel(WIDTH, HEIGHT, image::Luma([6.0])));
        let missed = wrong(&wall(), &truth);
        let mut alone = wall();
        Outlines::default().sharpen(&left, &right, None, &mut alone);
        assert_eq!(wrong(&alone, &truth), missed);
        let mut told = wall();
        let opinion = map_of(truth.clone());
        Outlines::default().sharpen(&left, &right, Some(&opinion), &mut told);
        assert!(
            wrong(&told, &truth) < missed / 20,
            "{} wrong",
            wrong(&told, &truth)
        );
        // An opinion that the images contradict is not followed, and one of another size is none.
        let mut lied_to = map_of(truth.clone());
        let lie = map_of(Plane::from_pixel(WIDTH, HEIGHT, image::Luma([33.0])));
        Outlines::default().sharpen(&left, &right, Some(&lie), &mut lied_to);
        assert!(
            wrong(&lied_to, &truth) < 20,
            "{} moved",
            wrong(&lied_to, &truth)
        );
        let mut other = wall();
        let small = map_of(Plane::from_pixel(9, 9, image::Luma([20.0])));
        Outlines::default().sharpen(&left, &right, Some(&small), &mut other);
        assert_eq!(wrong(&other, &truth), missed);
    }

    #[test]
    fn an_engine_asks_for_a_second_opinion_by_itself() {
        /// Sees the wall, and of the square but one corner.
        struct Blind;
        impl DisparityEngine for Blind {
            fn name(&self) -> String {
                "blind".into()
            }
            fn disparity(&mut self, _: &Rgb, _: &Rgb) -> Result<DisparityMap, InferError> {
                let corner = |x, y| {
                    if x < 64 && (25..30).contains(&y) && x >= 60 {
                        20.0
                    } else {
                        6.0
                    }
                };
                Ok(map_of(Plane::from_fn(WIDTH, HEIGHT, |x, y| {
                    image::Luma([corner(x, y)])
                })))
            }
        }
        let (left, right, truth) = square_before_wall(20, 6);
        let wrong_with = |opinion| {
            let mut engine = Outlined::new(Box::new(Blind), Outlines::default(), opinion);
            wrong(&engine.disparity(&left, &right).unwrap(), &truth)
        };
        let [none, half, full] = [
            SecondOpinion::None,
            SecondOpinion::Half,
            SecondOpinion::Full,
        ]
        .map(wrong_with);
        assert!(none > 900 && full < none / 8, "{none} {half} {full}");
    }

    #[test]
    fn truth_and_slopes_stay_and_what_is_unknown_stays_unknown() {
        let (left, right, truth) = square_before_wall(20, 6);
        let mut map = map_of(truth.clone());
        map.disparity.put_pixel(10, 10, image::Luma([f32::NAN]));
        Outlines::default().sharpen(&left, &right, None, &mut map);
        assert!(map.disparity.get_pixel(10, 10)[0].is_nan());
        map.disparity.put_pixel(10, 10, *truth.get_pixel(10, 10));
        assert!(wrong(&map, &truth) < 20, "{} moved", wrong(&map, &truth));

        let slope = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            image::Luma([5.0 + 0.1 * x as f32 + 0.2 * y as f32])
        });
        let mut map = map_of(slope.clone());
        Outlines::default().sharpen(&left, &right, None, &mut map);
        assert!(map.disparity == slope, "a slope moved");
    }

    #[test]
    fn sigma_grows_where_the_right_camera_sees_nothing_and_where_images_are_unlike() {
        let (left, right, truth) = square_before_wall(20, 6);
        let mut map = map_of(truth);
        // A part of the wall that is said to be elsewhere, farther than anything reaches.
        for (x, y) in (120..150).flat_map(|x| (0..96).map(move |y| (x, y))) {
            map.disparity.put_pixel(x, y, image::Luma([31.0]));
        }
        Outlines::default().sharpen(&left, &right, None, &mut map);
        let mean = |columns: Range<u32>, of: &Plane| {
            let rows = columns.flat_map(|x| (35..60).map(move |y| (x, y)));
            let (n, sum) = rows.fold((0.0, 0.0), |(n, sum), (x, y)| {
                (n + 1.0, sum + of.get_pixel(x, y)[0])
            });
            sum / n
        };
        let parts = [70..100, 48..58, 134..140];
        let [seen, hidden, unlike] = parts.clone().map(|columns| mean(columns, &map.sigma));
        assert!(
            hidden > 1.5 * seen && unlike > 1.5 * seen,
            "{seen} {hidden} {unlike}"
        );
        let [seen, hidden, unlike] = parts.map(|columns| mean(columns, &map.confidence));
        assert!(hidden < seen && unlike < seen, "{seen} {hidden} {unlike}");
    }

    #[test]
    fn the_number_of_threads_changes_no_bit() {
        let (left, right, truth) = square_before_wall(20, 6);
        let fat = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            let near = (53..117).contains(&x) && (18..77).contains(&y);
            image::Luma([if near { 20.0 } else { 6.0 + 0.002 * x as f32 }])
        });
        let maps = [1, 2, 5].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let mut map = map_of(fat.clone());
            pool.unwrap()
                .install(|| Outlines::default().sharpen(&left, &right, None, &mut map));
            map
        });
        assert!(wrong(&maps[0], &truth) < wrong(&map_of(fat), &truth) / 4);
        for map in &maps[1..] {
            assert!(map.disparity == maps[0].disparity && map.sigma == maps[0].sigma);
            assert!(map.confidence == maps[0].confidence);
        }
    }

    #[test]
    fn small_and_unknown_maps_do_no_harm() {
        let sizes = [(1, 1), (2, 2), (1, 9), (3, 40)];
        for (width, height) in sizes {
            let image = Rgb::from_pixel(width, height, image::Rgb([0.5; 3]));
            for value in [f32::NAN, f32::INFINITY, -3.0, 0.0, 1e30] {
                let plane = Plane::from_fn(width, height, |x, _| {
                    image::Luma([if x % 2 == 0 { value } else { 4.0 }])
                });
                let mut map = DisparityMap {
                    disparity: plane.clone(),
                    sigma: plane.clone(),
                    confidence: plane,
                };
                Outlines::default().sharpen(&image, &image, Some(&map.clone()), &mut map);
            }
        }
    }
}
