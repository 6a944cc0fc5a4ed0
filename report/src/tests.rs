use barchan_terrain::{CloudPoint, Grid, Raster};
use nalgebra::Point3;

use super::*;

fn raster<T>(width: usize, height: usize, value: impl Fn(usize, usize) -> T) -> Raster<T> {
    let grid = Grid {
        width,
        height,
        west: 10.0,
        north: 20.0,
        cell_x: 0.5,
        cell_y: 0.5,
    };
    let values = (0..width * height)
        .map(|k| value(k % width, k / width))
        .collect();
    Raster {
        grid,
        crs: None,
        values,
    }
}

fn full() -> Report {
    let point = |k: usize| CloudPoint {
        position: Point3::new((k % 10) as f64, (k / 10) as f64, 0.1 * k as f64),
        colour: [k as u8, 0, 255],
        sigma: f32::NAN,
    };
    Report {
        title: "Run <1>".into(),
        source: "runs/\"a\" & b".into(),
        warnings: vec!["<script>alert(1)</script>".into()],
        figures: vec![("frames".into(), "40".into())],
        charts: vec![Chart {
            title: "Route & <truth>".into(),
            horizontal: "x, m".into(),
            vertical: "y, m".into(),
            plan: true,
            series: vec![Series {
                name: "truth".into(),
                style: Style::Line,
                samples: (0..5000)
                    .map(|k| (f64::from(k), f64::from(k % 7)))
                    .collect(),
            }],
        }],
        cloud: Some(Cloud3d {
            points: (0..100).map(point).collect(),
            route: vec![[0.0, 0.0, 1.0], [9.0, 9.0, 1.0]],
        }),
        relief: Some(Relief {
            elevation: raster(4, 3, |x, y| if x == 0 { f32::NAN } else { (x + y) as f32 }),
            shade: raster(4, 3, |_, _| 180),
            bound: None,
        }),
        pictures: vec![("frame \"7\"".into(), RgbImage::new(8, 8))],
        events: vec![("7".into(), "key frame <7>".into())],
        config: "a = \"</pre><script>\"".into(),
    }
}

#[test]
fn what_runs_are_called_cannot_become_markup() {
    let html = full().html().unwrap();
    // Only our own scripts open.
    assert_eq!(html.matches("<script").count(), 4);
    assert_eq!(html.matches("<pre>").count(), 1);
    for said in ["Run &lt;1&gt;", "key frame &lt;7&gt;", "&lt;truth&gt;"] {
        assert!(html.contains(said), "{said}");
    }
}

#[test]
fn a_page_needs_nothing_from_elsewhere() {
    let html = full().html().unwrap();
    for attribute in ["src=\"", "href=\""] {
        for (at, _) in html.match_indices(attribute) {
            let value = &html[at + attribute.len()..];
            assert!(value.starts_with("data:"), "{}", &value[..40]);
        }
    }
    assert!(html.contains("default-src 'none'"));
}

#[test]
fn parts_that_are_not_there_leave_no_trace() {
    let html = Report::default().html().unwrap();
    for part in ["<canvas", "<table", "<figure", "<pre", "class=\"warnings\""] {
        assert!(!html.contains(part), "{part}");
    }
    // A cloud of nothing and a relief of nothing known are no reason to fail.
    let nothing = Report {
        cloud: Some(Cloud3d::default()),
        relief: Some(Relief {
            elevation: raster(3, 3, |_, _| f32::NAN),
            shade: raster(3, 3, |_, _| 0),
            bound: None,
        }),
        charts: vec![Chart {
            title: String::new(),
            horizontal: String::new(),
            vertical: String::new(),
            plan: true,
            series: vec![],
        }],
        ..Report::default()
    };
    assert!(nothing.html().is_ok());
}

#[test]
fn packed_points_lie_where_they_were_and_each_is_there_once() {
    let report = full();
    let cloud = report.cloud.unwrap();
    let packed = cloud.pack().unwrap();
    let bytes = BASE64_STANDARD.decode(&packed.positions).unwrap();
    let colours = BASE64_STANDARD.decode(&packed.colours).unwrap();
    assert_eq!((bytes.len(), colours.len()), (600, 300));
    let mut seen = [false; 100];
    for (place, colour) in bytes.chunks(6).zip(colours.chunks(3)) {
        let k = usize::from(colour[0]);
        assert!(!std::mem::replace(&mut seen[k], true), "{k} twice");
        for axis in 0..3 {
            let whole = u16::from_le_bytes([place[2 * axis], place[2 * axis + 1]]);
            let value = packed.origin[axis] + packed.step * f64::from(whole);
            let off = (value - cloud.points[k].position[axis]).abs();
            assert!(off <= 0.5001 * packed.step, "{k}: {off}");
        }
    }
}

#[test]
fn long_lines_keep_their_peaks() {
    let mut samples: Vec<(f64, f64)> = (0..100_000).map(|k| (f64::from(k), 1.0)).collect();
    samples[54_321].1 = 99.0;
    samples[77_777].1 = -5.0;
    let chart = Chart {
        title: "t".into(),
        horizontal: "h".into(),
        vertical: "v".into(),
        plan: false,
        series: vec![Series {
            name: "s".into(),
            style: Style::Line,
            samples,
        }],
    };
    let kept = chart::thinned(&chart.series[0]);
    assert!(kept.len() <= MAX_SAMPLES);
    assert!(kept.is_sorted_by(|a, b| a.0 <= b.0));
    for peak in [99.0, -5.0] {
        assert!(kept.iter().any(|s| s.1 == peak), "{peak}");
    }
}

#[test]
fn a_large_relief_is_thinned_and_says_so() {
    let relief = Relief {
        elevation: raster(2500, 900, |x, y| (x * 10_000 + y) as f32),
        shade: raster(2500, 900, |_, _| 200),
        bound: Some(raster(2500, 900, |_, _| 0.1)),
    };
    let packed = relief.pack().unwrap();
    assert!(packed.every > 1 && packed.width * packed.height <= MAX_CELLS);
    let bytes = BASE64_STANDARD.decode(&packed.elevation).unwrap();
    assert_eq!(bytes.len(), 4 * packed.width * packed.height);
    let (column, row) = (packed.width - 1, packed.height - 1);
    let last = f32::from_le_bytes(bytes[bytes.len() - 4..].try_into().unwrap());
    assert_eq!(
        last,
        (column * packed.every * 10_000 + row * packed.every) as f32
    );
}
