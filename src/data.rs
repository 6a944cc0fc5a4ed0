//! Opening data for a command: format, correction, and whether its pairs are fit for stereo.

use anyhow::{Result, bail};
use barchan_datasets::check::{Fault, check};
use barchan_datasets::{Corrected, StereoSource, open};

use crate::output::Output;

/// Which data, and whether to trust it.
#[derive(clap::Args)]
pub struct Unchecked {
    /// Take the pairs as they are: no calibration check, no correction of rows on the fly
    #[arg(long)]
    pub no_check: bool,
}

/// Opens `spec` and checks its pairs. Rows that are off are corrected on the fly, with a line that
/// says so; swapped or slipped images stop the command; anything else is said. Rendered pairs are
/// exact and not checked.
pub fn open_checked(
    spec: &str,
    unchecked: &Unchecked,
    output: &Output,
) -> Result<Box<dyn StereoSource>> {
    let source = open(spec)?;
    if unchecked.no_check || spec.starts_with("synth") {
        return Ok(source);
    }
    let report = check(source.as_ref())?;
    for finding in &report.findings {
        let done = match finding.fault {
            Fault::Swapped | Fault::Slipped => bail!(
                "{spec}: {finding}\n  cure: `barchan data check {spec} --fix` writes the correction beside the images; --no-check takes them as they are"
            ),
            Fault::RowOffset | Fault::Pitch | Fault::Roll | Fault::Scale
                if report.correction.is_some() =>
            {
                "; rows are corrected"
            }
            _ => "",
        };
        output.notice(&format!("{spec}: {finding}{done}"));
    }
    match report.correction {
        Some(correction) => Ok(Box::new(Corrected::new(source, correction)?)),
        None => Ok(source),
    }
}
