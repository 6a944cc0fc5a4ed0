use barchan_train::Loss;
use clap::Args;

/// The loss, term by term.
#[derive(Args)]
#[command(next_help_heading = "Loss")]
pub struct LossArgs {
    /// Weight of the structural term, eq. 2 [default: 0.8]
    #[arg(long, value_name = "W")]
    ssim: Option<f32>,
    /// Weight of the colour term, eq. 3 [default: 0.2]
    #[arg(long, value_name = "W")]
    l1: Option<f32>,
    /// Weight of the smoothness term, eq. 4 [default: 0.1]
    #[arg(long, value_name = "W")]
    smooth: Option<f32>,
    /// Weight of the disparity-magnitude term, eq. 5 [default: 0.1]
    #[arg(long, value_name = "W")]
    magnitude: Option<f32>,
    /// Weight of the second-order smoothness, which slanted ground does not pay for (try 0.1, with --smooth 0) [default: 0]
    #[arg(long, value_name = "W")]
    second_order: Option<f32>,
    /// Weight of the census term, for cameras of different exposure (try 0.5, with --ssim 0.4 --l1 0) [default: 0]
    #[arg(long, value_name = "W")]
    census: Option<f32>,
    /// Leave out what only one camera sees: pixels where left and right disagree by more than PX [PX: 1]
    #[arg(long, value_name = "PX", num_args = 0..=1, default_missing_value = "1")]
    occlusion: Option<f32>,
    /// Judge the right view too, at twice the cost
    #[arg(long)]
    symmetric: bool,
    /// Compare with the left images N frames before and after, too; the data must know every pose [0: off]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "1")]
    neighbours: Option<usize>,
    /// Weight of the distance to disparity by semi-global matching, where that is sure and better (try 0.01) [default: 0]
    #[arg(long, value_name = "W")]
    proxies: Option<f32>,
    /// Weight of the cross-entropy of the distribution over disparities; with --supervised (try 10) [default: 0]
    #[arg(long, value_name = "W")]
    distribution: Option<f32>,
}

impl LossArgs {
    /// Changes what the flags name.
    pub fn apply(&self, loss: &mut Loss) {
        let weights = [
            (&mut loss.ssim, self.ssim),
            (&mut loss.l1, self.l1),
            (&mut loss.smooth, self.smooth),
            (&mut loss.magnitude, self.magnitude),
            (&mut loss.second_order, self.second_order),
            (&mut loss.census, self.census),
            (&mut loss.proxies, self.proxies),
            (&mut loss.distribution, self.distribution),
        ];
        for (weight, flag) in weights {
            *weight = flag.unwrap_or(*weight);
        }
        loss.occlusion = self.occlusion.or(loss.occlusion);
        loss.symmetric |= self.symmetric;
        loss.neighbours = self.neighbours.unwrap_or(loss.neighbours);
    }
}
