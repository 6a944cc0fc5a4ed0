//! Files made to the contracts of others are understood, served, and refused where they must be.
#![cfg(feature = "onnxruntime")]

mod support;

use std::path::PathBuf;

use barchan_datasets::{Rgb, open};
use barchan_infer::{
    Channels, Contract, DisparityEngine, InferError, Layout, OnnxEngine, OutputLayout, Runtime,
    Side, Unit, Verdict, probe,
};
use barchan_onnx::Message;
use support::{IMAGENET, Inputs, Stereo};

fn runtime() -> Runtime {
    match Runtime::load(None) {
        Ok(runtime) => runtime,
        Err(error) => panic!("`make test` installs ONNX Runtime first: {error}"),
    }
}

/// A folder with `x.onnx` in it.
fn folder(model: &Stereo) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.onnx");
    model.write(&path);
    (dir, path)
}

fn verdict(path: &std::path::Path) -> Result<Verdict, InferError> {
    probe(&runtime(), path, 1, &mut |_, _| ())
}

/// Median error of an engine on a scene that the probe has not seen, pixels, over what both cameras see
/// within an eighth of the width.
fn median_error(engine: &mut OnnxEngine, width: u32, height: u32) -> f32 {
    let spec = format!("synth:scenes,seed=23,frames=1,clutter=0,width={width},height={height}");
    let source = open(&spec).unwrap();
    let frame = source.frame(0).unwrap();
    let truth = source.true_disparity(0).unwrap().unwrap();
    let map = engine.disparity(&frame.left, &frame.right).unwrap();
    assert_eq!(map.disparity.dimensions(), (width, height));
    let mut errors: Vec<f32> = (truth.enumerate_pixels().zip(map.disparity.iter()))
        .filter(|((x, _, t), _)| t.0[0] <= *x as f32 && t.0[0] < width as f32 / 8.0)
        .map(|((_, _, t), d)| (t.0[0] - d).abs())
        .collect();
    errors.sort_by(f32::total_cmp);
    errors[errors.len() / 2]
}

/// Probes, writes `x.toml`, and holds what is then served to the truth.
fn understood(model: &Stereo) -> Verdict {
    let (_dir, path) = folder(model);
    let verdict = verdict(&path).unwrap();
    println!("{}\n", verdict.explanation.join("\n"));
    verdict.save(&path).unwrap();
    let mut engine = OnnxEngine::load(&runtime(), &path, 1).unwrap();
    assert_eq!(*engine.contract(), verdict.contract);
    let wide = model.size.map_or(256, |s| s[0]) as u32;
    let error = median_error(&mut engine, wide, 160);
    assert!(error < 0.8, "median error {error} px");
    let error = median_error(&mut engine, 234, 131);
    // Its pixels are larger by a fifth, and the images that it sees are blurred by resizing.
    assert!(error < 1.3, "median error {error} px at another size");
    verdict
}

fn decided(verdict: &Verdict, question: &str) -> bool {
    let decision = verdict.decisions.iter().find(|d| d.question == question);
    decision.unwrap().decided
}

#[test]
fn hitnet_is_understood() {
    for grey in [false, true] {
        let verdict = understood(&Stereo::hitnet(grey));
        let contract = &verdict.contract;
        assert_eq!(contract.input[0].images, [Side::Left, Side::Right]);
        assert_eq!(contract.images.mean, vec![0.0; if grey { 1 } else { 3 }]);
        assert_eq!(contract.images.std, vec![1.0; if grey { 1 } else { 3 }]);
        assert_eq!(
            contract.images.channels,
            if grey { Channels::Grey } else { Channels::Rgb }
        );
        assert_eq!(contract.output.name, "reference_output_disparity");
        assert_eq!(contract.output.layout, OutputLayout::Nhwc);
        assert_eq!(
            (contract.output.factor, contract.output.unit),
            (1.0, Unit::Pixels)
        );
        assert_eq!(
            contract.size.width.zip(contract.size.height),
            Some((192, 128))
        );
        assert!(decided(&verdict, "images") && decided(&verdict, "values"));
    }
}

#[test]
fn crestereo_is_understood_with_two_and_four_inputs_and_either_sign() {
    for (four, factor) in [(false, 1.0), (false, -1.0), (true, 1.0)] {
        let verdict = understood(&Stereo {
            factor,
            ..Stereo::crestereo(four)
        });
        let contract = &verdict.contract;
        assert_eq!(contract.images.std, vec![1.0 / 255.0; 3]);
        assert_eq!(contract.output.factor, f64::from(factor));
        assert_eq!(
            (contract.output.layout, contract.output.channel),
            (OutputLayout::Nchw, 0)
        );
        let shrinks: Vec<usize> = contract.input.iter().map(|i| i.shrink).collect();
        assert_eq!(shrinks, if four { vec![2, 2, 1, 1] } else { vec![1, 1] });
        assert!(decided(&verdict, "images") && decided(&verdict, "values"));
        assert!(
            !decided(&verdict, "channels"),
            "the mean of the channels has no order"
        );
    }
}

#[test]
fn layouts_values_and_orders_are_told_apart() {
    let (mean, std) = IMAGENET;
    let verdict = understood(&Stereo {
        inputs: Inputs::Stacked,
        names: vec!["images"],
        nhwc: true,
        right_first: true,
        mean,
        std,
        ..Stereo::default()
    });
    assert_eq!(verdict.contract.images.layout, Layout::Nhwc);
    assert_eq!(verdict.contract.input[0].images, [Side::Right, Side::Left]);
    assert_eq!(verdict.contract.images.mean, [0.485, 0.456, 0.406]);

    // Names that mislead: the truth is in the images.
    let verdict = understood(&Stereo {
        right_first: true,
        grey: true,
        mean: [0.5; 3],
        std: [0.5; 3],
        ..Stereo::default()
    });
    assert_eq!(verdict.contract.input[0].images, [Side::Right]);
    assert_eq!(
        (
            verdict.contract.images.mean[0],
            verdict.contract.images.std[0]
        ),
        (0.5, 0.5)
    );
}

#[test]
fn units_and_resolutions_are_measured() {
    // A quarter of the size, counted in pixels of its own.
    let verdict = understood(&Stereo {
        coarse: 4,
        factor: 0.25,
        ..Stereo::default()
    });
    assert_eq!(
        (verdict.contract.output.factor, verdict.contract.output.unit),
        (4.0, Unit::Pixels)
    );
    // A share of the width, leftwards.
    let verdict = understood(&Stereo {
        share: true,
        factor: -1.0,
        ..Stereo::default()
    });
    assert_eq!(
        (verdict.contract.output.factor, verdict.contract.output.unit),
        (-1.0, Unit::Width)
    );
    // No usual factor: as it was measured.
    let verdict = understood(&Stereo {
        factor: 1.0 / 100.0,
        ..Stereo::default()
    });
    assert!((verdict.contract.output.factor / 100.0 - 1.0).abs() < 0.05);
}

#[test]
fn free_sizes_are_explored() {
    let free = Stereo {
        size: None,
        grey: true,
        disparities: 40,
        ..Stereo::default()
    };
    let verdict = understood(&Stereo {
        multiple: 32,
        share: true,
        ..free.clone()
    });
    let size = &verdict.contract.size;
    assert_eq!(
        (size.width, size.height, size.multiple, size.batch),
        (None, None, 32, false)
    );
    assert_eq!(verdict.contract.output.unit, Unit::Width);

    // Shift by up to 39 pixels needs no more than one: any size, and several at once.
    let model = Stereo {
        free_batch: true,
        ..free
    };
    let verdict = understood(&model);
    assert_eq!(
        (verdict.contract.size.multiple, verdict.contract.size.batch),
        (1, true)
    );
    let (_dir, path) = folder(&model);
    verdict.save(&path).unwrap();
    let mut engine = OnnxEngine::load(&runtime(), &path, 1).unwrap();
    let image = |seed: u32, width, height| {
        Rgb::from_fn(width, height, |x, y| {
            image::Rgb([((x * 7 + y * 13 + seed * 5) % 31) as f32 / 31.0; 3])
        })
    };
    let images: Vec<Rgb> = [
        (1, 64, 48),
        (2, 64, 48),
        (3, 64, 48),
        (4, 7, 5),
        (5, 1, 1),
        (6, 300, 3),
    ]
    .map(|(seed, w, h)| image(seed, w, h))
    .to_vec();
    let pairs: Vec<(&Rgb, &Rgb)> = images.iter().map(|i| (i, i)).collect();
    let together = engine.disparity_batch(&pairs).unwrap();
    assert_eq!(together.len(), pairs.len());
    for ((left, right), together) in pairs.iter().zip(&together) {
        let alone = engine.disparity(left, right).unwrap();
        assert_eq!(alone.disparity.dimensions(), left.dimensions());
        for (a, b) in alone.disparity.iter().zip(together.disparity.iter()) {
            assert!((a - b).abs() < 1e-3);
        }
    }
    engine.warm_up(33, 17).unwrap();
    assert!(matches!(
        engine.warm_up(0, 5),
        Err(InferError::Sizes { .. })
    ));
    assert!(engine.disparity_batch(&[(&images[0], &images[3])]).is_err());
}

#[test]
fn what_a_fixed_model_says_is_judged_by_the_pair() {
    let model = Stereo::hitnet(false);
    let (_dir, path) = folder(&model);
    verdict(&path).unwrap().save(&path).unwrap();
    let mut engine = OnnxEngine::load(&runtime(), &path, 1).unwrap();
    for (width, height) in [(1, 1), (7, 5), (500, 20), (192, 128)] {
        let image = Rgb::from_fn(width, height, |x, y| {
            image::Rgb([((x ^ y) % 7) as f32 / 7.0; 3])
        });
        let map = engine.disparity(&image, &image).unwrap();
        assert_eq!(map.sigma.dimensions(), (width, height));
        assert!(map.confidence.iter().all(|c| (0.0..=1.0).contains(c)));
        assert!(map.sigma.iter().all(|s| (0.0..=8.0).contains(s)));
    }
    // Errors above a pixel are rarer where the confidence is high.
    let source = open("synth:scenes,seed=29,frames=1,clutter=0,width=192,height=128").unwrap();
    let frame = source.frame(0).unwrap();
    let truth = source.true_disparity(0).unwrap().unwrap();
    let map = engine.disparity(&frame.left, &frame.right).unwrap();
    let mut all: Vec<(f32, bool)> = (map.confidence.iter())
        .zip(map.disparity.iter().zip(truth.iter()))
        .map(|(c, (d, t))| (*c, (d - t).abs() > 1.0))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let wrong =
        |part: &[(f32, bool)]| part.iter().filter(|(_, w)| *w).count() as f32 / part.len() as f32;
    let (low, high) = all.split_at(all.len() / 2);
    println!(
        "wrong of the less confident half {}, of the other {}",
        wrong(low),
        wrong(high)
    );
    assert!(wrong(high) < 0.5 * wrong(low));
}

#[test]
fn our_own_exports_are_known_and_need_no_toml() {
    let model = Stereo {
        size: None,
        free_batch: true,
        own: true,
        output: "disparity",
        disparities: 40,
        ..Stereo::default()
    };
    let (_dir, path) = folder(&model);
    let mut engine = OnnxEngine::load(&runtime(), &path, 1).unwrap();
    assert_eq!(*engine.contract(), Contract::own());
    let flat = Rgb::from_pixel(40, 30, image::Rgb([0.5; 3]));
    let map = engine.disparity(&flat, &flat).unwrap();
    assert!(map.confidence.iter().all(|c| *c == 0.75) && map.sigma.iter().all(|s| *s == 0.5));
    assert_eq!(verdict(&path).unwrap().contract, Contract::own());
}

fn refused(model: &Stereo, words: &str) {
    let (_dir, path) = folder(model);
    let message = verdict(&path).unwrap_err().to_string();
    println!("{message}\n");
    assert!(
        message.contains(words) && message.contains("cure") && message.contains("x.onnx"),
        "{message}"
    );
    assert!(!Contract::path_beside(&path).exists());
}

#[test]
fn what_is_no_stereo_is_refused() {
    // Constant; without images; from one image; of the wrong inputs.
    refused(
        &Stereo {
            factor: 0.0,
            ..Stereo::default()
        },
        "not a stereo model",
    );
    refused(
        &Stereo {
            blind_of_right: true,
            ..Stereo::default()
        },
        "no output follows the disparity",
    );
    refused(
        &Stereo {
            names: vec!["a", "b", "c"],
            ..Stereo::default()
        },
        "served are",
    );
    // Sides that no image has.
    refused(
        &Stereo {
            size: Some([1 << 20, 1 << 20]),
            disparities: 1,
            ..Stereo::default()
        },
        "larger than any camera's",
    );
}

#[test]
fn damaged_files_are_refused_by_name() {
    let (dir, path) = folder(&Stereo::default());
    let runtime = runtime();
    let load = || {
        OnnxEngine::load(&runtime, &path, 0)
            .err()
            .unwrap()
            .to_string()
    };
    // Somebody else's names, and no x.toml.
    let (_other, foreign) = folder(&Stereo::hitnet(false));
    let message = OnnxEngine::load(&runtime, &foreign, 0)
        .err()
        .unwrap()
        .to_string();
    assert!(message.contains("barchan probe"), "{message}");

    let good = verdict(&path).unwrap();
    let toml = good.save(&path).unwrap();
    let text = std::fs::read_to_string(&toml).unwrap();
    for (from, to, field) in [
        ("factor = 1.0", "factor = 0.0", "factor"),
        ("factor = 1.0", "factor = \"one\"", "factor"),
        ("layout = \"nchw\"", "layout = \"chwn\"", "layout"),
        ("multiple = 1", "multiple = 0", "multiple"),
        ("width = 192", "width = 384", "axis 3"),
        ("name = \"left\"", "name = \"links\"", "left"),
        ("name = \"output\"", "name = \"result\"", "result"),
        ("std = [", "stdd = [", "std"),
        ("mean = [0.0, ", "mean = [", "mean"),
        ("shrink = 1", "shrink = 0", "shrink"),
    ] {
        assert!(text.contains(from), "{from} in {text}");
        std::fs::write(&toml, text.replacen(from, to, 1)).unwrap();
        let message = load();
        assert!(
            message.contains("x.toml") && message.contains(field) && message.contains("cure"),
            "{message}"
        );
    }
    for bytes in [&b""[..], b"\xff\xfe", b"[images"] {
        std::fs::write(&toml, bytes).unwrap();
        assert!(load().contains("x.toml"));
    }
    // What somebody else wrote is not replaced; what a probe wrote is.
    assert!(good.save(&path).is_err());
    std::fs::write(&toml, text.replace('\n', "\r\n")).unwrap();
    assert_eq!(Contract::load(&toml).unwrap(), good.contract);
    good.save(&path).unwrap();
    assert_eq!(std::fs::read_to_string(&toml).unwrap(), text);
    assert_eq!(
        dir.path().read_dir().unwrap().count(),
        2,
        "nothing else is left behind"
    );

    let whole = std::fs::read(&path).unwrap();
    for bytes in [
        &whole[..whole.len() / 2],
        b"",
        b"no onnx at all",
        &whole[whole.len() / 2..],
    ] {
        std::fs::write(&path, bytes).unwrap();
        assert!(load().contains("x.onnx"));
        assert!(verdict(&path).is_err());
    }
    let mut cycle = Stereo::default().model();
    let nodes = &mut cycle.graph.as_mut().unwrap().node;
    nodes[0].input[0] = nodes[2].output[0].clone();
    std::fs::write(&path, cycle.encode_to_vec()).unwrap();
    assert!(load().contains("cycle"));
    std::fs::remove_file(&path).unwrap();
    assert!(load().contains("no such file"));
}
