use barchan_train::Loss;
use clap::Args;

/// The loss, term by term.
#[derive(Args)]
#[command(next_help_heading = "Loss")]
pub struct LossArgs {
    /// Weight of the structural term, eq. 2
    #[arg(long, value_name = "W", default_value_t = Loss::default().ssim)]
    ssim: f32,
    /// Weight of the colour term, eq. 3
    #[arg(long, value_name = "W", default_value_t = Loss::default().l1)]
    l1: f32,
    /// Weight of the smoothness term, eq. 4
    #[arg(long, value_name = "W", default_value_t = Loss::default().smooth)]
    smooth: f32,
    /// Weight of the disparity-magnitude term, eq. 5
    #[arg(long, value_name = "W", default_value_t = Loss::default().magnitude)]
    magnitude: f32,
    /// Weight of the second-order smoothness, which slanted ground does not pay for (try 0.1, with --smooth 0)
    #[arg(long, value_name = "W", default_value_t = Loss::default().second_order)]
    second_order: f32,
    /// Weight of the census term, for cameras of different exposure (try 0.5, with --ssim 0.4 --l1 0)
    #[arg(long, value_name = "W", default_value_t = Loss::default().census)]
    census: f32,
    /// Leave out what only one camera sees: pixels where left and right disagree by more than PX [PX: 1]
    #[arg(long, value_name = "PX", num_args = 0..=1, default_missing_value = "1")]
    occlusion: Option<f32>,
    /// Judge the right view too, at twice the cost
    #[arg(long)]
    symmetric: bool,
    /// Compare with the left images N frames before and after, too; the data must know every pose [0: off]
    #[arg(long, value_name = "N", num_args = 0..=1, default_value_t = Loss::default().neighbours, default_missing_value = "1")]
    neighbours: usize,
    /// Weight of the distance to disparity by semi-global matching, where that is sure and better (try 0.01)
    #[arg(long, value_name = "W", default_value_t = Loss::default().proxies)]
    proxies: f32,
}

impl LossArgs {
    pub fn loss(&self) -> Loss {
        Loss {
            ssim: self.ssim,
            l1: self.l1,
            smooth: self.smooth,
            magnitude: self.magnitude,
            second_order: self.second_order,
            census: self.census,
            occlusion: self.occlusion,
            symmetric: self.symmetric,
            neighbours: self.neighbours,
            proxies: self.proxies,
        }
    }
}
