//! Every way of feeding a model that the names and shapes of its inputs allow.

use crate::onnxruntime::{
    Channels, Contract, ImageFormat, InputFormat, Layout, MOST_AREA, MOST_SIDE, ModelSize,
    OutputFormat, OutputLayout, Side, Unit,
};

/// One way of feeding a model.
#[derive(Clone)]
pub(super) struct Hypothesis {
    /// Its output is a placeholder until the model has run.
    pub contract: Contract,
    /// What is supposed of each of the [`QUESTIONS`], in words.
    pub answers: [String; 4],
}

/// What hypotheses differ in.
pub(super) const QUESTIONS: [&str; 4] = ["images", "values", "channels", "axes"];

/// How 0 to 1 is presented to models, the commonest first: name, and mean and standard deviation of
/// red, green, blue and of grey. ImageNet's are those of torchvision.
const VALUES: [(&str, [f64; 4], [f64; 4]); 4] = [
    ("0 to 1", [0.0; 4], [1.0; 4]),
    ("0 to 255", [0.0; 4], [1.0 / 255.0; 4]),
    (
        "ImageNet mean and deviation",
        [0.485, 0.456, 0.406, 0.449],
        [0.229, 0.224, 0.225, 0.226],
    ),
    ("-1 to 1", [0.5; 4], [0.5; 4]),
];

/// All ways of feeding a model with these inputs (name and dimensions, -1 for a free one), the most
/// usual first.
///
/// # Errors
/// When the inputs are not those of any stereo model that is known.
pub(super) fn hypotheses(inputs: &[(String, [i64; 4])]) -> Result<Vec<Hypothesis>, String> {
    let shapes: Vec<String> = (inputs.iter())
        .map(|(name, dims)| format!("{name} {dims:?}"))
        .collect();
    let refuse = |what: &str| {
        format!(
            "{what}; its inputs are {}\n  served are: one input of 6 channels (both colour images) or 2 (both grey), two of 3 or 1, and four of 3 or 1 (both images at half and at full size), with one pair to a run or a free batch\n  cure: export the model with such inputs",
            shapes.join(", ")
        )
    };
    if ![1, 2, 4].contains(&inputs.len()) {
        return Err(refuse("not a stereo model that is known"));
    }
    if inputs.iter().any(|(_, dims)| dims[0] != 1 && dims[0] != -1) {
        return Err(refuse("takes several pairs at once"));
    }
    let stacked = if inputs.len() == 1 { 2 } else { 1 };
    let mut found = Vec::new();
    for (layout, axis, rows, columns) in [(Layout::Nchw, 1, 2, 3), (Layout::Nhwc, 3, 1, 2)] {
        for count in [3, 1] {
            let free_or = |dim: i64, wanted: usize| dim == -1 || dim == wanted as i64;
            if !inputs
                .iter()
                .all(|(_, d)| free_or(d[axis], count * stacked))
            {
                continue;
            }
            let sizes: Vec<[i64; 2]> = inputs.iter().map(|(_, d)| [d[columns], d[rows]]).collect();
            for shrinks in shrinks(inputs, &sizes) {
                let Some([width, height]) = full_size(&sizes, &shrinks) else {
                    continue;
                };
                for (order, input) in orders(inputs, &shrinks) {
                    for (name, mean, std) in VALUES {
                        let kinds: &[_] = match count {
                            3 => &[(Channels::Rgb, "RGB"), (Channels::Bgr, "BGR")],
                            _ => &[(Channels::Grey, "grey")],
                        };
                        for (channels, channels_name) in kinds {
                            let of = |values: [f64; 4]| match channels {
                                Channels::Rgb => values[..3].to_vec(),
                                Channels::Bgr => values[..3].iter().rev().copied().collect(),
                                Channels::Grey => vec![values[3]],
                            };
                            found.push(Hypothesis {
                                contract: contract(
                                    ImageFormat {
                                        layout,
                                        channels: *channels,
                                        mean: of(mean),
                                        std: of(std),
                                    },
                                    [width, height],
                                    &input,
                                ),
                                answers: [
                                    order.clone(),
                                    name.into(),
                                    (*channels_name).into(),
                                    match layout {
                                        Layout::Nchw => "channels before rows (NCHW)".into(),
                                        Layout::Nhwc => "channels last (NHWC)".into(),
                                    },
                                ],
                            });
                        }
                    }
                }
            }
        }
    }
    let Some(first) = found.first() else {
        return Err(refuse("no pair of images"));
    };
    let size = &first.contract.size;
    let (width, height) = (size.width.unwrap_or(1), size.height.unwrap_or(1));
    if width.max(height) > MOST_SIDE || width * height > MOST_AREA {
        return Err(refuse("wants images larger than any camera's"));
    }
    Ok(found)
}

fn contract(
    images: ImageFormat,
    [width, height]: [Option<usize>; 2],
    input: &[InputFormat],
) -> Contract {
    Contract {
        images,
        size: ModelSize {
            width,
            height,
            multiple: 1,
            at_least: 1,
            batch: false,
        },
        output: OutputFormat {
            name: String::new(),
            layout: OutputLayout::Nchw,
            channel: 0,
            unit: Unit::Pixels,
            factor: 1.0,
            sigma: None,
            confidence: None,
        },
        input: input.to_vec(),
    }
}

/// Which inputs take images of half the size: none, or two of four, told by their sizes, else by
/// their names, else either two.
fn shrinks(inputs: &[(String, [i64; 4])], sizes: &[[i64; 2]]) -> Vec<Vec<usize>> {
    if inputs.len() < 4 {
        return vec![vec![1; inputs.len()]];
    }
    let largest = sizes.iter().map(|s| s[0]).max().unwrap_or(0);
    let by_size: Vec<usize> = (sizes.iter())
        .map(|s| {
            if s[0] > 0 && 2 * s[0] == largest {
                2
            } else {
                1
            }
        })
        .collect();
    let by_name: Vec<usize> = (inputs.iter())
        .map(|(name, _)| {
            let name = name.to_lowercase();
            let small = ["init", "half", "low", "small"]
                .iter()
                .any(|w| name.contains(w));
            if small { 2 } else { 1 }
        })
        .collect();
    let two = |shrinks: &Vec<usize>| shrinks.iter().filter(|s| **s == 2).count() == 2;
    match [by_size, by_name].into_iter().find(two) {
        Some(known) => vec![known],
        None => vec![vec![2, 2, 1, 1], vec![1, 1, 2, 2]],
    }
}

/// The fixed width and height that all inputs agree on, each `None` where free.
fn full_size(sizes: &[[i64; 2]], shrinks: &[usize]) -> Option<[Option<usize>; 2]> {
    let mut full = [None, None];
    for (size, shrink) in sizes.iter().zip(shrinks) {
        for axis in 0..2 {
            if size[axis] == -1 {
                continue;
            }
            let side = usize::try_from(size[axis]).ok()?.checked_mul(*shrink)?;
            // A side of a few pixels is some other axis.
            if side < 8 * shrink || full[axis].is_some_and(|known| known != side) {
                return None;
            }
            full[axis] = Some(side);
        }
    }
    Some(full)
}

/// Which image goes where, in words and as inputs: as the names say, else left first, and the reverse.
fn orders(inputs: &[(String, [i64; 4])], shrinks: &[usize]) -> Vec<(String, Vec<InputFormat>)> {
    use Side::{Left, Right};
    let fill = |sides: &[Vec<Side>]| -> Vec<InputFormat> {
        (inputs.iter().zip(sides).zip(shrinks))
            .map(|(((name, _), images), shrink)| InputFormat {
                name: name.clone(),
                images: images.clone(),
                shrink: *shrink,
            })
            .collect()
    };
    if inputs.len() == 1 {
        return vec![
            ("left, then right".into(), fill(&[vec![Left, Right]])),
            ("right, then left".into(), fill(&[vec![Right, Left]])),
        ];
    }
    // The first input of each size is the left one, unless the names say otherwise.
    let sides: Vec<Side> = (0..inputs.len())
        .map(|k| {
            let name = inputs[k].0.to_lowercase();
            match (name.contains("left"), name.contains("right")) {
                (true, false) => Left,
                (false, true) => Right,
                _ if shrinks[..k].contains(&shrinks[k]) => Right,
                _ => Left,
            }
        })
        .collect();
    let swapped = |side: &Side| if *side == Left { Right } else { Left };
    [sides.clone(), sides.iter().map(swapped).collect()]
        .into_iter()
        .map(|sides: Vec<Side>| {
            let words: Vec<String> = (inputs.iter().zip(&sides))
                .map(|((name, _), side)| {
                    format!("{} in {name}", if *side == Left { "left" } else { "right" })
                })
                .collect();
            let lists: Vec<Vec<Side>> = sides.iter().map(|side| vec![*side]).collect();
            (words.join(", "), fill(&lists))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(inputs: &[(&str, [i64; 4])]) -> Result<usize, String> {
        let inputs: Vec<_> = inputs.iter().map(|(n, d)| ((*n).to_owned(), *d)).collect();
        hypotheses(&inputs).map(|found| found.len())
    }

    #[test]
    fn shapes_prune_what_is_tried() {
        // Orders times values times channels.
        assert_eq!(count(&[("input", [1, 6, 240, 320])]), Ok(16));
        assert_eq!(count(&[("input", [1, 2, 240, 320])]), Ok(8));
        assert_eq!(count(&[("input", [1, 240, 320, 6])]), Ok(16));
        assert_eq!(
            count(&[("a", [1, 3, -1, -1]), ("b", [1, 3, -1, -1])]),
            Ok(16)
        );
        // Nothing is known: both layouts, colour and grey.
        assert_eq!(count(&[("a", [-1; 4]), ("b", [-1; 4])]), Ok(48));
        let half = [1, 3, 120, 160];
        let full = [1, 3, 240, 320];
        let four = [
            ("init_left", half),
            ("init_right", half),
            ("next_left", full),
            ("next_right", full),
        ];
        assert_eq!(count(&four), Ok(16));
        assert_eq!(count(&four.map(|(name, _)| (name, [1, 3, -1, -1]))), Ok(16));
        assert_eq!(
            count(&["a", "b", "c", "d"].map(|n| (n, [1, 3, -1, -1]))),
            Ok(32)
        );
    }

    #[test]
    fn names_say_which_is_left() {
        let dims = [1, 3, -1, -1];
        let inputs = [("right".to_owned(), dims), ("left".to_owned(), dims)];
        let first = &hypotheses(&inputs).unwrap()[0].contract;
        assert_eq!(first.input[0].images, [Side::Right]);
        assert_eq!(first.input[1].images, [Side::Left]);
    }

    #[test]
    fn what_is_no_pair_is_refused_with_a_cure() {
        for inputs in [
            vec![("x", [1, 3, 224, 224])],
            vec![("x", [1, 6, 1 << 40, 320])],
            vec![("x", [2, 6, 240, 320])],
            vec![("a", [1, 3, 240, 320]), ("b", [1, 3, 120, 160])],
            vec![("a", [1, 3, 8, 8]); 3],
        ] {
            let message = count(&inputs).unwrap_err();
            assert!(message.contains("cure"), "{message}");
        }
    }
}
