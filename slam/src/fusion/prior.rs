//! Where the map and the filter meet: poses of frames for the one, motions between them for the other.

use barchan_geometry::{Se3, se3};
use nalgebra::Matrix6;

use super::{Fusion, FusionConfig, FusionCounts, Motion, adjoint};

/// The filter, and the last frame that the map placed.
pub(crate) struct MotionPrior {
    fusion: Fusion,
    config: FusionConfig,
    /// Pose of the frame that motions are counted from (`T_cam_world`), and the covariance of its twist.
    anchor: Option<(Se3, Matrix6<f64>)>,
    /// The motion since then up to the present frame, where the sensors tell it.
    motion: Option<Motion>,
}

impl MotionPrior {
    pub fn new(fusion: Fusion, config: FusionConfig) -> Self {
        Self {
            fusion,
            config,
            anchor: None,
            motion: None,
        }
    }

    /// Where the sensors say that the camera is (`T_cam_world`), from the last placed frame on.
    pub fn predict(&mut self, time: f64) -> Option<Se3> {
        self.motion = self.fusion.advance(time);
        let (anchor, _) = self.anchor?;
        Some(self.motion?.T_anchor_now.inverse() * anchor)
    }

    /// Corrects the filter by the pose that the map gives the present frame, with the covariance of
    /// its twist (`exp(xi) T_cam_world`). `false` when the motion from the last placed frame
    /// contradicts the sensors.
    #[allow(non_snake_case)]
    pub fn agrees(&mut self, T_cam_world: &Se3, covariance: &Matrix6<f64>) -> bool {
        let (Some((anchor, before)), Some(_)) = (&self.anchor, &self.motion) else {
            return true;
        };
        let T_anchor_now = anchor * T_cam_world.inverse();
        let carry = adjoint(&T_anchor_now);
        self.fusion.correct(&Motion {
            T_anchor_now,
            covariance: before + carry * covariance * carry.transpose(),
        })
    }

    /// The present frame is placed: motions are counted from it.
    #[allow(non_snake_case)]
    pub fn placed(&mut self, T_cam_world: Se3, covariance: Matrix6<f64>) {
        // Without a reading now the filter cannot say where it is now.
        self.anchor = self.motion.is_some().then_some((T_cam_world, covariance));
        self.fusion.anchor();
    }

    /// The map moved under the last placed frame: what was at a place of the new world was at
    /// `T_old_new` times it, seen from the newest key frame. Whether the frame moved with that is not
    /// known better than that.
    #[allow(non_snake_case)]
    pub fn map_moved(&mut self, T_old_new: &Se3) {
        if let Some((anchor, covariance)) = &mut self.anchor {
            let moved = se3::log(&(*anchor * T_old_new * anchor.inverse()));
            *covariance += moved * moved.transpose();
            *anchor *= T_old_new;
        }
    }

    /// Deviations (metres, radians) of the way since the last placed frame.
    pub fn sigma(&self) -> Option<(f64, f64)> {
        self.anchor?;
        Some(self.motion?.sigma())
    }

    /// Whether the way since the last placed frame is known well enough to go on in the same part of
    /// the map.
    pub fn is_sure(&self) -> bool {
        const LEAST: f64 = 0.05;
        let way = self
            .motion
            .map(|m| m.T_anchor_now.translation.vector.norm());
        let (Some((shift, turn)), Some(way)) = (self.sigma(), way) else {
            return false;
        };
        shift <= LEAST.max(self.config.join_share * way) && turn <= self.config.join_turn
    }

    pub fn counts(&self) -> FusionCounts {
        self.fusion.counts()
    }
}
