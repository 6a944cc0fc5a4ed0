//! The messages of `onnx.proto` (IR version 8) that are used here, with their field numbers.
#![allow(missing_docs)] // The fields are those of `onnx.proto`, which documents them.

use prost::Message;

#[derive(Clone, PartialEq, Message)]
pub struct Model {
    #[prost(int64, tag = "1")]
    pub ir_version: i64,
    #[prost(string, tag = "2")]
    pub producer_name: String,
    #[prost(string, tag = "3")]
    pub producer_version: String,
    #[prost(string, tag = "6")]
    pub doc_string: String,
    #[prost(message, optional, tag = "7")]
    pub graph: Option<Graph>,
    #[prost(message, repeated, tag = "8")]
    pub opset_import: Vec<OperatorSet>,
    #[prost(message, repeated, tag = "14")]
    pub metadata_props: Vec<StringStringEntry>,
}

#[derive(Clone, PartialEq, Message)]
pub struct OperatorSet {
    #[prost(string, tag = "1")]
    pub domain: String,
    #[prost(int64, tag = "2")]
    pub version: i64,
}

#[derive(Clone, PartialEq, Message)]
pub struct StringStringEntry {
    #[prost(string, tag = "1")]
    pub key: String,
    #[prost(string, tag = "2")]
    pub value: String,
}

#[derive(Clone, PartialEq, Message)]
pub struct Graph {
    #[prost(message, repeated, tag = "1")]
    pub node: Vec<Node>,
    #[prost(string, tag = "2")]
    pub name: String,
    #[prost(message, repeated, tag = "5")]
    pub initializer: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    pub input: Vec<ValueInfo>,
    #[prost(message, repeated, tag = "12")]
    pub output: Vec<ValueInfo>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Node {
    #[prost(string, repeated, tag = "1")]
    pub input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    pub output: Vec<String>,
    #[prost(string, tag = "3")]
    pub name: String,
    #[prost(string, tag = "4")]
    pub op_type: String,
    #[prost(message, repeated, tag = "5")]
    pub attribute: Vec<Attribute>,
}

/// One of the values is set, and `kind` says which. They are optional so that a zero is written.
#[derive(Clone, PartialEq, Message)]
pub struct Attribute {
    #[prost(string, tag = "1")]
    pub name: String,
    #[prost(float, optional, tag = "2")]
    pub f: Option<f32>,
    #[prost(int64, optional, tag = "3")]
    pub i: Option<i64>,
    #[prost(bytes = "vec", optional, tag = "4")]
    pub s: Option<Vec<u8>>,
    #[prost(int64, repeated, packed = "false", tag = "8")]
    pub ints: Vec<i64>,
    #[prost(int32, tag = "20")]
    pub kind: i32,
}

impl Attribute {
    pub fn float(name: &str, value: f32) -> Self {
        Self {
            name: name.into(),
            f: Some(value),
            kind: 1,
            ..Self::default()
        }
    }
    pub fn int(name: &str, value: i64) -> Self {
        Self {
            name: name.into(),
            i: Some(value),
            kind: 2,
            ..Self::default()
        }
    }
    pub fn string(name: &str, value: &str) -> Self {
        Self {
            name: name.into(),
            s: Some(value.into()),
            kind: 3,
            ..Self::default()
        }
    }
    pub fn ints(name: &str, values: &[usize]) -> Self {
        Self {
            name: name.into(),
            ints: values.iter().map(|v| *v as i64).collect(),
            kind: 7,
            ..Self::default()
        }
    }
}

#[derive(Clone, PartialEq, Message)]
pub struct Tensor {
    #[prost(int64, repeated, packed = "false", tag = "1")]
    pub dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    pub data_type: i32,
    #[prost(string, tag = "8")]
    pub name: String,
    #[prost(bytes = "vec", tag = "9")]
    pub raw_data: Vec<u8>,
}

pub const FLOAT: i32 = 1;
const UINT8: i32 = 2;
const INT8: i32 = 3;
const INT32: i32 = 6;
const INT64: i32 = 7;

impl Tensor {
    pub fn floats(name: &str, dims: &[usize], values: impl IntoIterator<Item = f32>) -> Self {
        Self {
            name: name.into(),
            dims: dims.iter().map(|d| *d as i64).collect(),
            data_type: FLOAT,
            raw_data: values.into_iter().flat_map(f32::to_le_bytes).collect(),
        }
    }
    pub fn ints(name: &str, values: &[i64]) -> Self {
        Self {
            name: name.into(),
            dims: vec![values.len() as i64],
            data_type: INT64,
            raw_data: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        }
    }
    pub fn uint8s(name: &str, dims: &[usize], values: impl IntoIterator<Item = u8>) -> Self {
        Self {
            data_type: UINT8,
            raw_data: values.into_iter().collect(),
            ..Self::floats(name, dims, [])
        }
    }
    pub fn int8s(name: &str, dims: &[usize], values: impl IntoIterator<Item = i8>) -> Self {
        Self {
            data_type: INT8,
            raw_data: values.into_iter().map(i8::cast_unsigned).collect(),
            ..Self::floats(name, dims, [])
        }
    }
    pub fn int32s(name: &str, dims: &[usize], values: impl IntoIterator<Item = i32>) -> Self {
        Self {
            data_type: INT32,
            raw_data: values.into_iter().flat_map(i32::to_le_bytes).collect(),
            ..Self::floats(name, dims, [])
        }
    }
    /// The values of a float tensor whose data are raw and as many as its dimensions say.
    pub fn to_floats(&self) -> Option<Vec<f32>> {
        let (values, rest) = self.raw_data.as_chunks::<4>();
        let count = (self.dims.iter()).try_fold(1i64, |n, d| n.checked_mul(*d).filter(|_| *d >= 0));
        (self.data_type == FLOAT && rest.is_empty() && count == i64::try_from(values.len()).ok())
            .then(|| values.iter().map(|v| f32::from_le_bytes(*v)).collect())
    }
}

#[derive(Clone, PartialEq, Message)]
pub struct ValueInfo {
    #[prost(string, tag = "1")]
    pub name: String,
    #[prost(message, optional, tag = "2")]
    pub kind: Option<Type>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Type {
    #[prost(message, optional, tag = "1")]
    pub tensor: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
pub struct TensorType {
    #[prost(int32, tag = "1")]
    pub elem_type: i32,
    #[prost(message, optional, tag = "2")]
    pub shape: Option<Shape>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Shape {
    #[prost(message, repeated, tag = "1")]
    pub dim: Vec<Dimension>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Dimension {
    #[prost(int64, optional, tag = "1")]
    pub value: Option<i64>,
    #[prost(string, optional, tag = "2")]
    pub param: Option<String>,
}

impl ValueInfo {
    /// A float tensor of which not even the rank is told.
    pub fn float_of_any_shape(name: &str) -> Self {
        Self {
            name: name.into(),
            kind: Some(Type {
                tensor: Some(TensorType {
                    elem_type: FLOAT,
                    shape: None,
                }),
            }),
        }
    }
    /// A float tensor; a dimension that is no number is a free one of that name.
    pub fn float(name: &str, dims: [&str; 4]) -> Self {
        let dim = dims
            .iter()
            .map(|d| match d.parse() {
                Ok(value) => Dimension {
                    value: Some(value),
                    param: None,
                },
                Err(_) => Dimension {
                    value: None,
                    param: Some((*d).into()),
                },
            })
            .collect();
        let tensor = TensorType {
            elem_type: FLOAT,
            shape: Some(Shape { dim }),
        };
        Self {
            name: name.into(),
            kind: Some(Type {
                tensor: Some(tensor),
            }),
        }
    }
}
