//! Simulates on from the samples of an episode, to find how far ahead anything could predict it.

use super::SimulationError;
use super::episode::{record, refuse_policy, with_room};
use super::knowledge::{Knowledge, Known};
use super::physics::Physics;
use super::plan::EpisodePlan;
use super::scene::Scene;
use harness_spec::{Episode, Simulation};

/// What [`simulate_on`] finds. The episodes have no images.
pub struct SimulatedOn {
    /// The samples from which it simulated on, as the episode has them.
    pub present: Episode,
    /// For each horizon, the samples that follow at this distance. There is one for each restart from a sample, and
    /// those of one sample lie together.
    pub ahead: Vec<Episode>,
}

/// Simulates an episode, and from each of its samples `at` once more: from a state that is rounded to f32, with the
/// setpoints of the episode and without noise. Without the rounding, each of these simulations would repeat the
/// episode. If not all is `known`, the state also has errors, and each sample is the start of several simulations. The
/// state is that of one simulation step after the sample, where MuJoCo has already moved the positions.
///
/// `at` and `horizons` are sorted. A horizon is a number of samples after the one from which a simulation begins.
///
/// # Errors
/// When a policy gives the setpoints, what is known does not suit the scene, the boxes find no place, or the simulation
/// diverges.
pub fn simulate_on(
    scene: &Scene,
    spec: &Simulation,
    index: u32,
    at: &[usize],
    horizons: &[usize],
    known: &Knowledge,
) -> Result<SimulatedOn, SimulationError> {
    refuse_policy(spec)?;
    let plan = EpisodePlan::draw(scene, spec, index)?;
    let (restarts, known) =
        (known.restarts, (!known.is_all()).then(|| Known::new(scene, known)).transpose()?);
    let mut repeated = Physics::new(scene, spec)?;
    let mut restarted = Physics::new(scene, spec)?;
    repeated.start(&plan);
    restarted.start(&plan);
    let new = |samples| with_room(scene, spec, &plan, samples);
    let ahead = horizons.iter().map(|_| new(at.len() * restarts)).collect();
    let mut found = SimulatedOn { present: new(at.len()), ahead };
    let mut samples = 0;
    for sample in at {
        while samples <= *sample {
            repeated.follow(&plan)?;
            samples += 1;
        }
        record(&mut found.present, scene, &repeated.instant);
        for restart in 0..restarts {
            restarted.go_on_from(&repeated);
            if let Some(known) = &known {
                restarted.err(known, &mut Known::stream(scene, spec, index, *sample, restart));
            }
            let mut distance = 0;
            for (episode, horizon) in found.ahead.iter_mut().zip(horizons) {
                while distance < *horizon {
                    restarted.follow(&plan)?;
                    distance += 1;
                }
                record(episode, scene, &restarted.instant);
            }
        }
    }
    Ok(found)
}
