//! Samples of random walks, for trainings without a simulation.

use super::finger::{ARM_JOINTS, FRAME_LEN, JOINTS};
use harness_learning::random::{Random, Stream};
use harness_samples::{FramePlace, Recording, Samples};
use harness_spec::{Episode, Layout, Modality, Task};
use std::path::Path;

/// Episodes of random walks, because these tests need no simulation.
pub fn walks(episodes: u32, samples: usize) -> Samples {
    walks_of(&vec![samples; episodes as usize])
}

/// The same with episodes of these numbers of samples.
pub fn walks_of(lengths: &[usize]) -> Samples {
    let recording = Recording { sample_rate_hz: 10.0, seed: 0 };
    let room = lengths.iter().sum();
    let mut all =
        Samples::new(recording, Layout::finger(), room, FramePlace::Memory, Path::new("nowhere")).unwrap();
    for (index, &samples) in (0..).zip(lengths) {
        let mut random = Random::new(u64::from(index) + 100, Stream::Parameters(Task::Prediction));
        let mut walk = |width: usize| -> Vec<f32> {
            let mut at = vec![0.0; width];
            let rows = (0..samples).flat_map(|_| {
                at.iter_mut().zip(random.normal(width)).for_each(|(value, step)| *value += 0.1 * step);
                at.clone()
            });
            rows.collect()
        };
        let arm = walk(ARM_JOINTS);
        let bytes = |value: f32| ((value + 3.0) * 40.0).clamp(0.0, 255.0) as u8;
        let mut episode = Episode::new(Layout::finger(), index, samples);
        let values = [
            (Modality::PROPRIOCEPTION, walk(JOINTS)),
            (Modality::SETPOINT, arm.clone()),
            (Modality::ARM, arm),
            (Modality::CONTACT_FORCE, walk(JOINTS)),
            (Modality::CONTACT_FORCE_MEAN, walk(JOINTS)),
        ];
        for (modality, values) in values {
            episode.vectors[Layout::finger().position(modality).unwrap()] = values;
        }
        let vision = Layout::finger().position(Modality::VISION).unwrap();
        episode.images[vision] = walk(FRAME_LEN).into_iter().map(bytes).collect();
        all.push(&episode).unwrap();
    }
    all
}
