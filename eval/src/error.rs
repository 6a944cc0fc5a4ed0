/// Why two things cannot be compared. Each message names the cure.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EvalError {
    /// Too few poses have a partner in time.
    #[error(
        "only {matched} of {estimate} estimated poses lie within {tolerance} s of one of {truth} true poses, and 3 are needed; \
         the estimate spans {estimate_span}, the truth {truth_span}\n  \
         cure: give both files the same clock, or a larger tolerance"
    )]
    TooFewMatches {
        /// Pairs found.
        matched: usize,
        /// Poses in the estimate.
        estimate: usize,
        /// Poses in the truth.
        truth: usize,
        /// Largest accepted difference in time, seconds.
        tolerance: f64,
        /// First to last time of the estimate, for people.
        estimate_span: String,
        /// First to last time of the truth, for people.
        truth_span: String,
    },
    /// All poses of one side are at one place: no alignment is defined.
    #[error(
        "the {which} stays at one place: a trajectory that does not move cannot be aligned or scored"
    )]
    NoMotion {
        /// `estimate` or `truth`.
        which: &'static str,
    },
    /// A pose or a time is NaN or infinite.
    #[error(
        "pose {index} of the {which} is not finite\n  cure: leave out poses that were not tracked"
    )]
    NotFinite {
        /// `estimate` or `truth`.
        which: &'static str,
        /// Which pose, from 0.
        index: usize,
    },
    /// Too few poses have truth before and after them to tell whether clocks differ.
    #[error(
        "the route is too short for differences of up to {most:.1} s: {poses} poses have truth for so long before and after \
         them, and {fewest} are needed; --max-shift looks for smaller ones"
    )]
    TooShortToShift {
        /// Poses that have.
        poses: usize,
        /// How many are needed.
        fewest: usize,
        /// The largest shift, seconds.
        most: f64,
    },
    /// The truth is shorter than the shortest segment.
    #[error(
        "the truth is {length:.1} m long and the KITTI segments start at {shortest} m: use the relative pose error per frame"
    )]
    TooShort {
        /// Path length of the truth, metres.
        length: f64,
        /// The shortest segment, metres.
        shortest: f64,
    },
    /// The truth holds positions only, and the score needs rotations.
    #[error(
        "all rotations of the truth are the same, so it holds positions only: KITTI segment errors need rotations"
    )]
    NoRotation,
    /// A predicted disparity image has another size than the truth.
    #[error(
        "the prediction is {prediction:?} pixels and the truth {truth:?}: compare images of one size"
    )]
    Sizes {
        /// Width and height of the prediction.
        prediction: (u32, u32),
        /// Width and height of the truth.
        truth: (u32, u32),
    },
    /// No frame had a pixel whose truth is known.
    #[error("none of the {frames} frames compared has a pixel of known true disparity")]
    NoTruth {
        /// Frames compared.
        frames: usize,
    },
    /// No place is known to both sides.
    #[error(
        "the estimate knows none of the {truth} places of the truth in its extent\n  \
         cure: give both in one frame; `barchan map --align` takes a map to the frame of known poses"
    )]
    NoOverlap {
        /// Places of known truth in the extent of the estimate.
        truth: usize,
    },
}
