//! Episodes: one seeded simulation each, recorded sample by sample.

use super::SimulationError;
use super::camera::Camera;
use super::course::{Course, Pose};
use super::physics::{Instant, Physics};
use super::scene::Scene;
use crate::spec::{IMAGE_CHANNELS, Layout, Modality, Simulation};
use std::fmt;
use std::ops::ControlFlow;
use std::sync::Arc;

/// What one simulation recorded: `samples` rows an array, row k at k / `sample_rate_hz` seconds.
#[derive(Clone, PartialEq)]
pub struct Episode {
    /// Its index in the dataset.
    pub index: u32,
    /// Rows of each array.
    pub samples: usize,
    /// What it holds.
    pub layout: Arc<Layout>,
    /// For each of the layout's modalities that is a stored vector its values, `[samples, elements]`.
    pub vectors: Vec<Vec<f32>>,
    /// For each of the layout's modalities that is a stored image its RGB pixels, top row first,
    /// `[samples, rows, columns, 3]`.
    pub images: Vec<Vec<u8>>,
    /// Where what is placed at random started: position (m) and orientation (unit quaternion w, x, y, z).
    pub boxes: Vec<Pose>,
    /// The OpenGL renderer that drew the frames.
    pub renderer: String,
}

impl Episode {
    /// One without values.
    pub fn new(layout: Arc<Layout>, index: u32, samples: usize) -> Self {
        let count = layout.modalities.len();
        let (vectors, images) = (vec![Vec::new(); count], vec![Vec::new(); count]);
        Self { index, samples, layout, vectors, images, boxes: Vec::new(), renderer: String::new() }
    }

    /// The values of a vector, `[samples, elements]`; empty where it is none that is stored.
    pub fn vector(&self, modality: Modality) -> &[f32] {
        self.layout.position(modality).map_or(&[], |index| &self.vectors[index])
    }

    /// The pixels of an image, `[samples, rows, columns, 3]`; empty where it is none that is stored, or none was read.
    pub fn image(&self, modality: Modality) -> &[u8] {
        self.layout.position(modality).map_or(&[], |index| &self.images[index])
    }

    /// The same without images.
    pub fn without_images(self) -> Self {
        Self { images: vec![Vec::new(); self.layout.modalities.len()], ..self }
    }
}

/// Simulates and films episodes of one scene, on the thread that made it.
pub struct Simulator<'s> {
    spec: Simulation,
    physics: Physics<'s>,
    /// One for each of the scene's.
    cameras: Vec<Camera>,
}

impl<'s> Simulator<'s> {
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, or there is no OpenGL to render with.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        let physics = Physics::new(scene, spec)?;
        let cameras = scene.cameras.iter().map(|camera| Camera::recording(scene, camera));
        Ok(Self { spec: spec.clone(), physics, cameras: cameras.collect::<Result<_, _>>()? })
    }

    /// Simulates the episode of that index; `on_sample` is called after each sample and may cancel.
    ///
    /// # Errors
    /// When the boxes find no place, the simulation diverges, rendering fails, or `on_sample` breaks.
    pub fn run(
        &mut self,
        index: u32,
        on_sample: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<Episode, SimulationError> {
        let course = Course::draw(self.physics.scene, &self.spec, index)?;
        let (scene, cameras) = (self.physics.scene, &mut self.cameras);
        let renderer = cameras.first().map(|camera| camera.renderer_name().to_owned());
        let mut episode = Episode::of(scene, &course, self.physics.timing.samples);
        episode.renderer = renderer.unwrap_or_else(|| "none".into());
        self.physics.run(&course, &mut |instant, data| {
            episode.record(scene, instant);
            for (camera, recorded) in cameras.iter_mut().zip(&scene.cameras) {
                episode.images[recorded.position].extend_from_slice(camera.capture(data)?);
            }
            match on_sample() {
                ControlFlow::Continue(()) => Ok(()),
                ControlFlow::Break(()) => Err(SimulationError::Cancelled { episode: index }),
            }
        })?;
        Ok(episode)
    }
}

/// Simulates an episode again, without frames: the model's generalised positions at each sample.
///
/// # Errors
/// As [`Simulator::run`], except for rendering and cancelling.
pub fn replay(scene: &Scene, spec: &Simulation, index: u32) -> Result<Vec<Vec<f64>>, SimulationError> {
    let mut physics = Physics::new(scene, spec)?;
    let course = Course::draw(scene, spec, index)?;
    let mut states = Vec::with_capacity(physics.timing.samples);
    physics.run(&course, &mut |instant, _| {
        states.push(instant.qpos.to_vec());
        Ok(())
    })?;
    Ok(states)
}

impl Episode {
    /// Room for the samples of a course.
    fn of(scene: &Scene, course: &Course, samples: usize) -> Self {
        let mut episode = Self::new(scene.layout().clone(), course.episode, samples);
        for (values, readings) in episode.vectors.iter_mut().zip(&scene.readings) {
            values.reserve_exact(samples * readings.len());
        }
        for camera in &scene.cameras {
            let [rows, columns] = camera.size;
            episode.images[camera.position].reserve_exact(samples * rows * columns * IMAGE_CHANNELS);
        }
        episode.boxes = course.boxes.clone();
        episode
    }

    fn record(&mut self, scene: &Scene, instant: &Instant) {
        for (position, values) in self.vectors.iter_mut().enumerate() {
            values.extend(instant.vector(scene, position));
        }
    }
}

/// Names the episode and leaves out its megabytes.
impl fmt::Debug for Episode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut fields = f.debug_struct("Episode");
        fields.field("index", &self.index).field("samples", &self.samples).finish_non_exhaustive()
    }
}
