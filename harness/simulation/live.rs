//! A simulation that its caller steps sample by sample, for control and reinforcement learning.

use super::SimulationError;
use super::camera::{Camera, SceneRenderer};
use super::episode::{record, refuse_policy, with_room};
use super::flow::Flow;
use super::physics::{Physics, sensed_position};
use super::plan::EpisodePlan;
use super::resolved::SceneSight;
use super::scene::Scene;
use super::sight::Sight;
use harness_spec::{Episode, IMAGE_CHANNELS, Modality, Pose, Simulation};
use image::RgbImage;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// A simulation of a scene whose actuators get a setpoint at each sample.
///
/// It senses the same values that a dataset's episode records. If it follows the episode's plan
/// ([`LiveSimulation::follow`]), its samples are bit by bit those of the episode.
pub struct LiveSimulation {
    spec: Simulation,
    physics: Physics<'static>,
    plan: EpisodePlan,
    /// One for each recorded flow of the scene.
    flows: Vec<Flow>,
}

thread_local! {
    /// This thread's cameras. An OpenGL context belongs to the thread that created it, but a simulation can move
    /// between threads.
    static CAMERAS: RefCell<BTreeMap<(usize, Modality), Camera>> = const { RefCell::new(BTreeMap::new()) };
    /// This thread's renderers of depths and segmentations.
    static SIGHTS: RefCell<BTreeMap<View, Sight>> = const { RefCell::new(BTreeMap::new()) };
    /// The renderer that this thread used last, with its scene and size. The next picture most likely has the same.
    static RENDERER: RefCell<Option<(Picture, Box<SceneRenderer<'static>>)>> = const { RefCell::new(None) };
}

/// Identifies what a camera sees: the scene, the camera, and the rows and columns in pixels.
type View = (usize, usize, [usize; 2]);

/// Identifies a renderer: the scene, and the width and height in pixels.
type Picture = (usize, u32, u32);

/// Returns a number that identifies a scene while the process runs.
fn key(scene: &'static Scene) -> usize {
    std::ptr::from_ref(scene).addr()
}

impl LiveSimulation {
    /// Creates a simulation at the start of the spec's first episode.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, the boxes find no place, or the simulation diverges.
    pub fn new(scene: &'static Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        let (physics, plan) = (Physics::new(scene, spec)?, EpisodePlan::draw(scene, spec, 0)?);
        let flows = scene.resolved.flows.iter().map(|flow| Flow::new(scene, *flow)).collect();
        let mut live = Self { spec: spec.clone(), physics, plan, flows };
        live.reset(spec.seed, 0)?;
        Ok(live)
    }

    /// Resets the simulation to the start of an episode: the one with the index `episode` in the dataset with this
    /// seed.
    pub fn reset(&mut self, seed: u64, episode: u32) -> Result<(), SimulationError> {
        self.spec.seed = seed;
        self.plan = EpisodePlan::draw(self.physics.scene, &self.spec, episode)?;
        self.physics.start(&self.plan);
        self.advance_along_plan()
    }

    /// Advances to the next sample while the setpoint moves linearly to `setpoint`. Values outside the spec's ranges
    /// are clipped to them.
    ///
    /// # Errors
    /// When the number of values is not that of the action's elements, a value is not finite, or the simulation
    /// diverges.
    pub fn step(&mut self, setpoint: &[f64]) -> Result<(), SimulationError> {
        let ranges = self.setpoint_ranges();
        if setpoint.len() != ranges.len() || !setpoint.iter().all(|value| value.is_finite()) {
            let (setpoint, expected) = (setpoint.to_vec(), ranges.len());
            return Err(SimulationError::Setpoint { index: 0, setpoint, expected });
        }
        let to: Vec<f64> =
            setpoint.iter().zip(&ranges).map(|(value, [low, high])| value.clamp(*low, *high)).collect();
        let from = self.physics.instant.setpoint.clone();
        let (steps, sampled) = (self.physics.timing.steps_per_sample, self.physics.step() - 1);
        self.physics.advance(|step, setpoint| match step - sampled {
            done if done == steps => setpoint.copy_from_slice(&to),
            done => {
                for (value, (from, to)) in setpoint.iter_mut().zip(from.iter().zip(&to)) {
                    *value = from + done as f64 / steps as f64 * (to - from);
                }
            }
        })
    }

    /// Advances to the next sample along the plan of the episode.
    ///
    /// # Errors
    /// When a policy gives the setpoints, or the simulation diverges.
    pub fn follow(&mut self) -> Result<(), SimulationError> {
        refuse_policy(&self.spec)?;
        self.advance_along_plan()
    }

    fn advance_along_plan(&mut self) -> Result<(), SimulationError> {
        self.physics.follow(&self.plan)
    }

    /// Returns the settings of the simulation. The seed is that of the last reset.
    pub fn spec(&self) -> &Simulation {
        &self.spec
    }

    /// Returns the scene that is simulated.
    pub fn scene(&self) -> &'static Scene {
        self.physics.scene
    }

    /// Returns the setpoint at this sample, one value for each element of the action.
    pub fn setpoint(&self) -> &[f64] {
        &self.physics.instant.setpoint
    }

    /// Returns the range of each element of the setpoint.
    pub fn setpoint_ranges(&self) -> Vec<[f64; 2]> {
        self.physics.scene.ranges(&self.spec)
    }

    /// Returns the values of a vector at this sample; `None` if the scene does not sense a vector with this name.
    pub fn vector(&self, modality: Modality) -> Option<Vec<f32>> {
        let scene = self.physics.scene;
        let position = sensed_position(scene.layout(), modality)?;
        Some(self.physics.instant.vector(scene, position).collect())
    }

    /// Returns the position of the fingertip in the world, m: the end of the axis of the last link whose contacts are
    /// sensed. It is `None` if there is no such link.
    pub fn fingertip(&self) -> Option<[f64; 3]> {
        let tip = self.physics.scene.resolved.tip?;
        let data = self.physics.derived();
        let (joint, middle) = (data.xpos()[tip.body], data.geom_xpos()[tip.geom]);
        Some(std::array::from_fn(|axis| 2.0 * middle[axis] - joint[axis]))
    }

    /// Returns the pose of each box in the world.
    pub fn boxes(&self) -> impl Iterator<Item = Pose> {
        let qpos = &self.physics.instant.state;
        let boxes = self.physics.scene.resolved.placements.iter().flat_map(|placement| &placement.boxes);
        boxes.map(|body| std::array::from_fn(|axis| qpos[body.qpos + axis]))
    }

    /// Writes an image at this sample to `frame`, top row first, `[rows, columns, 3]`: the colors that a camera sees,
    /// its optical flow, its depth or its segmentation.
    ///
    /// # Errors
    /// When no camera is recorded for this modality, or there is no OpenGL to render with.
    pub fn image(&mut self, modality: Modality, frame: &mut [u8]) -> Result<(), SimulationError> {
        let scene = self.physics.scene;
        if let Some(place) = scene.resolved.flows.iter().position(|flow| flow.image.modality == modality) {
            frame.copy_from_slice(self.flows[place].render(&self.physics.instant));
            return Ok(());
        }
        if let Some((of, coded)) = scene.coded(modality.name()) {
            return self.with_sight(of, |sight| {
                let mut pixels = Vec::with_capacity(frame.len());
                sight.encode(&coded.code, &mut pixels);
                frame.copy_from_slice(&pixels);
            });
        }
        let recorded = scene.resolved.cameras.iter().find(|camera| camera.modality == modality);
        let recorded = recorded.ok_or_else(|| SimulationError::Missing {
            scene: scene.name.clone(),
            kind: "camera for the modality",
            name: modality.name().to_owned(),
        })?;
        CAMERAS.with_borrow_mut(|cameras| {
            let camera = match cameras.remove(&(key(scene), modality)) {
                Some(camera) => camera,
                None => Camera::recording(scene, recorded)?,
            };
            let camera = cameras.entry((key(scene), modality)).or_insert(camera);
            frame.copy_from_slice(camera.capture(self.physics.sampled().1)?);
            Ok(())
        })
    }

    /// Lets a camera look at this sample, and passes what it saw to `then`.
    fn with_sight(&mut self, of: &SceneSight, then: impl FnOnce(&Sight)) -> Result<(), SimulationError> {
        let scene = self.physics.scene;
        SIGHTS.with_borrow_mut(|sights| {
            let key = (key(scene), of.camera, of.size);
            let sight = match sights.remove(&key) {
                Some(sight) => sight,
                None => Sight::new(scene, of)?,
            };
            let sight = sights.entry(key).or_insert(sight);
            sight.look(self.physics.sampled().1)?;
            then(sight);
            Ok(())
        })
    }

    /// Returns the episode at whose start the simulation is, without samples. [`LiveSimulation::record`] appends them.
    pub fn new_episode(&self) -> Episode {
        let mut episode = with_room(self.physics.scene, &self.spec, &self.plan, self.physics.timing.samples);
        episode.renderer = "none".into();
        episode
    }

    /// Appends the values and images of this sample to an episode.
    ///
    /// # Errors
    /// When there is no OpenGL to render with.
    pub fn record(&mut self, episode: &mut Episode) -> Result<(), SimulationError> {
        let scene = self.physics.scene;
        record(episode, scene, &self.physics.instant);
        for image in scene.images() {
            let pixels = &mut episode.images[image.position];
            let [rows, columns] = image.size;
            let before = pixels.len();
            pixels.resize(before + rows * columns * IMAGE_CHANNELS, 0);
            self.image(image.modality, &mut pixels[before..])?;
        }
        if let Some(camera) = scene.resolved.cameras.first() {
            CAMERAS.with_borrow(|cameras| {
                episode.renderer = cameras[&(key(scene), camera.modality)].renderer_name().to_owned();
            });
        } else if let Some(of) = scene.resolved.sights.first() {
            SIGHTS.with_borrow(|sights| {
                episode.renderer = sights[&(key(scene), of.camera, of.size)].renderer_name().to_owned();
            });
        }
        Ok(())
    }

    /// Renders a picture of this sample for figures and videos. `width` and `height` are in pixels.
    ///
    /// # Errors
    /// When a side is 0 or above 4096 pixels, or there is no OpenGL to render with.
    pub fn render(&self, width: u32, height: u32) -> Result<RgbImage, SimulationError> {
        let scene = self.physics.scene;
        let kind = (key(scene), width, height);
        RENDERER.with_borrow_mut(|kept| {
            let renderer = match kept.take() {
                Some((other, renderer)) if other == kind => renderer,
                _ => Box::new(SceneRenderer::new(scene, width, height)?),
            };
            let renderer = &mut kept.insert((kind, renderer)).1;
            renderer.vary(&self.plan.factors);
            renderer.render(&self.physics.instant.state)
        })
    }
}
