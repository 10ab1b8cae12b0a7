//! The random parts of an episode: the actuators' motion, the places of the boxes, and the factors of variation.

use super::SimulationError;
use super::factors::FactorValues;
use super::motion::Setpoints;
use super::noise::Noise;
use super::placement::place_boxes;
use super::scene::Scene;
use harness_spec::{Pose, Simulation};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};

/// Everything that determines an episode of a given scene.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodePlan {
    /// The episode's index in the dataset.
    pub episode: u32,
    /// Start pose of each box.
    pub boxes: Vec<Pose>,
    /// Values of the factors of variation that the spec turns on.
    pub factors: FactorValues,
    /// Noise of what is recorded.
    pub(super) noise: Noise,
    setpoints: Setpoints,
}

impl EpisodePlan {
    /// Draws the plan of the episode with this index.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, or the boxes find no place.
    pub fn draw(scene: &Scene, spec: &Simulation, index: u32) -> Result<Self, SimulationError> {
        Self::with_factors(scene, spec, index, FactorValues::draw(scene, spec, index))
    }

    /// Draws everything except the factors, which have the given values.
    pub(super) fn with_factors(
        scene: &Scene,
        spec: &Simulation,
        index: u32,
        factors: FactorValues,
    ) -> Result<Self, SimulationError> {
        let timing = scene.timing(spec)?;
        let mut rng = episode_stream(scene, spec.stream(), index);
        let ranges = scene.ranges(spec);
        let setpoints = match &scene.course {
            Some(course) => Setpoints::through(course.episode(index), ranges.len(), &timing),
            None => {
                let motion = scene.world().file().action.motion;
                Setpoints::draw(motion, &ranges, &scene.start(spec), spec, &timing, &mut rng)
            }
        };
        Self::moved(scene, spec, index, factors, setpoints, &mut rng)
    }

    /// The plan of an episode with these factors that goes through the setpoints of its samples, `[samples, elements]`.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, or the boxes find no place.
    pub(super) fn through(
        scene: &Scene,
        spec: &Simulation,
        index: u32,
        factors: FactorValues,
        setpoints: &[f64],
    ) -> Result<Self, SimulationError> {
        let setpoints = Setpoints::through(setpoints, scene.ranges(spec).len(), &scene.timing(spec)?);
        Self::moved(scene, spec, index, factors, setpoints, &mut episode_stream(scene, spec.stream(), index))
    }

    /// Draws the rest of the plan of an episode with these factors and setpoints.
    fn moved(
        scene: &Scene,
        spec: &Simulation,
        index: u32,
        factors: FactorValues,
        setpoints: Setpoints,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self, SimulationError> {
        let boxes = place_boxes(scene, spec, &factors, index, rng)?;
        let noise = Noise::new(scene, spec, &factors, index);
        Ok(Self { episode: index, boxes, factors, noise, setpoints })
    }

    /// Writes the setpoints of the actuators during a simulation step, counted from the episode's start, to `setpoint`.
    /// In a probing motion, which waits and goes back, the step is that of the motion and not of the simulation.
    pub fn setpoint(&self, step: usize, setpoint: &mut [f64]) {
        self.setpoints.setpoint(step, setpoint);
    }
}

/// Returns the random generator of an episode. It depends only on the seed, the scenario and the index, so episodes are
/// independent of each other and of the thread that simulates them.
fn episode_stream(scene: &Scene, seed: u64, index: u32) -> ChaCha8Rng {
    let identity = format!("harness episode: seed {seed}, scenario {}, index {index}", scene.scenario());
    ChaCha8Rng::from_seed(Sha256::digest(identity).into())
}
