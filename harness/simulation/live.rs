//! One simulation that is stepped from outside, a sample at a time: for control and reinforcement learning.

use super::SimulationError;
use super::camera::{Camera, SceneRenderer};
use super::flow::Flow;
use super::motion::ranges;
use super::physics::{Physics, sensed_position};
use super::plan::EpisodePlan;
use super::scene::Scene;
use harness_spec::Pose;
use harness_spec::{Modality, Simulation};
use image::RgbImage;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// A simulation of a scene whose actuators are told a setpoint at each sample.
///
/// What it senses is what an episode of a dataset records: the plan of an episode's own, followed by
/// [`LiveSimulation::follow`], gives that episode's samples bit by bit.
pub struct LiveSimulation {
    spec: Simulation,
    physics: Physics<'static>,
    plan: EpisodePlan,
    /// One for each of the scene's.
    flows: Vec<Flow>,
}

thread_local! {
    /// This thread's cameras: OpenGL contexts belong to the thread that made them, and simulations go from thread to
    /// thread.
    static CAMERAS: RefCell<BTreeMap<(usize, Modality), Camera>> = const { RefCell::new(BTreeMap::new()) };
    /// The renderer that this thread drew last, with its scenario and size: the next is most likely alike.
    static RENDERER: RefCell<Option<(Picture, Box<SceneRenderer<'static>>)>> = const { RefCell::new(None) };
}

/// What a renderer is made for: the scene, and width and height in pixels.
type Picture = (usize, u32, u32);

/// Tells one scene from others as long as the process lives.
fn key(scene: &'static Scene) -> usize {
    std::ptr::from_ref(scene).addr()
}

impl LiveSimulation {
    /// A simulation at the start of the spec's first episode.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, the boxes find no place, or the simulation diverges.
    pub fn new(scene: &'static Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        let (physics, plan) = (Physics::new(scene, spec)?, EpisodePlan::draw(scene, spec, 0)?);
        let flows = scene.flows.iter().map(|flow| Flow::new(scene, *flow)).collect();
        let mut live = Self { spec: spec.clone(), physics, plan, flows };
        live.reset(spec.seed, 0)?;
        Ok(live)
    }

    /// Goes to the start of the episode of that index in the dataset of that seed.
    ///
    /// # Errors
    /// When the boxes find no place, or the simulation diverges.
    pub fn reset(&mut self, seed: u64, episode: u32) -> Result<(), SimulationError> {
        self.spec.seed = seed;
        self.plan = EpisodePlan::draw(self.physics.scene, &self.spec, episode)?;
        self.physics.start(&self.plan);
        self.follow()
    }

    /// Goes on to the next sample while the setpoint moves evenly to this one. What lies beyond the spec's ranges ends at
    /// their bounds.
    ///
    /// # Errors
    /// When there are not as many values as the action has elements, one is not finite, or the simulation diverges.
    pub fn step(&mut self, setpoint: &[f64]) -> Result<(), SimulationError> {
        let ranges = ranges(self.physics.scene, &self.spec);
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

    /// Goes on to the next sample along the plan of the episode itself.
    ///
    /// # Errors
    /// When the simulation diverges.
    pub fn follow(&mut self) -> Result<(), SimulationError> {
        let plan = &self.plan;
        self.physics.advance(|step, setpoint| plan.setpoint(step, setpoint))
    }

    /// How it is simulated; the seed is that of the latest reset.
    pub fn spec(&self) -> &Simulation {
        &self.spec
    }

    /// The scene that is simulated.
    pub fn scene(&self) -> &'static Scene {
        self.physics.scene
    }

    /// The setpoint at this sample.
    pub fn setpoint(&self) -> &[f64] {
        &self.physics.instant.setpoint
    }

    /// The ranges that setpoints are held to.
    pub fn setpoint_ranges(&self) -> Vec<[f64; 2]> {
        ranges(self.physics.scene, &self.spec)
    }

    /// A vector at the sample; `None` if none of that name is sensed.
    pub fn vector(&self, modality: Modality) -> Option<Vec<f32>> {
        let scene = self.physics.scene;
        let position = sensed_position(scene.layout(), modality)?;
        Some(self.physics.instant.vector(scene, position).collect())
    }

    /// The end of the axis of the last link whose contacts are sensed, in the world, m; `None` without such links.
    pub fn fingertip(&self) -> Option<[f64; 3]> {
        let tip = self.physics.scene.tip?;
        let (joint, middle) = (self.physics.data.xpos()[tip.body], self.physics.data.geom_xpos()[tip.geom]);
        Some(std::array::from_fn(|axis| 2.0 * middle[axis] - joint[axis]))
    }

    /// Where each box is in the world.
    pub fn boxes(&self) -> impl Iterator<Item = Pose> {
        let qpos = &self.physics.instant.qpos;
        let boxes = self.physics.scene.placements.iter().flat_map(|placement| &placement.boxes);
        boxes.map(|body| std::array::from_fn(|axis| qpos[body.qpos + axis]))
    }

    /// A camera's RGB image of the sample, or its flow, top row first, `[rows, columns, 3]`, written to `frame`.
    ///
    /// # Errors
    /// When no camera of that name is recorded, or there is no OpenGL to render with.
    pub fn image(&mut self, modality: Modality, frame: &mut [u8]) -> Result<(), SimulationError> {
        let scene = self.physics.scene;
        if let Some(place) = scene.flows.iter().position(|flow| flow.image.modality == modality) {
            frame.copy_from_slice(self.flows[place].draw(&self.physics.instant));
            return Ok(());
        }
        let recorded = scene.cameras.iter().find(|camera| camera.modality == modality);
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
            frame.copy_from_slice(camera.capture(&mut self.physics.data)?);
            Ok(())
        })
    }

    /// A picture of the sample for people, of any size in pixels.
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
            renderer.render(&self.physics.instant.qpos)
        })
    }
}
