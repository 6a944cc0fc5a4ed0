//! Opening data for a command: format, and whether the rows of its pairs correspond.

use anyhow::Result;
use barchan_datasets::{StereoSource, open, rows};

use crate::output::Output;

/// Opens `spec` and measures its row offset; pairs whose rows are off are corrected, with a line
/// that says so. Rendered pairs are exact and not measured.
pub fn open_checked(spec: &str, output: &Output) -> Result<Box<dyn StereoSource>> {
    let source = open(spec)?;
    if spec.starts_with("synth") {
        return Ok(source);
    }
    let measured = rows::measure_row_offset(source.as_ref())?;
    if rows::needs_correction(&measured) {
        output.notice(&format!(
            "{spec}: the right images lie {:.2} px {} than the left (spread {:.2} px over {} matches); rows are corrected",
            measured.offset.abs(),
            if measured.offset > 0.0 { "lower" } else { "higher" },
            measured.spread,
            measured.matches,
        ));
        return Ok(Box::new(rows::RowCorrected::new(source, measured.offset)));
    }
    if measured.matches < 30 {
        output.notice(&format!(
            "{spec}: only {} patches match between left and right: are the cameras swapped, or the images not of one moment?",
            measured.matches
        ));
    }
    Ok(source)
}
