use std::path::Path;

use barchan_geometry::nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use barchan_geometry::{Camera, Distortion, Se3};
use saphyr_parser::{Event, Parser};

use crate::DataError;

/// A calibration file as nested names, lists and words, whether it was YAML or XML.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Node {
    Word(String),
    List(Vec<Node>),
    Map(Vec<(String, Node)>),
}

/// No calibration file is larger or nested deeper.
const MAX_BYTES: u64 = 1 << 20;
const MAX_DEPTH: usize = 16;

/// Reads a text file that should be small.
pub(crate) fn read_text(path: &Path) -> Result<String, DataError> {
    let size = std::fs::metadata(path).map_err(DataError::io(path))?.len();
    if size > MAX_BYTES {
        let message = format!("{size} bytes: too large for a calibration file");
        return Err(DataError::file(path, message));
    }
    std::fs::read_to_string(path).map_err(DataError::io(path))
}

/// Reads a YAML or XML file; a tree is told from its first sign.
pub(crate) fn read_tree(path: &Path) -> Result<Node, DataError> {
    let text = read_text(path)?;
    let root = if text
        .trim_start_matches('\u{feff}')
        .trim_start()
        .starts_with('<')
    {
        parse_xml(&text)
    } else {
        parse_yaml(&text)
    };
    match root {
        Ok(root @ Node::Map(_)) => Ok(root),
        Ok(_) => Err(DataError::file(
            path,
            "holds no names with values; expected a calibration in YAML or XML",
        )),
        Err(message) => Err(DataError::file(path, message)),
    }
}

/// The first document of a YAML text. References are refused: they let a small file stand for a
/// huge one, and no calibration has them. Tags (`!!opencv-matrix`) are passed over.
fn parse_yaml(text: &str) -> Result<Node, String> {
    // OpenCV's header `%YAML:1.0` is not the directive `%YAML 1.0`.
    let text = text.trim_start_matches('\u{feff}');
    let text = match text.strip_prefix("%YAML:") {
        Some(rest) => rest.split_once('\n').map_or("", |(_, rest)| rest),
        None => text,
    };
    // What is open, from the outside in; a map waits for the value of its last name.
    let mut open: Vec<(Node, Option<String>)> = Vec::new();
    for event in Parser::new_from_str(text) {
        let (event, span) = event.map_err(|e| format!("not YAML: {e}"))?;
        let done = match event {
            Event::MappingStart(..) | Event::SequenceStart(..) => {
                if open.len() == MAX_DEPTH {
                    return Err(format!("nested deeper than {MAX_DEPTH}: not a calibration"));
                }
                let node = match event {
                    Event::MappingStart(..) => Node::Map(Vec::new()),
                    _ => Node::List(Vec::new()),
                };
                open.push((node, None));
                continue;
            }
            Event::Scalar(word, ..) => Node::Word(word.into_owned()),
            Event::MappingEnd | Event::SequenceEnd => match open.pop() {
                Some((node, _)) => node,
                None => continue,
            },
            Event::Alias(_) => {
                return Err(format!(
                    "line {}: a reference (*name): write the value itself",
                    span.start.line()
                ));
            }
            Event::DocumentEnd => break,
            _ => continue,
        };
        match open.last_mut() {
            None => return Ok(done),
            Some((Node::List(items), _)) => items.push(done),
            Some((Node::Map(items), name)) => match (name.take(), done) {
                (Some(name), value) => items.push((name, value)),
                (None, Node::Word(word)) => *name = Some(word),
                (None, _) => {
                    return Err(format!("line {}: a name is expected", span.start.line()));
                }
            },
            // Words are never opened.
            Some((Node::Word(_), _)) => {}
        }
    }
    Err("empty".into())
}

/// The elements of an XML text under its root. An element without elements is a word.
fn parse_xml(text: &str) -> Result<Node, String> {
    let document = roxmltree::Document::parse(text).map_err(|e| format!("not XML: {e}"))?;
    fn node(element: roxmltree::Node<'_, '_>, depth: usize) -> Result<Node, String> {
        if depth == MAX_DEPTH {
            return Err(format!("nested deeper than {MAX_DEPTH}: not a calibration"));
        }
        let children = element.children().filter(|c| c.is_element());
        let named: Vec<(String, Node)> = children
            .map(|c| Ok((c.tag_name().name().to_owned(), node(c, depth + 1)?)))
            .collect::<Result<_, String>>()?;
        Ok(if named.is_empty() {
            Node::Word(element.text().unwrap_or_default().trim().to_owned())
        } else if named.iter().all(|(name, _)| name == "_") {
            // How OpenCV writes lists.
            Node::List(named.into_iter().map(|(_, item)| item).collect())
        } else {
            Node::Map(named)
        })
    }
    node(document.root_element(), 0)
}

impl Node {
    /// The value of the first of some names that a map has. Case, `_`, `-`, `.` and spaces do not count.
    pub fn get(&self, names: &[&str]) -> Option<&Node> {
        let Node::Map(items) = self else { return None };
        let plain = |name: &str| name.replace(['_', '-', '.', ' '], "").to_lowercase();
        names.iter().find_map(|name| {
            let found = items.iter().find(|(key, _)| plain(key) == plain(name));
            found.map(|(_, value)| value)
        })
    }

    /// The words of a list, of lists in a list, of a matrix with `data`, or of one text.
    fn words(&self) -> Vec<&str> {
        match self {
            Node::Word(word) => word.split_whitespace().collect(),
            Node::List(items) => items.iter().flat_map(Node::words).collect(),
            Node::Map(_) => self.get(&["data"]).map(Node::words).unwrap_or_default(),
        }
    }

    /// What [`Node::words`] are when all of them are finite numbers.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        let number = |w: &str| w.parse().ok().filter(|v: &f64| v.is_finite());
        self.words().into_iter().map(number).collect()
    }
}

/// A calibration file and what it holds: how importers ask for values, with errors that name the
/// file and the value.
pub(crate) struct Values<'a> {
    pub path: &'a Path,
    pub root: &'a Node,
}

impl Values<'_> {
    /// Whether there is a value of one of these names.
    pub fn has(&self, names: &[&str]) -> bool {
        self.root.get(names).is_some()
    }

    /// `counts` numbers of the first name found; `None` where there is none of the names.
    pub fn try_numbers(
        &self,
        names: &[&str],
        counts: &[usize],
    ) -> Result<Option<Vec<f64>>, DataError> {
        let Some(node) = self.root.get(names) else {
            return Ok(None);
        };
        let found = node.numbers();
        match found.filter(|n| counts.contains(&n.len())) {
            Some(numbers) => Ok(Some(numbers)),
            None => {
                let counts: Vec<String> = counts.iter().map(usize::to_string).collect();
                let words = node.words().join(" ");
                let message = format!(
                    "{} is \"{words:.80}\", expected {} finite numbers",
                    names[0],
                    counts.join(" or ")
                );
                Err(DataError::file(self.path, message))
            }
        }
    }

    /// The same, of a value that must be there.
    pub fn numbers(&self, names: &[&str], counts: &[usize]) -> Result<Vec<f64>, DataError> {
        self.try_numbers(names, counts)?.ok_or_else(|| {
            let message = format!("has no {}; looked for {}", names[0], names.join(", "));
            DataError::file(self.path, message)
        })
    }

    /// A matrix of three rows and `columns` columns, row by row.
    pub fn matrix(&self, names: &[&str]) -> Result<Matrix3<f64>, DataError> {
        Ok(Matrix3::from_row_slice(&self.numbers(names, &[9])?))
    }

    /// A rotation.
    pub fn rotation(&self, names: &[&str]) -> Result<UnitQuaternion<f64>, DataError> {
        let matrix = self.matrix(names)?;
        rotation(&matrix).ok_or_else(|| {
            let message = format!("{} is no rotation: {:?}", names[0], matrix.as_slice());
            DataError::file(self.path, message)
        })
    }

    /// `fx fy cx cy` of a camera matrix.
    pub fn intrinsics(&self, names: &[&str]) -> Result<Camera, DataError> {
        let k = self.matrix(names)?;
        Ok(Camera::pinhole(k.m11, k.m22, k.m13, k.m23))
    }

    /// A lens from OpenCV's coefficients, `k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 .. s4 [tx ty]]]]`, or four of
    /// a fisheye.
    pub fn lens(&self, names: &[&str], fisheye: bool) -> Result<Distortion, DataError> {
        let counts: &[usize] = if fisheye { &[4] } else { &[0, 4, 5, 8, 12, 14] };
        let k = self.numbers(names, counts)?;
        if let ([k1, k2, k3, k4], true) = (&k[..], fisheye) {
            return Ok(Distortion::Equidistant([*k1, *k2, *k3, *k4]));
        }
        if k.iter().all(|k| *k == 0.0) {
            return Ok(Distortion::Pinhole);
        }
        if k.iter().skip(5).any(|k| *k != 0.0) {
            let message = format!(
                "{} has coefficients beyond k3 (rational, prism or tilt model); calibrate again with k1 k2 p1 p2 k3 only",
                names[0]
            );
            return Err(DataError::file(self.path, message));
        }
        let k3 = k.get(4).copied().unwrap_or(0.0);
        Ok(Distortion::RadTan([k[0], k[1], k[2], k[3], k3]))
    }

    /// A rigid motion written as a 4x4 matrix.
    pub fn motion(&self, names: &[&str]) -> Result<Se3, DataError> {
        let m = self.numbers(names, &[16])?;
        let turn = Matrix3::from_fn(|i, j| m[4 * i + j]);
        let rotation = rotation(&turn).ok_or_else(|| {
            let message = format!("the upper left of {} is no rotation", names[0]);
            DataError::file(self.path, message)
        })?;
        let shift = Translation3::from(Vector3::new(m[3], m[7], m[11]));
        Ok(Se3::from_parts(shift, rotation))
    }

    /// Width and height.
    pub fn size(&self) -> Result<Option<(usize, usize)>, DataError> {
        const PAIR: &[&str] = &["resolution", "image_size", "img_size", "size"];
        if let Some(size) = self.try_numbers(PAIR, &[2])? {
            return Ok(Some((size[0] as usize, size[1] as usize)));
        }
        let width = self.try_numbers(&["image_width", "width", "img_width"], &[1])?;
        let height = self.try_numbers(&["image_height", "height", "img_height"], &[1])?;
        Ok(width
            .zip(height)
            .map(|(w, h)| (w[0] as usize, h[0] as usize)))
    }
}

/// The rotation nearest to a matrix that is one but for rounding.
pub(crate) fn rotation(matrix: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let orthonormal = (matrix * matrix.transpose() - Matrix3::identity()).norm() < 1e-3
        && matrix.determinant() > 0.0;
    orthonormal.then(|| UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(matrix)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn word(text: &str) -> Node {
        Node::Word(text.into())
    }

    #[test]
    fn opencv_yaml_and_xml_of_the_same_values_are_the_same_to_ask() {
        let yaml = "%YAML:1.0\r\n---\r\nM1: !!opencv-matrix\r\n   rows: 1\r\n   cols: 3\r\n   dt: d\r\n   data: [ 1., .5,\r\n       -2.5e+00 ]\r\nimage_width: 64";
        let xml = "<?xml version=\"1.0\"?>\n<opencv_storage>\n<M1 type_id=\"opencv-matrix\"><rows>1</rows><cols>3</cols><dt>d</dt>\n<data>\n 1. .5\n -2.5e+00</data></M1><image_width>64</image_width></opencv_storage>\n";
        for root in [parse_yaml(yaml).unwrap(), parse_xml(xml).unwrap()] {
            let m1 = root.get(&["K1", "m1"]).unwrap();
            assert_eq!(m1.numbers(), Some(vec![1.0, 0.5, -2.5]));
            assert_eq!(m1.get(&["rows"]), Some(&word("1")));
            assert_eq!(root.get(&["imageWidth"]), Some(&word("64")));
        }
        for nested in [
            parse_yaml("K: [[1, 2], [3, 4]]"),
            parse_xml("<a><K><_>1</_><_>2 3</_><_>4</_></K></a>"),
        ] {
            let numbers = nested.unwrap().get(&["k"]).unwrap().numbers();
            assert_eq!(numbers, Some(vec![1.0, 2.0, 3.0, 4.0]));
        }
    }

    #[test]
    fn hostile_texts_are_errors() {
        let bomb = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n";
        assert!(parse_yaml(bomb).unwrap_err().contains("reference"));
        for deep in [
            "[".repeat(500_000),
            "- ".repeat(300_000),
            "{a: ".repeat(200_000),
        ] {
            assert!(parse_yaml(&deep).is_err());
        }
        assert!(parse_xml(&"<a>".repeat(100_000)).is_err());
        let deep = format!("{}{}", "<a>".repeat(140_000), "</a>".repeat(140_000));
        assert!(parse_xml(&deep).is_err());
        let entities = "<!DOCTYPE a [<!ENTITY b \"bb\">]><a>&b;</a>";
        assert!(parse_xml(entities).is_err());
        for text in [
            "",
            "\u{feff}",
            "%YAML:1.0",
            "a: [1, 2",
            "? [a]\n: b\n",
            "\t- x:\n\ty",
        ] {
            assert!(parse_yaml(text).is_err(), "{text}");
        }
    }
}
