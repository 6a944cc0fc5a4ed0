use barchan_datasets::{StereoSource, Synth};
use barchan_model::Preset;
use burn::tensor::Tensor;

use super::checks::{between_pixels, device, gradient_error, map, waves};
use super::*;
use crate::{Augmentation, Ended, LogLine, Observer, TrainConfig, Trainer, Validation};

type Change = fn(&mut Loss);

/// Every term off.
const NOTHING: Loss = Loss {
    ssim: 0.0,
    l1: 0.0,
    smooth: 0.0,
    magnitude: 0.0,
    second_order: 0.0,
    census: 0.0,
    occlusion: None,
    symmetric: false,
    neighbours: 0,
    proxies: 0.0,
    distribution: 0.0,
};

fn view(disparity: &Tensor<4>) -> View {
    View::new(waves(0.0), waves(1.3), disparity.clone())
}

/// A neighbour half a row off, a column further, at a tenth of a row a pixel of disparity.
fn neighbour(image: Tensor<4>) -> Neighbour {
    let tensor = |v: &[f32]| Tensor::<1>::from_floats(v, &device()).reshape([1, v.len()]);
    Neighbour {
        image,
        projection: tensor(&[1.0, 0.0, 1.0, -1.0, 0.0, 1.0, 0.4, 0.1, 0.0, 0.0, 1.0, 0.0]),
        last: tensor(&[11.0, 7.0]),
    }
}

/// `image` in the columns from..to, and grey elsewhere.
fn only(image: &Tensor<4>, from: usize, to: usize) -> Tensor<4> {
    let mask = map(8, 12, |x, _| f32::from((from..to).contains(&x)));
    image.clone() * mask.clone() + (-mask + 1.0) * 0.1
}

#[test]
fn gradient_of_every_term_matches_finite_differences() {
    let only_weight = |change: Change| {
        let mut loss = NOTHING;
        change(&mut loss);
        loss
    };
    let right_disparity = map(8, 12, |x, _| if x < 6 { 2.0 } else { 50.0 });
    let proxies = [
        map(8, 12, |x, _| 0.1 + 0.3 * x as f32),
        map(8, 12, |x, y| f32::from((x + y) % 3 > 0)),
    ];
    let cases = [
        ("eq. 1", Loss::default()),
        ("ssim", only_weight(|l| l.ssim = 1.0)),
        ("l1", only_weight(|l| l.l1 = 1.0)),
        ("smooth", only_weight(|l| l.smooth = 1.0)),
        ("magnitude", only_weight(|l| l.magnitude = 1.0)),
        ("second order", only_weight(|l| l.second_order = 1.0)),
        ("census", only_weight(|l| l.census = 1.0)),
        ("proxies", only_weight(|l| l.proxies = 1.0)),
        (
            "occlusion",
            Loss {
                occlusion: Some(10.0),
                ..Loss::default()
            },
        ),
        (
            // One term alone, as means over masks of different size jump where the choice changes.
            "neighbours",
            only_weight(|l| (l.l1, l.neighbours) = (1.0, 1)),
        ),
    ];
    // Differences of first and second order nowhere near zero, where they have kinks.
    let bowl = map(8, 12, |x, y| 0.1 * ((x * x) as f32 + 0.7 * (y * y) as f32));
    for (name, loss) in cases {
        let smoothness = loss.smooth + loss.second_order == 1.0;
        let disparity = if smoothness {
            bowl.clone()
        } else {
            between_pixels()
        };
        let (worst, largest) = gradient_error(&disparity, |d| {
            let mut view = view(d);
            if loss.occlusion.is_some() {
                view.right_disparity = Some(right_disparity.clone());
            }
            if loss.neighbours > 0 {
                // Each explains what the other cannot, so that no pixel is between them.
                view.right = only(&view.right, 0, 5);
                view.neighbours = vec![neighbour(only(&waves(1.0), 6, 12))];
            }
            if loss.proxies > 0.0 {
                view.proxies = Some(proxies.clone());
            }
            loss.self_supervised(&view, None).0
        });
        assert!(largest > 1e-4, "{name}: the gradient vanishes: {largest}");
        assert!(
            worst < 0.05 * largest,
            "{name}: worst {worst}, largest gradient {largest}"
        );
    }
}

#[test]
fn without_options_nothing_is_added_to_the_paper() {
    let (total, terms) = Loss::default().self_supervised(&view(&between_pixels()), None);
    let terms = terms.values();
    let paper = 0.8 * terms.ssim + 0.2 * terms.l1 + 0.1 * terms.smooth + 0.1 * terms.magnitude;
    assert!((total.into_scalar::<f32>() - paper).abs() < 1e-6);
    assert_eq!(
        LossTerms {
            second_order: None,
            census: None,
            proxies: None,
            visible: None,
            from_neighbours: None,
            ..terms.clone()
        },
        terms
    );
}

#[test]
fn a_configuration_of_before_the_options_means_none() {
    let old = "ssim = 0.8\nl1 = 0.2\nsmooth = 0.1\nmagnitude = 0.1\n";
    let loss: Loss = toml::from_str(old).unwrap();
    assert_eq!(loss, Loss::default());
    let all = Loss {
        occlusion: Some(1.0),
        symmetric: true,
        neighbours: 2,
        ..Loss::default()
    };
    let back: Loss = toml::from_str(&toml::to_string(&all).unwrap()).unwrap();
    assert_eq!(back, all);
}

#[test]
fn the_minimum_leaves_a_pixel_hidden_in_one_image_to_another() {
    // With disparity zero and no motion the right image and its neighbour show the left image itself,
    // but each has a grey post somewhere.
    let left = waves(0.0);
    let post = |x0: usize| {
        let mask = map(8, 12, |x, _| f32::from((x0..x0 + 3).contains(&x)));
        left.clone() * (-mask.clone() + 1.0) + mask * 0.1
    };
    let mut view = View::new(left.clone(), post(1), map(8, 12, |_, _| 0.0));
    let loss = Loss {
        neighbours: 1,
        census: 0.5,
        ..Loss::default()
    };
    let photometric = |view: &View| {
        let t = loss.self_supervised(view, None).1.values();
        (t.ssim + t.l1 + t.census.unwrap(), t.from_neighbours)
    };
    let (alone, _) = photometric(&view);
    assert!(alone > 0.1, "{alone}");

    let tensor = |v: &[f32]| Tensor::<1>::from_floats(v, &device()).reshape([1, v.len()]);
    view.neighbours = vec![Neighbour {
        image: post(9),
        projection: tensor(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
        last: tensor(&[11.0, 7.0]),
    }];
    let (together, share) = photometric(&view);
    // At least the three columns of the post, at most those and where windows of five touch it, and one
    // where it hardly matters.
    let share = share.unwrap();
    assert!(together < 1e-5, "{together}");
    assert!((0.24..0.6).contains(&share), "{share}");
}

#[test]
fn a_proxy_holds_only_where_it_explains_the_image_better() {
    // The right image is the left one moved by two: a proxy of two is true, one of three is not.
    let left = waves(0.0);
    let right = Tensor::cat(
        vec![left.clone().narrow(3, 2, 10), left.clone().narrow(3, 10, 2)],
        3,
    );
    let term = |disparity: f32, proxy: f32| {
        let flat = |d| map(8, 12, move |_, _| d);
        let mut view = View::new(left.clone(), right.clone(), flat(disparity));
        view.proxies = Some([flat(proxy), map(8, 12, |x, _| f32::from(x >= 3))]);
        let loss = Loss {
            proxies: 0.1,
            ..Loss::default()
        };
        let terms = loss.self_supervised(&view, None).1.values();
        terms.proxies.unwrap()
    };
    assert!((term(3.0, 2.0) - 0.5).abs() < 1e-5, "{}", term(3.0, 2.0));
    assert_eq!(term(2.0, 3.0), 0.0);
}

#[test]
fn a_mirrored_pair_has_the_loss_of_the_pair() {
    let (left, right) = (waves(0.0), waves(1.3));
    let d = between_pixels();
    let loss = Loss {
        census: 0.3,
        second_order: 0.2,
        ..Loss::default()
    };
    // Swapped and mirrored twice is the pair itself, so both views agree and so does their mean.
    let one = View::new(left.clone(), right.clone(), d.clone());
    let twice = View::new(
        mirror(&mirror(&left)),
        mirror(&mirror(&right)),
        mirror(&mirror(&d)),
    );
    let total = |a: &View, b: Option<&View>| loss.self_supervised(a, b).0.into_scalar::<f32>();
    assert!((total(&one, None) - total(&one, Some(&twice))).abs() < 1e-6);
    // A right image sampled at x - d of the left is, mirrored, one sampled at x + d.
    let (warped, _) = warp_right_to_left(&right, &Tensor::full([1, 1, 8, 12], 2.0, &device()));
    let (back, inside) = warp_right_to_left(
        &mirror(&warped),
        &Tensor::full([1, 1, 8, 12], 2.0, &device()),
    );
    let known = inside.narrow(3, 2, 8);
    let difference = ((mirror(&back) - right.clone()).narrow(3, 2, 8).abs() * known).max();
    assert!(difference.into_scalar::<f32>() < 1e-6);
}

#[test]
fn terms_that_are_off_are_neither_printed_nor_logged() {
    let plain = LossTerms {
        ssim: 0.25,
        ..LossTerms::default()
    };
    assert_eq!(
        plain.to_string(),
        "ssim 0.2500  l1 0.0000  smooth 0.0000  magnitude 0.0000"
    );
    let census = LossTerms {
        census: Some(0.5),
        ..plain.clone()
    };
    assert_eq!(census.to_string(), format!("{plain}  census 0.5000"));
    assert!(!serde_json::to_string(&plain).unwrap().contains("census"));
    assert!(serde_json::to_string(&census).unwrap().contains("census"));
}

#[test]
fn nonsense_weights_and_options_without_effect_are_refused() {
    let refused = |loss: Loss, supervised: bool| loss.check(supervised).unwrap_err().to_string();
    let nan = Loss {
        census: f32::NAN,
        ..Loss::default()
    };
    assert!(refused(nan, false).contains("census"));
    let negative = Loss {
        occlusion: Some(-1.0),
        ..Loss::default()
    };
    assert!(refused(negative, false).contains("occlusion"));
    let proxies = Loss {
        proxies: 0.5,
        ..Loss::default()
    };
    assert!(proxies.check(false).is_ok());
    assert!(refused(proxies, true).contains("--supervised"));
}

#[test]
fn a_few_steps_with_each_option_lower_its_loss() {
    let options: [(&str, Change); 7] = [
        ("none", |_| ()),
        ("second order", |l| l.second_order = 0.1),
        ("census alone", |l| {
            (l.ssim, l.l1, l.census) = (0.0, 0.0, 1.0)
        }),
        ("occlusion", |l| l.occlusion = Some(1.0)),
        ("symmetric", |l| {
            (l.symmetric, l.occlusion) = (true, Some(1.0));
        }),
        ("neighbours", |l| l.neighbours = 1),
        ("proxies", |l| l.proxies = 0.1),
    ];
    for (name, change) in options {
        let (lines, [before, after]) = train(change);
        let [first, last] = [&lines[0], &lines[lines.len() - 1]];
        assert!(last.loss < 0.97 * first.loss, "{name}: {first:?} {last:?}");
        assert!(
            after.photometric < before.photometric,
            "{name}: {before:?} {after:?}"
        );
        let (t, l) = (&last.terms, loss_with(change));
        assert_eq!(after.census.is_some(), l.census > 0.0, "{name}");
        let logged = [
            (t.second_order, l.second_order > 0.0),
            (t.census, l.census > 0.0),
            (t.proxies, l.proxies > 0.0),
            (t.visible, l.occlusion.is_some()),
            (t.from_neighbours, l.neighbours > 0),
        ];
        for (value, wanted) in logged {
            assert_eq!(value.is_some(), wanted, "{name}: {t:?}");
            assert!(
                value.is_none_or(|v| v.is_finite() && v > 0.0),
                "{name}: {t:?}"
            );
        }
    }
}

fn loss_with(change: Change) -> Loss {
    let mut loss = Loss::default();
    change(&mut loss);
    loss
}

/// What a run tells of its steps.
#[derive(Default)]
struct Lines(Vec<LogLine>);

impl Observer for Lines {
    fn step(&mut self, line: &LogLine) {
        self.0.push(line.clone());
    }
}

/// Trains a random network on one frame, uncropped and untouched, so that steps compare.
fn train(change: Change) -> (Vec<LogLine>, [Validation; 2]) {
    let data = "seed=5,frames=2,width=64,height=48".to_owned();
    let dir = tempfile::tempdir().unwrap();
    let mut config = TrainConfig::new(Preset::Tiny.config());
    config.data = vec![format!("synth:{data}")];
    config.crop = [48, 64];
    config.net.max_disparity = 32;
    config.schedule.epochs = 8;
    config.loss = loss_with(change);
    config.augmentation = Augmentation {
        noise: 0.0,
        brightness: 0.0,
        contrast: 0.0,
        channel: 0.0,
        ..Augmentation::default()
    };
    let source: Box<dyn StereoSource> = Box::new(Synth::parse(&data).unwrap());
    let mut trainer = Trainer::create(&dir.path().join("run"), config, vec![source], None).unwrap();
    let mut lines = Lines::default();
    match trainer.run(&mut lines).unwrap() {
        Ended::Finished { before, after, .. } => {
            (lines.0, [before, after].map(|scored| scored.validation))
        }
        Ended::Stopped { step } => panic!("stopped after {step}"),
    }
}
