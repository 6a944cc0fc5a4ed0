//! How often geometry proves true and false loops, with points of dense disparity and of stereo matches: the
//! argument of Hong 2021, 3.2.3. Slow; `cargo test --release --workspace --test loop_rates -- --ignored
//! --nocapture` prints the table.

use barchan_datasets::{StereoFrame, open};
use barchan_infer::SemiGlobal;
use barchan_slam::{LoopEvent, LoopPoints, Slam, SlamConfig};

/// Places that were put to the proof and how many were proved, true and false ones.
#[derive(Clone, Copy, Debug, Default)]
struct Rates {
    tried: [usize; 2],
    proved: [usize; 2],
}

#[test]
#[ignore = "minutes of rendering"]
fn dense_points_prove_no_fewer_true_loops_and_no_false_ones() {
    let mut rates = [Rates::default(); 2];
    for (seed, texture) in [(2, "rich"), (3, "rich"), (2, "low"), (3, "low")] {
        // A round and a third: the last third is seen again.
        let spec = format!(
            "synth:seed={seed},texture={texture},round=16,speed=1,frames=108,width=256,height=192"
        );
        let source = open(&spec).unwrap();
        let images: Vec<StereoFrame> = (0..source.len())
            .map(|k| source.frame(k).unwrap())
            .collect();
        let truth = &source.true_trajectory().unwrap().poses;
        for (rates, points) in rates
            .iter_mut()
            .zip([LoopPoints::Dense, LoopPoints::Sparse])
        {
            let mut config = SlamConfig::default();
            config.loops.points = points;
            // Whatever looks a little alike is put to the proof, by every key frame anew.
            config.loops.min_score = 0.1;
            config.loops.min_streak = 1;
            config.loops.correct = false;
            let engine = Box::new(SemiGlobal::new(Some(48)));
            let mut slam = Slam::new(*source.rig(), config, Some(engine));
            let mut events: Vec<LoopEvent> = Vec::new();
            for frame in &images {
                let mapped = slam.track(frame.clone()).unwrap().mapped;
                events.extend(mapped.into_iter().flat_map(|m| m.loops));
            }
            let last = slam.settle().unwrap();
            events.extend(last.into_iter().flat_map(|m| m.loops));
            for event in &events {
                let [here, there] = [event.frame, event.earlier_frame].map(|k| truth[k]);
                let apart = (here.T_world_cam.inverse() * there.T_world_cam).translation;
                let kind = usize::from(apart.vector.norm() > 1.5);
                rates.tried[kind] += 1;
                rates.proved[kind] += usize::from(event.proved);
            }
        }
    }
    println!("points   true loops proved   false loops proved");
    for (name, r) in ["dense", "sparse"].iter().zip(&rates) {
        let [of, of_false] = r.tried;
        let [proved, false_proved] = r.proved;
        println!("{name:8} {proved:4} of {of:4}        {false_proved:4} of {of_false:4}");
    }
    let [dense, sparse] = rates;
    assert!(dense.tried[0] > 0 && dense.tried[1] > 0, "{dense:?}");
    assert_eq!(dense.proved[1], 0, "{dense:?}");
    assert!(dense.proved[0] >= sparse.proved[0], "{rates:?}");
}
