//! One module per subcommand.

pub mod adapt;
pub mod compare;
pub mod completions;
pub mod data;
pub mod demo;
pub mod doctor;
pub mod eval;
pub mod export;
pub mod features;
pub mod infer;
pub mod map;
pub mod noise;
pub mod probe;
pub mod raster;
pub mod report;
pub mod serve;
pub mod slam;
pub mod train;
pub mod view;
pub mod vocabulary;
