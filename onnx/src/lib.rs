//! ONNX files: the messages, and a builder for graphs.
//!
//! What it is for: [`proto`] holds the messages of `onnx.proto` that are used here, [`GraphBuilder`]
//! collects nodes and constants under unique names, [`inspect`] says whether a stranger's file is sound.
//!
//! What it promises: what is written is IR version 8, opset 17, every value named after its node, so that a
//! viewer shows the names of the layers.
//!
//! What it never does: run a graph, or know a network.

mod builder;
pub mod inspect;
pub mod proto;

pub use builder::{GraphBuilder, OPSET};
pub use prost::{Message, bytes::Bytes};
