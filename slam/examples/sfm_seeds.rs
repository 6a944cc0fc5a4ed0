//! Structure from motion on one sequence with several seeds: how much of its outcome is chance.
//!
//! `cargo run --release -p barchan-slam --example sfm_seeds -- DATA [SEEDS] [-v]`, with SEEDS the number of seeds from zero.

use barchan_datasets::open;
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, score};
use barchan_slam::sfm::{SfmConfig, StructureFromMotion};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let verbose = arguments.iter().any(|a| a == "-v");
    let data = arguments
        .first()
        .ok_or("usage: sfm_seeds DATA [SEEDS] [-v]")?;
    let seeds: u64 = arguments.get(1).map_or(Ok(8), |text| text.parse())?;
    let source = open(data)?;
    println!("seed  placed  pieces  views  points  Sim3 ATE m  SE3 ATE m  length m   ms a frame");
    for seed in 0..seeds {
        let config = SfmConfig {
            seed,
            ..SfmConfig::default()
        };
        let mut sfm = StructureFromMotion::new(*source.rig(), config);
        let mut ms = 0.0;
        for index in 0..source.len() {
            let report = sfm.track(&source.frame(index)?)?;
            ms += report.ms;
            if verbose {
                println!("{report:?}");
            }
        }
        let result = sfm.finish();
        let placed = result.tracked.iter().filter(|t| **t).count();
        let pieces = result.views.last().map_or(0, |v| v.piece + 1);
        let found = source
            .true_trajectory()
            .and_then(|truth| score(&result.trajectory, truth, DEFAULT_TOLERANCE).ok());
        let [sim3, se3, length] =
            found.map_or([f64::NAN; 3], |s| [s.ate_rmse_sim3, s.ate_rmse, s.length]);
        println!(
            "{seed:4}  {placed:6}  {pieces:6}  {:5}  {:6}  {sim3:10.3}  {se3:9.3}  {length:8.2}  {:10.1}",
            result.views.len(),
            result.points.len(),
            ms / source.len() as f64,
        );
    }
    Ok(())
}
