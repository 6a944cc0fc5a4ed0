//! What the builder writes is read back without loss.

use barchan_onnx::proto::{Attribute, Model, Tensor, ValueInfo};
use barchan_onnx::{GraphBuilder, Message};

fn network() -> Model {
    let mut graph = GraphBuilder::default();
    let weight = graph.floats(
        "layer.weight",
        &[2, 3, 1, 1],
        [0.0, -0.0, 1.5, -2.0, 1e-40, 3.0],
    );
    let x = graph.node(
        "layer",
        "Conv",
        &["left", &weight],
        vec![
            Attribute::ints("kernel_shape", &[1, 1]),
            Attribute::int("group", 0),
        ],
    );
    let limit = graph.scalar(0.0);
    let x = graph.plain("Max", &[&x, &limit], vec![]);
    let shape = graph.ints(&[0, -1, i64::MAX]);
    let x = graph.plain(
        "Reshape",
        &[&x, &shape],
        vec![Attribute::float("nothing", 0.0)],
    );
    let x = graph.plain(
        "Pad",
        &[&x, "", &x],
        vec![Attribute::string("mode", "edge")],
    );
    let input = ValueInfo::float("left", ["batch", "3", "height", "width"]);
    let output = [
        ValueInfo::float(&x, ["batch", "0", "1", "-1"]),
        ValueInfo::float_of_any_shape("more"),
    ];
    let metadata = [
        ("key".to_owned(), "Wert mit ü".to_owned()),
        (String::new(), String::new()),
    ];
    graph.finish("net", vec![input], output.into(), "doc", metadata)
}

#[test]
fn decoding_gives_the_same_messages_and_encoding_again_the_same_bytes() {
    let model = network();
    let bytes = model.encode_to_vec();
    let read = Model::decode(bytes.as_slice()).unwrap();
    assert_eq!(read, model);
    assert_eq!(read.encode_to_vec(), bytes);
}

#[test]
fn a_cut_file_is_an_error_or_another_model() {
    let bytes = network().encode_to_vec();
    for length in 0..bytes.len() {
        if let Ok(model) = Model::decode(&bytes[..length]) {
            assert_ne!(model, network(), "cut at {length}");
        }
    }
}

#[test]
fn float_tensors_give_their_values_and_others_none() {
    let values = [1.0, -0.0, f32::MIN_POSITIVE, 4.0, 5.0, 6.0];
    let tensor = Tensor::floats("t", &[2, 3], values);
    assert_eq!(tensor.to_floats().unwrap(), values);
    assert_eq!(Tensor::floats("t", &[], [7.0]).to_floats().unwrap(), [7.0]);
    let lying = |dims: &[i64]| Tensor {
        dims: dims.to_vec(),
        ..tensor.clone()
    };
    for dims in [&[2, 2][..], &[-2, -3], &[i64::MAX, i64::MAX], &[7]] {
        assert_eq!(lying(dims).to_floats(), None, "{dims:?}");
    }
    assert_eq!(Tensor::ints("t", &[1]).to_floats(), None);
    assert_eq!(Tensor::int8s("t", &[4], [0; 4]).to_floats(), None);
}

#[test]
fn whole_numbers_are_stored_in_little_endian_two_s_complement() {
    assert_eq!(
        Tensor::int8s("t", &[3], [-128, -1, 127]).raw_data,
        [128, 255, 127]
    );
    assert_eq!(Tensor::uint8s("t", &[2], [0, 255]).raw_data, [0, 255]);
    assert_eq!(
        Tensor::int32s("t", &[2], [-2, 258]).raw_data,
        [254, 255, 255, 255, 2, 1, 0, 0]
    );
}
