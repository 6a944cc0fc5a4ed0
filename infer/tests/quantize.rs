//! Int8 networks stay within the bounds that their steps set, and keep the shape of the float one.
#![cfg(feature = "onnxruntime")]

use std::collections::HashSet;

use barchan_datasets::{DataError, Rgb, StereoFrame};
use barchan_infer::{
    DisparityEngine, DisparityMap, OnnxEngine, QuantizeError, QuantizeOptions, Quantized, Runtime,
    quantize,
};
use barchan_onnx::proto::{Attribute, Graph, Model, Tensor, ValueInfo};
use barchan_onnx::{GraphBuilder, Message};

const C: usize = 32;

/// Weights that look learned: no two alike, channels of different size.
fn wave(count: usize, seed: f32) -> Vec<f32> {
    (0..count)
        .map(|i| (i as f32 * 1.7 + seed).sin() * (0.05 + 0.01 * (i / C) as f32))
        .collect()
}

fn spread() -> Vec<f32> {
    wave(3 * C, 0.3).iter().map(|w| 5.0 * w).collect()
}

fn bias() -> Vec<f32> {
    wave(C, 2.0)
}

/// `features = relu(spread x)`, too small for int8; `layer = relu(W features + b)`, the same for both
/// images; outputs: sums over the channels of the left layer, of the right layer, and of a 3x3 layer
/// on the left layer.
fn network(weights: &[f32]) -> Model {
    let mut graph = GraphBuilder::default();
    let mut sums = vec![];
    let mut look = |graph: &mut GraphBuilder, image: &str| {
        let shape = || vec![Attribute::ints("kernel_shape", &[1, 1])];
        let spread = graph.shared("spread.weight", &[C, 3, 1, 1], spread);
        let x = graph.node("spread", "Conv", &[image, &spread], shape());
        let x = graph.plain("Relu", &[&x], vec![]);
        let weight = graph.shared("layer.weight", &[C, C, 1, 1], || weights.to_vec());
        let bias = graph.shared("layer.bias", &[C], bias);
        let x = graph.node("layer", "Conv", &[&x, &weight, &bias], shape());
        let x = graph.plain("Relu", &[&x], vec![]);
        let ones = graph.shared("sum.kernel", &[1, C, 1, 1], || vec![1.0; C]);
        sums.push(graph.node("sum", "Conv", &[&x, &ones], shape()));
        x
    };
    let left = look(&mut graph, "left");
    look(&mut graph, "right");
    let weight = graph.floats("deep.weight", &[C, C, 3, 3], wave(9 * C * C, 1.0));
    let attributes = vec![
        Attribute::ints("kernel_shape", &[3, 3]),
        Attribute::ints("pads", &[1, 1, 1, 1]),
    ];
    let deep = graph.node("deep", "Conv", &[&left, &weight], attributes);
    let ones = graph.shared("sum.kernel", &[1, C, 1, 1], || vec![1.0; C]);
    sums.push(graph.node("sum", "Conv", &[&deep, &ones], vec![]));
    let outputs = ["disparity", "sigma", "confidence"];
    for (name, value) in outputs.iter().zip(&sums) {
        graph.node(name, "Identity", &[value], vec![]);
    }
    let image = |name: &str| ValueInfo::float(name, ["batch", "3", "height", "width"]);
    let map = |name: &&str| ValueInfo::float(name, ["batch", "1", "height", "width"]);
    graph.finish(
        "test",
        vec![image("left"), image("right")],
        outputs.iter().map(map).collect(),
        "",
        [("max_disparity".to_owned(), "96".to_owned())],
    )
}

fn runtime() -> Runtime {
    match Runtime::load(None) {
        Ok(runtime) => runtime,
        Err(error) => panic!("`make test` installs ONNX Runtime first: {error}"),
    }
}

fn image(width: u32, height: u32, seed: f32) -> Rgb {
    Rgb::from_fn(width, height, |x, y| {
        let v = |k: f32| 0.5 + 0.5 * (0.9 * x as f32 + k * y as f32 + seed).sin();
        image::Rgb([v(0.3), v(1.1), v(2.3)])
    })
}

fn pair(left: Rgb, right: Rgb) -> Result<StereoFrame, DataError> {
    Ok(StereoFrame {
        index: 0,
        name: "pair".into(),
        time: 0.0,
        left,
        right,
    })
}

/// Nothing is clipped, so that errors are those of the steps.
fn exact() -> QuantizeOptions {
    QuantizeOptions {
        percentile: 100.0,
        ..QuantizeOptions::default()
    }
}

fn quantized(weights: &[f32], left: &Rgb, right: &Rgb) -> (Quantized, Graph) {
    let pairs = [pair(left.clone(), right.clone())];
    let result = quantize(
        &network(weights).encode_to_vec(),
        &runtime(),
        pairs,
        &exact(),
    )
    .unwrap();
    let model = Model::decode(result.onnx.as_slice()).unwrap();
    (result, model.graph.unwrap())
}

fn run(onnx: &[u8], left: &Rgb, right: &Rgb) -> DisparityMap {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("net.onnx");
    std::fs::write(&path, onnx).unwrap();
    let mut engine = OnnxEngine::load(&runtime(), &path, 1).unwrap();
    engine.disparity(left, right).unwrap()
}

fn constant<'a>(graph: &'a Graph, name: &str) -> &'a Tensor {
    (graph.initializer.iter())
        .find(|t| t.name == name)
        .unwrap_or_else(|| panic!("no {name}"))
}

/// Scale of the activation that the convolution `name` reads, and of the one behind it.
fn steps(graph: &Graph, name: &str) -> [f64; 2] {
    let node = |pick: &dyn Fn(&&barchan_onnx::proto::Node) -> bool| {
        graph.node.iter().find(|n| pick(n)).unwrap()
    };
    let conv = node(&|n| n.name == name);
    let before = node(&|n| n.output[0] == conv.input[0]);
    let relu = node(&|n| n.input[0] == conv.output[0]);
    let after = node(&|n| n.op_type == "QuantizeLinear" && n.input[0] == relu.output[0]);
    [before, after].map(|n| constant(graph, &n.input[1]).to_floats().unwrap()[0].into())
}

#[test]
fn outputs_stay_within_the_bound_of_the_steps() {
    let weights = wave(C * C, 0.0);
    let (left, right) = (image(23, 17, 0.0), image(23, 17, 4.0));
    let (result, graph) = quantized(&weights, &left, &right);
    assert_eq!(result.int8, ["layer", "layer.2", "deep"]);
    let scales = constant(&graph, "layer.weight.scale").to_floats().unwrap();
    let [input, output] = steps(&graph, "layer");

    let map = run(&result.onnx, &left, &right);
    let (spread, bias) = (spread(), bias());
    for (image, found) in [(&left, &map.disparity), (&right, &map.sigma)] {
        let mut worst = 0.0f64;
        for (pixel, found) in image.pixels().zip(found.as_raw()) {
            let features: Vec<f64> = (0..C)
                .map(|c| {
                    (0..3)
                        .map(|k| f64::from(spread[3 * c + k] * pixel[k]))
                        .sum::<f64>()
                })
                .map(|v| v.max(0.0))
                .collect();
            let (mut sum, mut bound) = (0.0, 1e-4);
            for (o, scale) in scales.iter().map(|s| f64::from(*s)).enumerate() {
                let mut y = f64::from(bias[o]);
                // Bias and output are off by half a step each.
                bound += 0.5 * scale * input + 0.5 * output;
                for (x, w) in features.iter().zip(&weights[C * o..]) {
                    y += f64::from(*w) * x;
                    // |w x - w' x'| <= |w| |x - x'| + |x'| |w - w'|, each half a step off.
                    bound += 0.5 * (f64::from(w.abs()) * input + (x + 0.5 * input) * scale);
                }
                sum += y.max(0.0);
            }
            let error = (sum - f64::from(*found)).abs();
            assert!(error <= bound, "{error} > {bound}");
            worst = worst.max(error);
        }
        assert!(worst > 0.0, "nothing was rounded");
    }

    // The network beyond the bounded layer, too, and at a size that calibration never saw.
    let (left, right) = (image(40, 9, 1.0), image(40, 9, 5.0));
    let float = run(&network(&weights).encode_to_vec(), &left, &right);
    let int8 = run(&result.onnx, &left, &right);
    let power: f32 = float.confidence.iter().map(|v| v * v).sum();
    let noise: f32 = (float.confidence.iter().zip(int8.confidence.iter()))
        .map(|(a, b)| (a - b).powi(2))
        .sum();
    assert!(noise < 1e-2 * power, "{noise} {power}");
}

#[test]
fn a_layer_that_both_images_pass_is_written_once_with_a_scale_per_channel() {
    let weights = wave(C * C, 0.0);
    let (result, graph) = quantized(&weights, &image(16, 9, 0.0), &image(16, 9, 4.0));
    let convs: Vec<_> = (graph.node.iter())
        .filter(|n| n.name.starts_with("layer") && n.op_type == "Conv")
        .collect();
    assert_eq!(convs.len(), 2);
    assert_eq!(convs[0].input[1..], convs[1].input[1..]);
    assert_eq!(steps(&graph, "layer"), steps(&graph, "layer.2"));
    let int8 = graph
        .initializer
        .iter()
        .filter(|t| t.name.contains("layer.weight.int8"));
    assert_eq!(int8.count(), 1);

    let levels = constant(&graph, "layer.weight.int8");
    let scales = constant(&graph, "layer.weight.scale").to_floats().unwrap();
    assert_eq!((scales.len(), &levels.dims[..]), (C, &[32, 32, 1, 1][..]));
    for (i, (w, q)) in weights.iter().zip(&levels.raw_data).enumerate() {
        let step = scales[i / C];
        assert!((w - step * f32::from(q.cast_signed())).abs() <= 0.5001 * step);
    }
    // The float weights are gone, and what stays float has its own.
    assert!(!graph.initializer.iter().any(|t| t.name == "layer.weight"));
    assert_eq!(
        constant(&graph, "spread.weight").to_floats().unwrap(),
        spread()
    );
    assert!(result.onnx.len() < network(&weights).encoded_len());
}

#[test]
fn the_graph_is_in_order_with_unique_names_and_says_what_it_is() {
    let (result, graph) = quantized(&wave(C * C, 0.0), &image(16, 9, 0.0), &image(16, 9, 4.0));
    let mut known: HashSet<&str> = HashSet::from([""]);
    for name in
        (graph.input.iter().map(|v| &v.name)).chain(graph.initializer.iter().map(|t| &t.name))
    {
        assert!(known.insert(name), "{name} twice");
    }
    for node in &graph.node {
        for input in &node.input {
            assert!(known.contains(input.as_str()), "{input} before it is made");
        }
        for output in &node.output {
            assert!(known.insert(output), "{output} twice");
        }
    }
    let names: HashSet<_> = graph.node.iter().map(|n| &n.name).collect();
    assert_eq!(names.len(), graph.node.len());
    let float = network(&wave(C * C, 0.0)).graph.unwrap();
    assert_eq!((&graph.input, &graph.output), (&float.input, &float.output));
    let model = Model::decode(result.onnx.as_slice()).unwrap();
    let said: Vec<_> = model
        .metadata_props
        .iter()
        .map(|e| [&e.key[..], &e.value])
        .collect();
    assert_eq!(
        said,
        [
            ["max_disparity", "96"],
            ["quantization", "int8 QDQ, 1 calibration pairs"]
        ]
    );
}

#[test]
fn black_calibration_images_give_finite_outputs() {
    let black = Rgb::new(16, 9);
    let (result, graph) = quantized(&wave(C * C, 0.0), &black, &black);
    assert_eq!(steps(&graph, "layer")[0], 1.0);
    let map = run(&result.onnx, &black, &black);
    let expected: f32 = bias().iter().map(|b| b.max(0.0)).sum();
    for d in map.disparity.iter() {
        // The bias in steps of the weights, the output in steps of its own.
        assert!((d - expected).abs() < 0.05 * expected, "{d} {expected}");
    }
    let bright = run(&result.onnx, &image(16, 9, 0.0), &black);
    assert!(
        bright
            .disparity
            .iter()
            .chain(bright.confidence.iter())
            .all(|v| v.is_finite())
    );
}

#[test]
fn named_convolutions_stay_float() {
    let frame = || pair(image(16, 9, 0.0), image(16, 9, 4.0));
    let options = QuantizeOptions {
        keep_float: vec!["deep".into()],
        ..exact()
    };
    let model = network(&wave(C * C, 0.0)).encode_to_vec();
    let result = quantize(&model, &runtime(), [frame()], &options).unwrap();
    assert_eq!(result.int8, ["layer", "layer.2"]);
    let options = QuantizeOptions {
        keep_float: ["layer", "layer.2", "deep"].map(str::to_owned).into(),
        ..exact()
    };
    let error = quantize(&model, &runtime(), [frame()], &options).unwrap_err();
    assert!(error.to_string().contains("stays float"), "{error}");
}

#[test]
fn what_cannot_be_quantised_is_refused_with_the_reason() {
    let runtime = runtime();
    let frame = || [pair(image(16, 9, 0.0), image(16, 9, 4.0))];
    let refuse = |model: &[u8]| {
        quantize(model, &runtime, frame(), &exact())
            .unwrap_err()
            .to_string()
    };
    let weights = wave(C * C, 0.0);
    let model = network(&weights);
    let bytes = model.encode_to_vec();

    let (twice, _) = quantized(&weights, &image(16, 9, 0.0), &image(16, 9, 4.0));
    assert!(refuse(&twice.onnx).contains("already quantised"));
    assert!(matches!(
        quantize(&bytes, &runtime, [], &exact()),
        Err(QuantizeError::NoPairs)
    ));
    assert!(refuse(b"\xffnothing").contains("not an ONNX file"));
    assert!(refuse(b"").contains("cure"));
    // Field 5, the model's version, is none that is kept.
    assert!(refuse(&[&bytes[..], b"\x28\x01"].concat()).contains("another program"));
    let mut broken = weights.clone();
    broken[7] = f32::NAN;
    assert!(refuse(&network(&broken).encode_to_vec()).contains("not finite"));
    let mut old = model.clone();
    old.opset_import[0].version = 11;
    assert!(refuse(&old.encode_to_vec()).contains("older than 13"));
    let mut short = model.clone();
    short
        .graph
        .as_mut()
        .unwrap()
        .initializer
        .iter_mut()
        .for_each(|t| t.dims.push(2));
    assert!(refuse(&short.encode_to_vec()).contains("no float tensor"));
    for length in 0..bytes.len().min(3000) {
        refuse(&bytes[..length]);
    }

    let nan = Rgb::from_pixel(16, 9, image::Rgb([f32::NAN; 3]));
    let pairs = [pair(nan.clone(), nan)];
    let error = quantize(&bytes, &runtime, pairs, &exact()).unwrap_err();
    assert!(matches!(error, QuantizeError::NotFinite { .. }), "{error}");
    let pairs = [pair(image(16, 9, 0.0), image(15, 9, 0.0))];
    let error = quantize(&bytes, &runtime, pairs, &exact()).unwrap_err();
    assert!(error.to_string().contains("one size"), "{error}");
}
