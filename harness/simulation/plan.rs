//! What is random about an episode: how the actuators move, and where boxes stand.

use super::SimulationError;
use super::factors::FactorValues;
use super::motion::{Motion, Timing, ranges, rest};
use super::placement::place_boxes;
use super::scene::Scene;
use harness_spec::{Pose, Simulation};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};

/// All that decides an episode, given its scene.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodePlan {
    /// The episode's index in the dataset.
    pub episode: u32,
    /// Where each box starts.
    pub boxes: Vec<Pose>,
    /// What it draws of the factors of variation that the spec turns on.
    pub factors: FactorValues,
    motion: Motion,
}

impl EpisodePlan {
    /// Draws the plan of the episode of that index.
    ///
    /// # Errors
    /// When the spec's rates do not suit the scene's step, or the boxes find no place.
    pub fn draw(scene: &Scene, spec: &Simulation, index: u32) -> Result<Self, SimulationError> {
        let timing = Timing::new(spec, scene.step_s())?;
        let mut rng = episode_stream(scene, spec.seed, index);
        let motion = Motion::draw(&ranges(scene, spec), &rest(scene, spec), spec, &timing, &mut rng);
        let factors = FactorValues::draw(scene, spec, index);
        let boxes = place_boxes(scene, spec, &factors, index, &mut rng)?;
        Ok(Self { episode: index, boxes, factors, motion })
    }

    /// Writes what the actuators are commanded during a simulation step.
    pub fn setpoint(&self, step: usize, setpoint: &mut [f64]) {
        self.motion.setpoint(step, setpoint);
    }
}

/// The episode's own random stream: independent of every other's, whichever thread runs it and when.
fn episode_stream(scene: &Scene, seed: u64, index: u32) -> ChaCha8Rng {
    let identity = format!("harness episode: seed {seed}, scenario {}, index {index}", scene.scenario());
    ChaCha8Rng::from_seed(Sha256::digest(identity).into())
}
