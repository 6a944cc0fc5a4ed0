//! A frame that is no number: the run stops at it and names it.

use barchan_datasets::{DataError, Rgb, StereoFrame, StereoSource};
use barchan_geometry::RectifiedRig;
use barchan_model::Preset;
use barchan_train::{Ended, TrainConfig, TrainError, Trainer};

/// Six pairs of one pattern, one pixel of one of them no number.
struct Poisoned {
    rig: RectifiedRig,
    frame: usize,
}

impl StereoSource for Poisoned {
    fn rig(&self) -> &RectifiedRig {
        &self.rig
    }
    fn len(&self) -> usize {
        6
    }
    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let mut left = Rgb::from_fn(64, 48, |x, y| {
            image::Rgb([((x * 37 + y * 11) % 64) as f32 / 64.0; 3])
        });
        let right = left.clone();
        if index == self.frame {
            left.put_pixel(32, 24, image::Rgb([f32::NAN; 3]));
        }
        Ok(StereoFrame {
            index,
            name: self.name(index),
            time: 0.0,
            left,
            right,
        })
    }
}

fn poisoned(frame: usize, steps: usize) -> Result<Ended, TrainError> {
    let rig = RectifiedRig {
        width: 64,
        height: 48,
        fx: 50.0,
        fy: 50.0,
        cx: 32.0,
        cy: 24.0,
        doffs: 0.0,
        baseline: 0.1,
    };
    let mut config = TrainConfig::new(Preset::Tiny.config());
    config.data = vec!["folder:here".into()];
    config.net.max_disparity = 16;
    config.schedule.steps = Some(steps);
    let dir = tempfile::tempdir().unwrap();
    let source = Box::new(Poisoned { rig, frame });
    Trainer::create(dir.path(), config, vec![source], None)
        .and_then(|mut trainer| trainer.run(&mut ()))
}

#[test]
fn a_poisoned_frame_stops_the_run_and_is_named() {
    // Frame 3 is held out, 2 is trained on, 99 is not there.
    for (frame, name) in [(2, "000002"), (3, "000003")] {
        let message = poisoned(frame, 5).unwrap_err().to_string();
        for word in [name, "folder:here", "NaN", "step", "cure"] {
            assert!(message.contains(word), "\"{word}\" is not in: {message}");
        }
    }
    assert!(matches!(poisoned(99, 2), Ok(Ended::Finished { .. })));
}
