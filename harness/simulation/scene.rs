//! A scene: the compiled MuJoCo model of a world, with the names of the world file resolved.

use super::course::Course;
use super::load::{compile_error, load_file, load_text, read_model};
use super::names::{CAMERA, called};
use super::plugins::load_plugins;
use super::resolve::{Resolver, within};
use super::resolved::{Area, Driven, Mount, Resolved, SceneCamera, SceneCoded, SceneSight};
use super::standing::GroundModel;
use super::timing::Timing;
use super::{MUJOCO_VERSION, SimulationError, mujoco_version};
use harness_shared::seal::hex;
use harness_spec::{
    Actuator, Element, Layout, Modality, ModelFile, Property, Scenario, Simulation, Start, World,
};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_model::traits::ModelType;
use sha2::{Digest, Sha256};
use std::io::{self, Write};
use std::sync::{Arc, Mutex, Once};

/// The compiled model of a world. All threads that simulate it share it.
#[derive(Debug)]
pub struct Scene {
    /// Where the model came from, for messages.
    pub(super) name: String,
    world: Arc<World>,
    xml: String,
    model_sha256: String,
    /// The recorded course that the setpoints follow, if there is one.
    pub(super) course: Option<Course>,
    pub(super) model: Arc<MjModel>,
    /// What the world file names.
    pub(super) resolved: Resolved,
    /// The ground below the bodies that are placed; `None` if there are none.
    pub(super) ground: Option<GroundModel>,
    /// The positions of the model at rest.
    rest: Vec<f64>,
}

impl Scene {
    /// Compiles a world's model.
    ///
    /// # Errors
    /// When the linked MuJoCo has another version, the model can't be read or compiled, or it lacks an object that the
    /// world file names. In the last case, the error has the line of the world file.
    pub fn new(world: Arc<World>) -> Result<Self, SimulationError> {
        match world.model() {
            ModelFile::BuiltIn { name, xml } => {
                Self::from_xml(world, xml, format!("the built-in models/{name}.xml"))
            }
            ModelFile::File(path) => {
                prepare()?;
                let name = path.display().to_string();
                let unreadable =
                    |problem| world.fault("model", format!("can't read the model {name}: {problem}"));
                let bytes = read_model(&path).map_err(unreadable)?;
                // MuJoCo accepts any bytes in comments.
                let xml = String::from_utf8_lossy(&bytes).into_owned();
                forget_assets();
                let model = load_file(&path)?;
                // The compiled model contains the content of other files.
                let sha256 = match stands_alone(&xml) {
                    true => digest(&bytes),
                    false => digest_of_model(&name, &model)?,
                };
                Self::of_model(world, model, xml, sha256, name)
            }
        }
    }

    /// Returns whether the world file, the model or a file that the model includes has changed since the model was
    /// compiled, so that the datasets would differ. It is false for a built-in world, which has no files.
    pub fn has_changed(&self) -> bool {
        let now = match self.world.read_again() {
            None => return false,
            Some(world) => world.ok().and_then(|world| Self::new(world).ok()),
        };
        let identity = |scene: &Self| {
            let course = scene.course_sha256().map(str::to_owned);
            (scene.world.identity(), scene.world.file().factors.clone(), scene.model_sha256.clone(), course)
        };
        now.is_none_or(|now| identity(&now) != identity(self))
    }

    /// Compiles the built-in world of one of the paper's scenarios.
    ///
    /// # Errors
    /// When the linked MuJoCo has another version.
    pub fn paper(scenario: Scenario) -> Result<Self, SimulationError> {
        Self::new(World::paper(scenario))
    }

    /// Compiles MJCF text for a world. The text must not use other files. Messages call it `name`.
    pub fn from_xml(world: Arc<World>, xml: &str, name: String) -> Result<Self, SimulationError> {
        prepare()?;
        let model = load_text(xml, &name)?;
        Self::of_model(world, model, xml.to_owned(), digest(xml.as_bytes()), name)
    }

    /// Returns the scene of a world, which is kept until the process ends. Calls with the same world return the same
    /// scene as long as neither the world nor its model changes.
    pub fn shared(world: Arc<World>) -> Result<&'static Self, SimulationError> {
        static SCENES: Mutex<Vec<&'static Scene>> = Mutex::new(Vec::new());
        let scene = Self::new(world)?;
        let mut scenes = SCENES.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let known = scenes.iter().find(|known| {
            known.world == scene.world
                && known.model_sha256 == scene.model_sha256
                && known.course_sha256() == scene.course_sha256()
        });
        if let Some(known) = known {
            return Ok(known);
        }
        let scene: &'static Scene = Box::leak(Box::new(scene));
        scenes.push(scene);
        Ok(scene)
    }

    fn of_model(
        world: Arc<World>,
        mut model: MjModel,
        xml: String,
        model_sha256: String,
        name: String,
    ) -> Result<Self, SimulationError> {
        let resolved = Resolver::new(&world, &model).resolve()?;
        // Frames that are larger than the model's offscreen buffer would be refused.
        let of_cameras = resolved.cameras.iter().map(|camera| camera.size);
        for [rows, columns] in of_cameras.chain(resolved.sights.iter().map(|sight| sight.size)) {
            let buffer = &mut model.vis_mut().global;
            buffer.offheight = buffer.offheight.max(rows as i32);
            buffer.offwidth = buffer.offwidth.max(columns as i32);
        }
        let course = Course::of(&world)?;
        let rest = rest_of(&model, resolved.keyframe, &resolved.actuators);
        let ground = (!resolved.placements.is_empty()).then(|| GroundModel::new(&model));
        Ok(Self { name, world, xml, model_sha256, course, model: Arc::new(model), resolved, ground, rest })
    }

    /// Refuses settings that do not suit the model.
    ///
    /// # Errors
    /// When a range exceeds the limits of joints or actuators, a rate does not fit the model's time step, or a recorded
    /// course does not have the samples of the episodes, or would be repeated by a test.
    pub fn check(&self, spec: &Simulation) -> Result<(), SimulationError> {
        let timing = self.timing(spec)?;
        if spec.test && self.course.is_some() {
            let problem = format!("{} follows a recorded course, so its test would repeat it", self.name);
            return Err(SimulationError::Spec { field: "test".into(), problem });
        }
        let check = |course: &Course| course.check(spec, timing.samples, &self.ranges(spec));
        self.course.as_ref().map_or(Ok(()), check)
    }

    /// Returns the time grid of an episode.
    pub(super) fn timing(&self, spec: &Simulation) -> Result<Timing, SimulationError> {
        let ranges = self.ranges(spec);
        for (&[low, high], driven) in ranges.iter().zip(&self.resolved.actuators) {
            if !within([low, high], driven.limits) {
                let [min, max] = driven.limits;
                let name = &self.name;
                let problem =
                    format!("[{low}, {high}] must ascend and lie within [{min}, {max}], as {name} allows");
                return Err(SimulationError::Spec { field: driven.setting.clone(), problem });
            }
        }
        self.check_sectors(&ranges)?;
        Timing::new(spec, self.step_s())
    }

    /// Refuses ranges with which the arm could pull a body that sweeps a sector past the arm's axis.
    fn check_sectors(&self, ranges: &[[f64; 2]]) -> Result<(), SimulationError> {
        for placement in &self.resolved.placements {
            let Area::Sector(Mount { elements: [_, extension], radius, .. }) = &placement.area else {
                continue;
            };
            let [low, high] = ranges[*extension];
            if radius + low < 0.0 {
                let problem = format!(
                    "[{low}, {high}] must be at least {:.3}, so that the swept sector of placement '{}' ends at the \
                     arm's axis",
                    -radius, placement.name
                );
                let field = self.resolved.actuators[*extension].setting.clone();
                return Err(SimulationError::Spec { field, problem });
            }
        }
        Ok(())
    }

    /// Returns the range of each element of the setpoint.
    pub(super) fn ranges(&self, spec: &Simulation) -> Vec<[f64; 2]> {
        let own = self.world.file().action.actuators.iter();
        let range = |(driven, (_, own)): (&Driven, (&str, &Actuator))| {
            spec.range(&driven.setting).unwrap_or(own.range)
        };
        self.resolved.actuators.iter().zip(own).map(range).collect()
    }

    /// Returns the setpoint at the start of every episode: the controls of the keyframe or, without one, what the world
    /// file says.
    pub(super) fn start(&self, spec: &Simulation) -> Vec<f64> {
        if let Some(key) = self.resolved.keyframe {
            let (controls, places) = (self.model.key_ctrl(), self.model.key_mpos());
            let controls = &controls[key * self.model.nu() as usize..];
            let places = &places[key * 3 * self.model.nmocap() as usize..];
            let start = |([low, high], driven): ([f64; 2], &Driven)| {
                let value = match driven.mocap {
                    Some((mocap, axis)) => places[3 * mocap + axis],
                    None => controls[driven.controls[0]],
                };
                value.clamp(low, high)
            };
            return self.ranges(spec).into_iter().zip(&self.resolved.actuators).map(start).collect();
        }
        let actuators = self.world.file().action.actuators.iter();
        let start = |([low, high], (_, actuator)): ([f64; 2], (&str, &Actuator))| match actuator.start {
            Start::Low => low,
            Start::Middle => 0.5 * (low + high),
            Start::High => high,
        };
        self.ranges(spec).into_iter().zip(actuators).map(start).collect()
    }

    /// Returns the world.
    pub fn world(&self) -> &Arc<World> {
        &self.world
    }

    /// Returns the name of the world.
    pub fn scenario(&self) -> Scenario {
        self.world.scenario()
    }

    /// Returns the layout of the samples if no factor of variation is on.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.resolved.layout
    }

    /// Returns the layout of the samples under a spec. If the spec turns on factors, their values are the last
    /// modality.
    pub fn layout_of(&self, spec: &Simulation) -> Arc<Layout> {
        let on = self.resolved.factors.iter().filter(|factor| spec.factors.contains(&factor.name));
        let elements: Vec<Element> = on.flat_map(|factor| factor.elements.clone()).collect();
        if elements.is_empty() {
            return self.layout().clone();
        }
        let mut layout = self.layout().with_factors(elements);
        for definition in &mut layout.modalities {
            let scaling = self.world.scaling(definition.name, &spec.factors);
            definition.minimum = scaling.map_or(definition.minimum, |scaling| scaling.minimum);
            // With noise, there is no telling where there is a direction.
            definition.unit_vectors &= !self.world.is_noisy(definition.name, &spec.factors);
        }
        Arc::new(layout)
    }

    /// Returns for each factor of variation its name, its property, its distribution and the names of its values.
    pub fn factors(&self) -> impl Iterator<Item = (&str, Property, String, Vec<&str>)> {
        self.resolved.factors.iter().map(|factor| {
            let elements = factor.elements.iter().map(|element| element.name.as_str()).collect();
            (factor.name.as_str(), factor.property, factor.drawing.to_string(), elements)
        })
    }

    /// Returns the lowest and the highest value of each factor of variation.
    pub fn factor_ranges(&self) -> impl Iterator<Item = (&str, [f64; 2])> {
        self.resolved.factors.iter().map(|factor| (factor.name.as_str(), factor.drawing.range()))
    }

    /// Returns where the model came from, for messages.
    pub fn source(&self) -> &str {
        &self.name
    }

    /// Returns the MJCF text, without the files that it includes.
    pub fn xml(&self) -> &str {
        &self.xml
    }

    /// Returns the SHA-256 of the MJCF or, if the MJCF uses other files, of the compiled model.
    pub fn model_sha256(&self) -> &str {
        &self.model_sha256
    }

    /// Returns the SHA-256 of the recorded course that the setpoints follow; `None` without one.
    pub fn course_sha256(&self) -> Option<&str> {
        self.course.as_ref().map(Course::sha256)
    }

    /// Describes the recorded course in a few words; `None` without one.
    pub fn course_summary(&self) -> Option<String> {
        self.course.as_ref().map(Course::summary)
    }

    /// Returns the duration of a simulation step, s.
    pub fn step_s(&self) -> f64 {
        self.model.opt().timestep
    }

    /// Returns the generalized positions of the world's keyframe or, without one, of the model's initial state
    /// (`qpos0`). If the action moves mocap bodies, the positions of all mocap bodies follow.
    pub fn rest(&self) -> &[f64] {
        &self.rest
    }

    /// Returns the state of a model at rest: the scene's model or a copy with other values. Mocap bodies have the poses
    /// of the world's keyframe.
    pub(super) fn at_rest(&self, model: Arc<MjModel>) -> MjData<Arc<MjModel>> {
        at_rest(model, self.resolved.keyframe)
    }

    /// Returns the number of bodies that an episode places.
    pub fn boxes(&self) -> usize {
        self.resolved.placements.iter().map(|placement| placement.boxes.len()).sum()
    }

    /// Returns the names of the model's cameras, in the model's order. A camera without a name is called `camera_` and
    /// its number, counted from 0.
    pub fn camera_names(&self) -> Vec<String> {
        let name = |camera| called(&self.model, CAMERA, camera).unwrap_or_else(|| format!("camera_{camera}"));
        (0..self.model.ncam() as usize).map(name).collect()
    }

    /// Returns the modalities whose images are rendered: those of cameras, and then depths and segmentations.
    pub fn rendered(&self) -> impl Iterator<Item = Modality> {
        let coded =
            self.resolved.sights.iter().flat_map(|sight| &sight.coded).map(|coded| coded.image.modality);
        self.resolved.cameras.iter().map(|camera| camera.modality).chain(coded)
    }

    /// Returns all recorded images: of cameras, flows, depths and segmentations.
    pub(super) fn images(&self) -> impl Iterator<Item = SceneCamera> {
        let flows = self.resolved.flows.iter().map(|flow| flow.image);
        let coded = self.resolved.sights.iter().flat_map(|sight| &sight.coded).map(|coded| coded.image);
        self.resolved.cameras.iter().copied().chain(flows).chain(coded)
    }

    /// Returns the depth or segmentation that a modality records, with its camera.
    pub(super) fn coded(&self, modality: &str) -> Option<(&SceneSight, &SceneCoded)> {
        self.resolved.sights.iter().find_map(|sight| {
            let coded = sight.coded.iter().find(|coded| coded.image.modality.name() == modality)?;
            Some((sight, coded))
        })
    }

    /// Returns a geom's name for messages, or that of its body if it has none.
    pub(super) fn geom_name(&self, geom: usize) -> String {
        let name = |kind, id| self.model.id_to_name(kind, id).filter(|name| !name.is_empty());
        let body = self.model.geom_bodyid()[geom] as usize;
        match (name(MjtObjBase::mjOBJ_GEOM, geom), name(MjtObjBase::mjOBJ_BODY, body)) {
            (Some(geom), _) => format!("'{geom}'"),
            (None, Some(body)) => format!("a geom of the body '{body}'"),
            (None, None) => format!("geom {geom}"),
        }
    }

    /// Returns the index of a named object. Messages call its kind `word`.
    pub(super) fn id(
        &self,
        kind: MjtObjBase,
        word: &'static str,
        name: &str,
    ) -> Result<usize, SimulationError> {
        self.model.name_to_id(kind, name).ok_or_else(|| SimulationError::Missing {
            scene: self.name.clone(),
            kind: word,
            name: name.to_owned(),
        })
    }

    /// Returns the compiled model.
    pub fn model(&self) -> &MjModel {
        &self.model
    }
}

/// Clears MuJoCo's cache of meshes and textures. The cache would not notice a file that changed within the same second.
fn forget_assets() {
    // SAFETY: the cache is the library's own, lives as long as the process, and guards itself with a lock.
    unsafe { mujoco_rs::mujoco_c::mj_clearCache(mujoco_rs::mujoco_c::mj_getCache()) };
}

/// Writes the positions that determine where everything is to `state`, which has the length of [`Scene::rest`].
pub(super) fn read_state(data: &MjData<Arc<MjModel>>, state: &mut [f64]) {
    let (qpos, mocap) = state.split_at_mut(data.qpos().len());
    qpos.copy_from_slice(data.qpos());
    for (values, place) in mocap.chunks_exact_mut(3).zip(data.mocap_pos()) {
        values.copy_from_slice(place);
    }
}

/// Sets the positions that [`read_state`] wrote.
pub(super) fn write_state(state: &[f64], data: &mut MjData<Arc<MjModel>>) {
    let (qpos, mocap) = state.split_at(data.qpos().len());
    data.qpos_mut().copy_from_slice(qpos);
    for (place, values) in data.mocap_pos_mut().iter_mut().zip(mocap.chunks_exact(3)) {
        place.copy_from_slice(values);
    }
}

/// Returns the positions in which a model rests: those of a keyframe or of its initial state, followed by the positions
/// of the mocap bodies if the action moves some.
fn rest_of(model: &MjModel, keyframe: Option<usize>, actuators: &[Driven]) -> Vec<f64> {
    let data = at_rest(model, keyframe);
    let moves_mocap = actuators.iter().any(|driven| driven.mocap.is_some());
    let places = data.mocap_pos().iter().flatten().filter(|_| moves_mocap);
    data.qpos().iter().chain(places).copied().collect()
}

/// Returns the state of a keyframe or, without one, a model's initial state.
fn at_rest<M: ModelType>(model: M, keyframe: Option<usize>) -> MjData<M> {
    let mut data = MjData::new(model);
    if let Some(key) = keyframe {
        data.reset_keyframe(key).expect("the keyframe was found in the model");
    }
    data
}

/// Whether MJCF refers to no other file. It refers to them by attributes that begin with `file`, such as `file` and
/// `fileright`. A comment with that word does no harm.
pub(super) fn stands_alone(xml: &str) -> bool {
    !xml.contains("file")
}

pub(super) fn digest(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

fn digest_of_model(name: &str, model: &MjModel) -> Result<String, SimulationError> {
    let mut bytes = vec![0; model.size()];
    model.save_to_buffer(&mut bytes).map_err(|error| compile_error(name, error))?;
    Ok(digest(&bytes))
}

/// Checks the version of MuJoCo, silences its warnings and loads its plugins. It must be called before MuJoCo is used.
pub(super) fn prepare() -> Result<(), SimulationError> {
    require_mujoco_version()?;
    silence_mujoco_warnings();
    load_plugins();
    Ok(())
}

fn require_mujoco_version() -> Result<(), SimulationError> {
    match mujoco_version() {
        MUJOCO_VERSION => Ok(()),
        found => Err(SimulationError::Other(format!(
            "MuJoCo {found} is linked, but this program is built for {MUJOCO_VERSION}: run `make setup`"
        ))),
    }
}

/// Sends MuJoCo's messages nowhere but for fatal ones: warnings are counted in the state and reported as
/// errors, so neither the console nor a `MUJOCO_LOG.TXT` in the working folder needs them.
fn silence_mujoco_warnings() {
    static SILENCED: Once = Once::new();
    // SAFETY: no thread is in MuJoCo: each calls `prepare` before it uses MuJoCo, and `Once` holds back the others.
    SILENCED.call_once(|| unsafe { set_log_handler(print_fatal) });
}

/// MuJoCo ends the process after an error: the reason has no other way out.
fn print_fatal(message: &MjLogMessage) {
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        // The result is ignored: a panic on a full standard error would hide the reason.
        let _ = writeln!(io::stderr(), "MuJoCo stops the program: {}", message.subject());
    }
}
