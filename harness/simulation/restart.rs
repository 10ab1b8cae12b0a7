//! Simulates on from the samples of an episode, to find how far ahead anything could predict it.

use super::SimulationError;
use super::episode::{record, refuse_policy, with_room};
use super::noise::Noise;
use super::physics::Physics;
use super::plan::EpisodePlan;
use super::scene::Scene;
use harness_spec::{Episode, Simulation};

/// Simulates an episode, and from each of its samples `at` once more: from a state that is rounded to f32, with the
/// setpoints of the episode and without noise. Without the rounding, each of these simulations would repeat the
/// episode.
///
/// `at` and `horizons` are sorted. Horizons count the samples after the one `at` which a simulation begins. The first
/// episode that is returned has the samples `at` as simulated at first, and the others, one for each horizon, what was
/// simulated from them. All have a row for each of `at`, and no images.
///
/// # Errors
/// When a policy gives the setpoints, the boxes find no place, or the simulation diverges.
///
/// # Panics
/// When the episode has no such samples.
pub fn simulate_on(
    scene: &Scene,
    spec: &Simulation,
    index: u32,
    at: &[usize],
    horizons: &[usize],
) -> Result<Vec<Episode>, SimulationError> {
    refuse_policy(spec)?;
    let plan = EpisodePlan::draw(scene, spec, index)?;
    let mut repeated = Physics::new(scene, spec)?;
    let mut restarted = Physics::new(scene, spec)?;
    let new = || with_room(scene, spec, &plan, at.len());
    let mut found: Vec<Episode> = std::iter::repeat_with(new).take(1 + horizons.len()).collect();
    repeated.start(&plan);
    let mut without_noise = plan.clone();
    without_noise.noise = Noise::default();
    restarted.start(&without_noise);
    let (samples, mut at) = (repeated.timing.samples, at.iter().peekable());
    for sample in 0..samples {
        repeated.follow(&plan)?;
        if at.next_if(|at| **at == sample).is_none() {
            continue;
        }
        record(&mut found[0], scene, &repeated.instant);
        restarted.go_on_from(&repeated);
        let mut ahead = 0;
        for (episode, horizon) in found[1..].iter_mut().zip(horizons) {
            assert!(sample + horizon < samples, "sample {sample} + {horizon} of {samples}");
            while ahead < *horizon {
                restarted.follow(&plan)?;
                ahead += 1;
            }
            record(episode, scene, &restarted.instant);
        }
    }
    assert!(at.next().is_none(), "the episode has {samples} samples");
    Ok(found)
}
