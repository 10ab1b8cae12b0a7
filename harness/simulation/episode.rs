//! Simulates and records episodes, one seeded simulation each.

use super::SimulationError;
use super::camera::Camera;
use super::factors::FactorValues;
use super::flow::Flow;
use super::physics::{Instant, Physics};
use super::plan::EpisodePlan;
use super::scene::Scene;
use super::sight::Sight;
use harness_spec::{Episode, IMAGE_CHANNELS, Modality, Simulation};
use std::ops::ControlFlow;

/// Simulates and renders episodes of one scene, on the thread that created it.
pub struct Simulator<'s> {
    spec: Simulation,
    physics: Physics<'s>,
    /// One for each recorded camera of the scene.
    cameras: Vec<Camera>,
    /// One for each recorded flow of the scene.
    flows: Vec<Flow>,
    /// One for each camera and size of the scene's depths and segmentations.
    sights: Vec<Sight>,
}

impl<'s> Simulator<'s> {
    /// Creates the simulation and the renderers of a scene.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, a policy gives the setpoints, or there is no OpenGL to
    /// render with.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        refuse_policy(spec)?;
        let physics = Physics::new(scene, spec)?;
        let cameras = scene.resolved.cameras.iter().map(|camera| Camera::recording(scene, camera));
        let cameras = cameras.collect::<Result<_, _>>()?;
        let flows = scene.resolved.flows.iter().map(|flow| Flow::new(scene, *flow)).collect();
        let sights =
            scene.resolved.sights.iter().map(|sight| Sight::new(scene, sight)).collect::<Result<_, _>>()?;
        Ok(Self { spec: spec.clone(), physics, cameras, flows, sights })
    }

    /// Simulates the episode with this index. It calls `on_sample` after each sample, which can cancel the episode.
    ///
    /// # Errors
    /// When the boxes find no place, the simulation diverges, rendering fails, or `on_sample` breaks.
    pub fn run(
        &mut self,
        index: u32,
        on_sample: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<Episode, SimulationError> {
        let plan = EpisodePlan::draw(self.physics.scene, &self.spec, index)?;
        let (scene, cameras, flows) = (self.physics.scene, &mut self.cameras, &mut self.flows);
        let sights = &mut self.sights;
        let names = cameras.iter().map(Camera::renderer_name).chain(sights.iter().map(Sight::renderer_name));
        let renderer = names.into_iter().next().unwrap_or("none").to_owned();
        let mut episode = with_room(scene, &self.spec, &plan, self.physics.timing.samples);
        episode.renderer = renderer;
        self.physics.run(&plan, &mut |instant, data| {
            record(&mut episode, scene, instant);
            for (camera, recorded) in cameras.iter_mut().zip(&scene.resolved.cameras) {
                episode.images[recorded.position].extend_from_slice(camera.capture(data)?);
            }
            for (flow, recorded) in flows.iter_mut().zip(&scene.resolved.flows) {
                episode.images[recorded.image.position].extend_from_slice(flow.render(instant));
            }
            for (sight, recorded) in sights.iter_mut().zip(&scene.resolved.sights) {
                sight.look(data)?;
                for coded in &recorded.coded {
                    sight.encode(&coded.code, &mut episode.images[coded.image.position]);
                }
            }
            match on_sample() {
                ControlFlow::Continue(()) => Ok(()),
                ControlFlow::Break(()) => Err(SimulationError::Cancelled { episode: index }),
            }
        })?;
        Ok(episode)
    }
}

/// Simulates an episode without images and returns the model's generalized positions at each sample, `[samples, nq]`.
/// If the action moves mocap bodies, the positions of all mocap bodies follow them, `[samples, nq + 3 nmocap]`.
///
/// # Errors
/// See [`Simulator::run`]. Rendering and cancelling don't apply.
pub fn replay(scene: &Scene, spec: &Simulation, index: u32) -> Result<Vec<Vec<f64>>, SimulationError> {
    refuse_policy(spec)?;
    let mut physics = Physics::new(scene, spec)?;
    let plan = EpisodePlan::draw(scene, spec, index)?;
    let mut states = Vec::with_capacity(physics.timing.samples);
    physics.run(&plan, &mut |instant, _| {
        states.push(instant.state.clone());
        Ok(())
    })?;
    Ok(states)
}

/// Simulates an episode without images that goes through the setpoints of its samples, `[samples, elements]`, with
/// constant speed between two of them, with these factors of variation. It begins as every episode of the scene, with the joints at the first setpoint.
///
/// # Errors
/// When the sample rate, Hz, does not suit the scene, the boxes find no place, or the simulation diverges.
pub fn follow_setpoints(
    scene: &Scene,
    sample_rate_hz: f64,
    index: u32,
    factors: &FactorValues,
    setpoints: &[f64],
) -> Result<Episode, SimulationError> {
    let samples = setpoints.len() / scene.layout().action().len();
    let actuation_seconds = 1.0 / sample_rate_hz;
    let spec = Simulation {
        sample_rate_hz,
        actuation_seconds,
        actuations_per_episode: samples as u32,
        ..scene.world().simulation()
    };
    let plan = EpisodePlan::through(scene, &spec, index, factors.clone(), setpoints)?;
    let mut physics = Physics::new(scene, &spec)?;
    let mut episode = with_room(scene, &spec, &plan, samples);
    physics.start(&plan);
    for _ in 0..samples {
        physics.follow(&plan)?;
        record(&mut episode, scene, &physics.instant);
    }
    Ok(episode)
}

/// Returns an error if a policy gives the setpoints, so that the plan of an episode does not contain them.
///
/// # Errors
/// When the spec names a policy.
pub fn refuse_policy(spec: &Simulation) -> Result<(), SimulationError> {
    match &spec.policy {
        Some(policy) => Err(SimulationError::Other(format!(
            "simulation.policy is {policy}, and only Python can ask a policy for its setpoints: collect its episodes \
             with `harness.collect(SPEC, policy=...)`"
        ))),
        None => Ok(()),
    }
}

/// Creates the episode of a plan, with memory reserved for its samples.
pub(super) fn with_room(scene: &Scene, spec: &Simulation, plan: &EpisodePlan, samples: usize) -> Episode {
    let mut episode = Episode::new(scene.layout_of(spec), plan.episode, samples);
    for (values, readings) in episode.vectors.iter_mut().zip(&scene.resolved.readings) {
        values.reserve_exact(samples * readings.len());
    }
    for image in scene.images() {
        let [rows, columns] = image.size;
        episode.images[image.position].reserve_exact(samples * rows * columns * IMAGE_CHANNELS);
    }
    if let Some(place) = episode.layout.position(Modality::FACTORS) {
        let drawn: Vec<f32> = plan.factors.values().map(|value| value as f32).collect();
        episode.vectors[place] = drawn.repeat(samples);
    }
    episode.boxes = plan.boxes.clone();
    episode
}

/// Appends the vectors of one sample.
pub(super) fn record(episode: &mut Episode, scene: &Scene, instant: &Instant) {
    // The factors of variation have no readings: their values were stored when the episode was created.
    for (position, (values, _)) in episode.vectors.iter_mut().zip(&scene.resolved.readings).enumerate() {
        values.extend(instant.vector(scene, position));
    }
}
