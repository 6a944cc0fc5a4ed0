//! Adapting to a stream: the best of three is trusted, and what goes wrong is taken back.

use barchan_datasets::open;
use barchan_model::{Device, Preset, StereoNet, weights};
use barchan_train::{AdaptConfig, Adapter, Judgement, Verdict};

/// What a stream of rendered pairs does to a random network: all judgements, and whether after each
/// one the trusted weights are the first ones.
fn adapt(lr: f64, pairs: usize) -> (Vec<(Judgement, bool)>, Vec<u8>) {
    let source = open("synth:seed=5,frames=16,width=96,height=64").unwrap();
    let device = Device::flex();
    let mut net = Preset::Tiny.config();
    net.max_disparity = 32;
    let first = StereoNet::init(&net, 3, &device.clone().autodiff()).unwrap();
    let config = AdaptConfig {
        lr,
        crop: [64, 96],
        every: 4,
        ..AdaptConfig::default()
    };
    let mut adapter = Adapter::new(first, &device, config).unwrap();
    let bytes = |adapter: &Adapter| weights::to_bytes(adapter.trusted()).unwrap();
    let before = bytes(&adapter);
    let mut judgements = vec![];
    for index in 0..pairs {
        let frame = source.frame(index).unwrap();
        if let Some(judgement) = adapter.see(frame, source.rig()).unwrap() {
            judgements.push((judgement, bytes(&adapter) == before));
        } else if judgements.is_empty() {
            assert!(bytes(&adapter) == before, "trusted without judgement");
        }
    }
    let after = bytes(&adapter);
    (judgements, after)
}

#[test]
fn the_best_of_three_is_trusted_and_a_run_repeats() {
    let (judgements, after) = adapt(3e-4, 16);
    assert_eq!(judgements.len(), 4);
    for (judgement, _) in &judgements {
        let Judgement {
            learned,
            trusted,
            first,
            ..
        } = *judgement;
        let best = match judgement.verdict {
            Verdict::Learned => learned,
            Verdict::Trusted => trusted,
            Verdict::First => first,
        };
        assert!(best <= learned.min(trusted).min(first), "{judgement:?}");
    }
    // A random network has all to learn.
    assert!(
        judgements
            .iter()
            .any(|(j, _)| j.verdict == Verdict::Learned)
    );
    assert!(adapt(3e-4, 16).1 == after);
}

#[test]
fn learning_that_goes_astray_never_reaches_the_trusted_weights() {
    // Steps of this size leave nothing of a network.
    let (judgements, _) = adapt(10.0, 12);
    assert_eq!(judgements.len(), 3);
    for (judgement, is_first) in judgements {
        assert_ne!(judgement.verdict, Verdict::Learned, "{judgement:?}");
        assert!(is_first);
    }
}

#[test]
fn what_cannot_adapt_is_refused() {
    let net = || StereoNet::init(&Preset::Tiny.config(), 1, &Device::flex().autodiff()).unwrap();
    let broken: [fn(&mut AdaptConfig); 5] = [
        |c| c.judge = 1,
        |c| c.lr = f64::NAN,
        |c| c.crop = [8, 96],
        |c| c.every = 0,
        |c| c.loss.neighbours = 1,
    ];
    for change in broken {
        let mut config = AdaptConfig::default();
        change(&mut config);
        assert!(Adapter::new(net(), &Device::flex(), config).is_err());
    }
}
