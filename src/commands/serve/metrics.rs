//! Counts, in the text format that Prometheus reads.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use barchan_slam::FrameReport;

use super::station::locked;

/// What happened since the service began.
#[derive(Default)]
pub struct Metrics {
    pairs: AtomicU64,
    disparity_us: AtomicU64,
    track_us: AtomicU64,
    tracked: AtomicU64,
    lost: AtomicU64,
    keyframes: AtomicU64,
    runs_written: AtomicU64,
    runs_failed: AtomicU64,
    watch_failed: AtomicU64,
    /// By status.
    responses: Mutex<BTreeMap<u16, u64>>,
}

impl Metrics {
    pub fn answered(&self, disparity: Duration) {
        add(&self.pairs, 1);
        add(&self.disparity_us, disparity.as_micros() as u64);
    }

    pub fn tracked(&self, report: &FrameReport) {
        let counter = match report.tracked {
            true => &self.tracked,
            false => &self.lost,
        };
        add(counter, 1);
        add(&self.keyframes, u64::from(report.keyframe));
        add(&self.track_us, (report.ms_track * 1e3) as u64);
    }

    /// A run is over; one without a key frame left nothing.
    pub fn run_written(&self, some: bool) {
        add(&self.runs_written, u64::from(some));
    }

    /// A run could not be written, for a reason that is said once a run.
    pub fn run_failed(&self, error: &anyhow::Error) {
        add(&self.runs_failed, 1);
        note(&format!("a run is not recorded: {error:#}"));
    }

    /// A pair of the watched folder could not be answered.
    pub fn watch_failed(&self, message: &str) {
        add(&self.watch_failed, 1);
        note(message);
    }

    pub fn responded(&self, status: u16) {
        *locked(&self.responses).entry(status).or_default() += 1;
    }

    /// The counts as text.
    pub fn text(&self) -> String {
        let mut text = String::new();
        let mut line = |name: &str, help: &str, labels: &str, value: f64| {
            if !help.is_empty() {
                // A string takes whatever is written.
                let _ = writeln!(
                    text,
                    "# HELP barchan_{name} {help}\n# TYPE barchan_{name} counter"
                );
            }
            let _ = writeln!(text, "barchan_{name}{labels} {value}");
        };
        let count = |c: &AtomicU64| c.load(Ordering::Relaxed) as f64;
        for (name, help, value) in [
            ("pairs_total", "Pairs answered.", count(&self.pairs)),
            (
                "disparity_seconds_total",
                "Time that disparity took.",
                count(&self.disparity_us) * 1e-6,
            ),
            (
                "tracking_seconds_total",
                "Time that tracking and mapping took.",
                count(&self.track_us) * 1e-6,
            ),
            (
                "frames_tracked_total",
                "Pairs whose pose is known.",
                count(&self.tracked),
            ),
            (
                "frames_lost_total",
                "Pairs whose pose is not known.",
                count(&self.lost),
            ),
            ("keyframes_total", "Key frames.", count(&self.keyframes)),
            (
                "runs_written_total",
                "Runs written.",
                count(&self.runs_written),
            ),
            (
                "runs_failed_total",
                "Runs that could not be written.",
                count(&self.runs_failed),
            ),
            (
                "watch_failed_total",
                "Pairs of the watched folder that could not be answered.",
                count(&self.watch_failed),
            ),
        ] {
            line(name, help, "", value);
        }
        let mut help = "Responses by HTTP status.";
        for (status, number) in locked(&self.responses).iter() {
            let labels = format!("{{status=\"{status}\"}}");
            line("responses_total", help, &labels, *number as f64);
            help = "";
        }
        text
    }
}

fn add(counter: &AtomicU64, n: u64) {
    counter.fetch_add(n, Ordering::Relaxed);
}

/// Says something on standard error, where a service manager keeps it; nobody may be there.
fn note(message: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "note: {message}");
}
