use super::*;
use crate::resample::cubic_weights;
use barchan_geometry::StereoPoint;

fn synth(spec: &str) -> Synth {
    Synth::parse(spec).unwrap()
}

/// The mean difference, in grey levels, between the left image and the right one warped to it by
/// the true disparity, over pixels that the right camera sees; without those on an outline, of which
/// it sees a part only; and the share of all pixels that were compared.
fn warp_error(synth: &Synth, index: usize) -> [f64; 3] {
    let frame = synth.frame(index).unwrap();
    let disparity = synth.true_disparity(index).unwrap().unwrap();
    let occlusion = synth.true_occlusion(index).unwrap();
    let (w, h) = disparity.dimensions();
    let (mut all, mut whole) = ((0.0, 0.0), (0.0, 0.0));
    for (u, v) in (1..h - 1).flat_map(|v| (1..w - 1).map(move |u| (u, v))) {
        let d = disparity[(u, v)].0[0];
        let at = u as f32 - d;
        if at.is_nan() || at < 1.0 || occlusion[(u, v)].0[0] != 0.0 {
            continue;
        }
        let weights = cubic_weights(at.fract());
        let mut error = 0.0;
        for c in 0..3 {
            let right: f32 = (0..4u32)
                .map(|k| {
                    weights[k as usize] * frame.right[((at as u32 + k - 1).min(w - 1), v)].0[c]
                })
                .sum();
            error += f64::from((right - frame.left[(u, v)].0[c]).abs()) / 3.0 * 255.0;
        }
        all = (all.0 + error, all.1 + 1.0);
        let around = [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)];
        if around
            .iter()
            .all(|n| (disparity[*n].0[0] / d - 1.0).abs() < 0.1)
        {
            whole = (whole.0 + error, whole.1 + 1.0);
        }
    }
    [all.0 / all.1, whole.0 / whole.1, all.1 / f64::from(w * h)]
}

#[test]
fn the_right_image_warped_by_the_true_disparity_is_the_left_image() {
    for spec in [
        "seed=1,frames=18",
        "seed=4,frames=18",
        "seed=3,frames=18,look=arena,texture=real",
        "seed=2,frames=18,look=moon",
        "seed=3,frames=18,look=devon",
    ] {
        let [error, inside, share] = warp_error(&synth(&format!("{spec},noise=0")), 17);
        println!("{spec}: {error:.3}, without outlines {inside:.3} grey levels; {share:.3} seen");
        assert!(error < 1.0 && inside < 1.0, "{spec}: {error} {inside}");
        assert!(share > 0.6, "{spec}: {share}");
    }
}

#[test]
fn the_truths_of_both_views_agree_where_nothing_hides() {
    let synth = synth("seed=6,frames=4,rocks=0.12");
    let left = synth.true_disparity(3).unwrap().unwrap();
    let right = synth.true_disparity_right(3).unwrap().unwrap();
    let occlusion = synth.true_occlusion(3).unwrap();
    let (mut seen, mut agree, mut hidden, mut before) = (0, 0, 0, 0);
    for (u, v, d) in left.enumerate_pixels() {
        let d = d.0[0];
        let at = u as f32 - d;
        if at.is_nan() || at < 0.0 || at as u32 + 1 >= right.width() {
            continue;
        }
        let share = at.fract();
        let [a, b] = [0, 1].map(|k| right[(at as u32 + k, v)].0[0]);
        let there = a * (1.0 - share) + b * share;
        if occlusion[(u, v)].0[0] == 0.0 {
            seen += 1;
            agree += u32::from((there - d).abs() < 0.02 * d + 0.05);
        } else {
            hidden += 1;
            // What hides it is nearer.
            before += u32::from(a.max(b) > d);
        }
    }
    println!("{agree} of {seen} seen agree, {before} of {hidden} hidden lie behind");
    assert!(
        f64::from(agree) > 0.98 * f64::from(seen),
        "{agree} of {seen}"
    );
    assert!(
        hidden > 300 && f64::from(before) > 0.98 * f64::from(hidden),
        "{before} of {hidden}"
    );
}

#[test]
fn disparity_back_projects_onto_ground_and_rocks_along_the_trajectory() {
    let synth = synth("seed=9,frames=300,width=128,height=96");
    for index in [0, 150, 299] {
        let T_world_cam = synth.true_trajectory().unwrap().poses[index].T_world_cam;
        let disparity = synth.true_disparity(index).unwrap().unwrap();
        let depth = synth.true_depth(index).unwrap();
        let (mut near, mut on_ground) = (0, 0);
        for (u, v, d) in disparity
            .enumerate_pixels()
            .filter(|p| p.2.0[0].is_finite())
        {
            let at = StereoPoint {
                u: f64::from(u),
                v: f64::from(v),
                d: f64::from(d.0[0]),
            };
            let p_cam = synth.rig.back_project(at).unwrap();
            assert!((p_cam.z as f32 / depth[(u, v)].0[0] - 1.0).abs() < 1e-6);
            let p_world = T_world_cam * p_cam;
            let above = p_world.z - synth.bare_ground_height(p_world.x, p_world.y);
            let outside = synth.site.rocks.distance(&synth.site.surface, &p_world);
            assert!(
                above.min(outside).abs() < 2e-5 * p_cam.z.max(1.0),
                "{above} {outside} at {} m",
                p_cam.z
            );
            near += usize::from(d.0[0] > 1.0);
            on_ground += usize::from(above < outside);
        }
        // At a third of the default width, a third of the default disparity.
        assert!(near > 128 * 96 * 6 / 10, "{near}");
        assert!(on_ground > near / 2, "{on_ground} of {near}");
    }
}

#[test]
fn a_point_seen_from_above_is_at_the_ground_height() {
    let synth = synth("seed=3,frames=1,rocks=0.2");
    let (site, mut on_rock) = (&synth.site, 0);
    for k in 0..2000 {
        let (x, y) = (k as f64 * 0.0137 - 14.0, (k as f64 * 0.731).sin() * 12.0);
        let from = Point3::new(x, y, 20.0);
        let hit = site
            .surface
            .hit(&site.rocks, &from, &-Vector3::z(), 0.0, 40.0)
            .unwrap();
        assert!((20.0 - hit.t - synth.ground_height(x, y)).abs() < 1e-5);
        on_rock += u32::from(synth.ground_height(x, y) > synth.bare_ground_height(x, y));
    }
    assert!(on_rock > 50 && !synth.rocks().is_empty(), "{on_rock}");
}

#[test]
fn the_rover_drives_on_and_looks_down_at_the_ground() {
    let synth = synth("seed=2,frames=700,width=32,height=32");
    let poses = &synth.true_trajectory().unwrap().poses;
    for (a, b) in poses.iter().zip(&poses[1..]) {
        let T_a_b = a.T_world_cam.inverse() * b.T_world_cam;
        assert!(
            (0.04..0.13).contains(&T_a_b.translation.vector.norm()),
            "{T_a_b}"
        );
        assert!(T_a_b.rotation.angle() < 0.06, "{}", T_a_b.rotation.angle());
        assert!((b.time - a.time - INTERVAL).abs() < 1e-9);
        let at = a.T_world_cam.translation.vector;
        let above = at.z - synth.ground_height(at.x, at.y);
        assert!((0.5..1.1).contains(&above), "{above}");
        let down = -(a.T_world_cam.rotation * Vector3::z()).z.asin();
        assert!((0.05..0.7).contains(&down), "{down}");
    }
}

#[test]
fn a_seed_fixes_every_byte_and_another_changes_them() {
    let spec = "seed=5,frames=9,width=64,height=48,bloom=0.3,dust=3,pattern=0.01,blur=0.02";
    let (a, b) = (synth(spec), synth(spec));
    let other = synth("seed=6,frames=9,width=64,height=48");
    // In another order, after other frames, on one thread.
    let first = a.frame(7).unwrap();
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let again = one.install(|| {
        b.frame(8).unwrap();
        b.frame(0).unwrap();
        b.frame(7).unwrap()
    });
    assert_eq!((&first.left, &first.right), (&again.left, &again.right));
    assert_ne!(first.left, other.frame(7).unwrap().left);
    assert_ne!(first.left, a.frame(6).unwrap().left);
    assert_eq!(a.true_trajectory(), b.true_trajectory());
    assert!(a.frame(9).is_err() && a.true_disparity(9).is_err());
    assert!(a.true_occlusion(9).is_err() && a.true_disparity_right(9).is_err());
}

#[test]
fn a_rectified_frame_of_a_crooked_rig_has_the_exact_truth() {
    let synth = synth("seed=3,frames=2,noise=0,rectified=false");
    assert!(synth.unrectified_rig().is_some_and(|rig| !rig.rectified));
    // Images are resampled, and a border of them is black: near it nothing is asked.
    let frame = synth.frame(1).unwrap();
    let disparity = synth.true_disparity(1).unwrap().unwrap();
    let occlusion = synth.true_occlusion(1).unwrap();
    let (mut error, mut seen) = (0.0, 0.0);
    for v in 40..248 {
        for u in 40..344 {
            let at = u as f32 - disparity[(u, v)].0[0];
            if at >= 40.0 && occlusion[(u, v)].0[0] == 0.0 {
                let (x, share) = (at as u32, at.fract());
                let luma = |x: u32| frame.right[(x, v)].0[1];
                let right = luma(x) * (1.0 - share) + luma(x + 1) * share;
                error += (right - frame.left[(u, v)].0[1]).abs() * 255.0;
                seen += 1.0;
            }
        }
    }
    println!("{} grey levels", error / seen);
    assert!(seen > 20_000.0 && error / seen < 2.0, "{}", error / seen);
}

#[test]
fn options_are_checked_by_name() {
    let defaults = synth("");
    assert_eq!(
        (defaults.len(), defaults.rig().width, defaults.rig().height),
        (60, 384, 288)
    );
    for (spec, named) in [
        ("sead=1", "sead"),
        ("frames=0", "frames"),
        ("frames", "frames"),
        ("width=7", "width"),
        ("height=99999", "height"),
        ("seed=-1", "seed"),
        ("noise=nan", "noise"),
    ] {
        let message = Synth::parse(spec)
            .err()
            .map(|e| e.to_string())
            .unwrap_or_default();
        assert!(
            message.contains(&format!("synth:{spec}: ")) && message.contains(named),
            "{message}"
        );
    }
}

#[test]
fn the_ground_of_a_dem_is_the_dem() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../shared/data/marsyard2021/elevation.tif"
    );
    if !std::path::Path::new(path).is_file() {
        println!("skipped: no shared/data/marsyard2021");
        return;
    }
    let synth = synth(&format!("dem={path},frames=200,width=96,height=72"));
    let dem = dem::Dem::read(path.as_ref()).unwrap();
    assert_eq!((dem.width, dem.height), (500, 500));
    let mut worst = 0.0f64;
    for (k, h) in dem.heights.iter().enumerate() {
        let (x, y) = (
            dem.corner.x + (k % 500) as f64 * dem.cell,
            dem.corner.y + (k / 500) as f64 * dem.cell,
        );
        // On the last row and column rounding may fall beyond the end.
        let height = synth.ground_height(x, y);
        if !height.is_nan() {
            worst = worst.max((height - h).abs());
        }
    }
    println!("worst {worst} m");
    assert!(worst < 1e-5, "{worst}");
    for i in [0, 100, 199] {
        let known = synth.true_disparity(i).unwrap().unwrap();
        let known = known.iter().filter(|d| d.is_finite()).count();
        assert!(known > 96 * 72 / 2, "{known}");
    }
}
