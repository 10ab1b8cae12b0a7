//! Worlds: a YAML file beside an MJCF model that defines the modalities, the action and the random parts of an episode.

mod file;
mod rules;

pub use file::*;

use super::error::SpecError;
use super::factor::Factor;
use super::hints::HINTS;
use super::kind::FileKind;
use super::origin::Scenario;
use super::simulation::{self, Setting, Simulation};
use super::text::read_text;
use super::values::{ascending, matching};
use crate::layout::{Modality, Region, Scale, Scaling};
use crate::yaml::{Node, Problem, Value, check_against, is_name, list_single, parse, shorten, unknown};
use file::SCHEMA;
use serde_json::Value as Json;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock};

/// A world file that was read, with the places of its values for messages.
#[derive(Debug, Clone)]
pub struct World {
    scenario: Scenario,
    /// Name of the file in messages.
    label: String,
    /// The folder that the model's path is relative to; `None` for a built-in world.
    folder: Option<PathBuf>,
    file: WorldFile,
    tree: Node,
}

/// Worlds with the same name and content are equal, in whatever folder they are.
impl PartialEq for World {
    fn eq(&self, other: &Self) -> bool {
        (self.scenario, &self.file) == (other.scenario, &other.file)
    }
}

/// The place of a world's MJCF.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ModelFile {
    /// The model is part of the program.
    BuiltIn {
        /// Name of the model's file without extension.
        name: &'static str,
        /// Text of the MJCF.
        xml: &'static str,
    },
    /// The model is in the file with this path.
    File(PathBuf),
}

/// What is known about a modality before the model is compiled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Known {
    /// Rows and columns of an image; `None` for a vector.
    pub size: Option<[usize; 2]>,
    pub scaling: Scaling,
}

/// The built-in worlds: name, text of the world file, text of the MJCF.
const BUILT_IN: [(&str, &str, &str); 6] = [
    ("empty", include_str!("../../models/empty.yaml"), include_str!("../../models/empty.xml")),
    ("cluttered", include_str!("../../models/cluttered.yaml"), include_str!("../../models/cluttered.xml")),
    ("crowded", include_str!("../../models/crowded.yaml"), include_str!("../../models/crowded.xml")),
    (
        "crowded_moving",
        include_str!("../../models/crowded_moving.yaml"),
        include_str!("../../models/crowded_moving.xml"),
    ),
    ("wrist", include_str!("../../models/wrist.yaml"), include_str!("../../models/wrist.xml")),
    ("tendon", include_str!("../../models/tendon.yaml"), include_str!("../../models/tendon.xml")),
];

impl World {
    /// Returns the worlds that are part of the program.
    pub fn built_in() -> &'static [Arc<World>] {
        static WORLDS: LazyLock<Vec<Arc<World>>> = LazyLock::new(|| {
            let read = |(name, yaml, _): &(&str, &str, &str)| {
                let label = format!("the built-in models/{name}.yaml");
                Arc::new(World::parse(&label, None, name, yaml).expect("a test reads every built-in world"))
            };
            BUILT_IN.iter().map(read).collect()
        });
        &WORLDS
    }

    /// Returns the built-in world with this name; `None` if there is none.
    pub fn named(name: &str) -> Option<Arc<World>> {
        Self::built_in().iter().find(|world| world.scenario.name() == name).cloned()
    }

    /// Returns the built-in world with this name, or reads the world file with this path.
    ///
    /// # Errors
    /// When neither exists, or the file has a fault.
    pub fn find(name: &str) -> Result<Arc<World>, SpecError> {
        let looks_like_path = name.contains('/') || name.contains('.');
        match Self::named(name) {
            Some(world) => Ok(world),
            None if looks_like_path => Self::load(Path::new(name)),
            None => {
                let names: Vec<&str> = Self::built_in().iter().map(|world| world.scenario.name()).collect();
                let message = unknown("world", name, "", &names, str::to_owned);
                Err(SpecError::NoWorld { message: format!("{message}, or the path of a world file") })
            }
        }
    }

    /// Returns the built-in world of one of the paper's scenarios.
    ///
    /// # Panics
    /// When there is no built-in world with the scenario's name.
    pub fn paper(scenario: Scenario) -> Arc<World> {
        Self::named(scenario.name()).expect("the paper's scenarios are built-in worlds")
    }

    /// Reads a world file. The file's name without extension becomes the scenario.
    ///
    /// # Errors
    /// Returns the first fault of the file, with its line and column.
    pub fn load(path: &Path) -> Result<Arc<World>, SpecError> {
        let label = path.display().to_string();
        let name = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        let unreadable = |message: String| SpecError::Unreadable { path: label.clone(), message };
        let text = read_text(path)?;
        if !is_name(name) {
            return Err(unreadable(format!(
                "a world is named after its file, and can't be named '{}'; use lower-case letters, digits and '_', a \
                 letter first",
                shorten(name)
            )));
        }
        if Self::named(name).is_some() {
            return Err(unreadable(format!(
                "'{name}' is the name of a built-in world; give the file another name"
            )));
        }
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        Self::parse(&label, Some(folder), name, &text).map(Arc::new)
    }

    /// Reads the world file again, as it is now; `None` for a built-in world.
    pub fn read_again(&self) -> Option<Result<Arc<World>, SpecError>> {
        self.folder.as_ref().map(|_| Self::load(Path::new(&self.label)))
    }

    /// Parses the text of a world file. Messages call the file `label`, the path of its model is relative to `folder`,
    /// and `name` becomes the scenario.
    ///
    /// # Errors
    /// Returns the first fault, with its line and column.
    pub fn parse(label: &str, folder: Option<PathBuf>, name: &str, text: &str) -> Result<World, SpecError> {
        let parsed = || -> Result<(WorldFile, Node), Problem> {
            let mut tree = parse(text)?;
            if matches!(tree.value, Value::Null) {
                return Err(Problem::new(
                    &tree.place,
                    "the file is empty; `harness world new MODEL.xml` writes one",
                ));
            }
            FileKind::World.check(&tree)?;
            list_single(&SCHEMA, &mut tree);
            check_against(&SCHEMA, &tree, &HINTS)?;
            let file: WorldFile = serde_json::from_value(tree.to_json())
                .map_err(|error| Problem::new(&tree.place, error.to_string()))?;
            rules::check(&file).map_err(|(path, message)| Problem::new(tree.place_of(&path), message))?;
            Ok((file, tree))
        };
        let (file, tree) = parsed().map_err(|problem| SpecError::of(problem, label))?;
        let scenario = Scenario::new(name).ok_or_else(|| SpecError::Unreadable {
            path: label.to_owned(),
            message: format!("'{}' can't name a world", shorten(name)),
        })?;
        Ok(World { scenario, label: label.to_owned(), folder, file, tree })
    }

    /// Returns the name of the world.
    pub fn scenario(&self) -> Scenario {
        self.scenario
    }

    /// Returns the description of the world, one sentence; empty if the file has none.
    pub fn description(&self) -> &str {
        &self.file.description
    }

    /// Returns the content of the world file.
    pub fn file(&self) -> &WorldFile {
        &self.file
    }

    /// Returns the name of the file in messages.
    pub fn label(&self) -> &str {
        &self.label
    }

    /// Returns the absolute path of the world file, in which links to its folder are resolved; `None` for a built-in
    /// world.
    pub fn path(&self) -> Option<PathBuf> {
        let folder = self.folder.as_ref()?;
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let folder = std::fs::canonicalize(folder).or_else(|_| std::path::absolute(folder)).ok()?;
        Some(folder.join(Path::new(&self.label).file_name()?))
    }

    /// Returns the place of the world's MJCF.
    pub fn model(&self) -> ModelFile {
        let built_in = BUILT_IN.iter().find(|(name, ..)| *name == self.scenario.name());
        match (&self.folder, built_in) {
            (None, Some((name, _, xml))) => ModelFile::BuiltIn { name, xml },
            (folder, _) => ModelFile::File(folder.clone().unwrap_or_default().join(&self.file.model)),
        }
    }

    /// Returns the place of the recorded course that the world's action follows; `None` if its setpoints are random.
    pub fn course(&self) -> Option<PathBuf> {
        self.file.action.course.as_ref().map(|path| self.folder.clone().unwrap_or_default().join(path))
    }

    /// Returns an error that points to the value at a dotted path of the world file.
    pub fn fault(&self, path: &str, message: impl Into<String>) -> SpecError {
        SpecError::of(Problem::new(self.tree.place_of(path), message), &self.label)
    }

    /// Returns the parts of the world file that define the content of its datasets, besides the model and the settings.
    ///
    /// Factors are left out: the settings describe those that a spec turns on, and the others change nothing.
    pub fn identity(&self) -> Json {
        let file = WorldFile { description: String::new(), factors: Ordered::default(), ..self.file.clone() };
        let mut identity = serde_json::to_value(&file).expect("a world file is plain data");
        // Keys are sorted before they are hashed, but the samples depend on the order of these.
        if self.folder.is_some() {
            if !file.placement.is_empty() {
                // Bodies were placed by another rule before, which held for boxes on a floor at z = 0 only.
                identity["placement_rule"] = 2.into();
            }
            let classes = file.modalities.iter().map(|(_, sensing)| sensing.classes.names());
            let classes: Vec<Vec<&str>> = classes.filter(|classes| !classes.is_empty()).collect();
            if !classes.is_empty() {
                identity["classes"] = serde_json::json!(classes);
            }
            identity["order"] = serde_json::json!({
                "actuators": file.action.actuators.names(),
                "placement": file.placement.names(),
                "regions": file.regions.names(),
            });
        }
        identity
    }

    /// Returns the names and definitions of the factors of variation that a spec turns on, in the file's order.
    pub fn factors<'a>(&'a self, spec: &'a Simulation) -> impl Iterator<Item = (&'a str, &'a Factor)> {
        self.file.factors.iter().filter(|(name, _)| spec.factors.iter().any(|on| on == name))
    }

    /// Returns the modalities that a spec can name.
    pub fn modalities(&self) -> impl Iterator<Item = Modality> {
        self.file.modalities.iter().filter_map(|(name, _)| Modality::new(name))
    }

    /// Returns the regions of the world's images.
    pub fn regions(&self) -> Vec<Region> {
        let region = |(name, colors): (&str, &Colors)| Region {
            name: name.to_owned(),
            red_minus_blue: colors.red_minus_blue.map(|bound| bound as f32),
        };
        self.file.regions.iter().map(region).collect()
    }

    /// Returns what is known about a modality while these factors are on.
    pub(super) fn known(&self, modality: Modality, factors: &[String]) -> Option<Known> {
        let sensing = self.sensing(modality)?;
        let size = match sensing.source() {
            Source::DifferenceOf(of) => self.sensing(of)?.size,
            _ => sensing.size,
        };
        Some(Known { size, scaling: self.scaling(modality, factors)? })
    }

    fn sensing(&self, modality: Modality) -> Option<&Sensing> {
        self.file.modalities.iter().find(|(name, _)| *name == modality.name()).map(|(_, sensing)| sensing)
    }

    /// Returns the default scaling of a modality while these factors are on; `None` if the world has no such modality.
    pub fn scaling(&self, modality: Modality, factors: &[String]) -> Option<Scaling> {
        let sensing = self.sensing(modality)?;
        let default = match sensing.source() {
            // Noise can make a recorded force negative.
            Source::NormalForce { .. } => {
                Scaling { scale: Scale::Shared, minimum: (!self.is_noisy(modality, factors)).then_some(0.0) }
            }
            Source::ContactNormal(_) => Scaling::plain(true),
            Source::DifferenceOf(of) => Scaling::plain(self.sensing(of)?.is_image()),
            _ => Scaling::plain(sensing.is_image()),
        };
        Some(Scaling {
            scale: sensing.scale.unwrap_or(default.scale),
            minimum: sensing.minimum.unwrap_or(default.minimum),
        })
    }

    /// Whether one of these factors adds noise to a modality.
    pub fn is_noisy(&self, modality: Modality, factors: &[String]) -> bool {
        self.file.factors.iter().any(|(name, factor)| {
            let is_of = |pattern| matching(std::slice::from_ref(pattern), &[modality.name()]).is_ok();
            factors.iter().any(|on| on == name) && factor.sensor_noise.iter().flatten().any(is_of)
        })
    }

    /// Returns the world's settings that a spec can change under `simulation`, with their default values.
    pub fn settings(&self) -> Vec<(String, Setting)> {
        let ranges = self.file.action.actuators.iter();
        let ranges =
            ranges.map(|(name, actuator)| (range_setting(name, actuator), Setting::Range(actuator.range)));
        let clearances = self.file.placement.iter();
        let clearances =
            clearances.map(|(name, placing)| (clearance_setting(name), Setting::Number(placing.clearance_m)));
        ranges.chain(clearances).collect()
    }

    /// Returns `given` with the world's default for each missing setting, and without the settings and factors that the
    /// world does not have.
    pub fn complete(&self, given: &Simulation) -> Simulation {
        let settings = self.settings().into_iter().map(|(name, own)| {
            let value = given.world.get(&name).copied().unwrap_or(own);
            (name, value)
        });
        let mut factors: Vec<String> = self.factors(given).map(|(name, _)| name.to_owned()).collect();
        factors.sort();
        Simulation { world: settings.collect(), factors, ..given.clone() }
    }

    /// Returns the world's default settings.
    pub fn simulation(&self) -> Simulation {
        self.complete(&Simulation {
            sample_rate_hz: self.file.sample_rate_hz,
            actuation_seconds: self.file.action.seconds,
            ..Simulation::default()
        })
    }

    /// Checks the sample rate and the duration of a move that the file sets, which apply unless a spec sets others.
    ///
    /// # Errors
    /// When a spec that leaves them out can't be run.
    pub fn check_rates(&self) -> Result<(), SpecError> {
        self.check_sample_rate()?;
        let WorldFile { sample_rate_hz: rate, action, .. } = &self.file;
        simulation::actuation(action.seconds, *rate).map_err(|message| self.fault("action.seconds", message))
    }

    /// Checks the sample rate that the file sets.
    pub(super) fn check_sample_rate(&self) -> Result<(), SpecError> {
        let WorldFile { sample_rate_hz: rate, step_rate_hz: steps, .. } = self.file;
        simulation::sample_rate(rate, steps).map_err(|message| {
            let multiple = rate * (steps / rate).round().max(1.0);
            self.fault("sample_rate_hz", format!("{message}, or set step_rate_hz to {multiple}"))
        })
    }

    /// Refuses a value that the world's setting can't have. The error is the message.
    pub(super) fn check_setting(&self, name: &str, value: &Setting) -> Result<(), String> {
        let own = self.settings().into_iter().find(|(own, _)| own == name).map(|(_, own)| own);
        match (own, value) {
            (Some(Setting::Range(_)), Setting::Range(range)) => ascending(*range),
            (Some(Setting::Range(_)), Setting::Number(_)) => {
                Err(format!("'simulation.{name}': expected a list of 2 items, each a finite number"))
            }
            (Some(Setting::Number(_)), Setting::Range(_)) => {
                Err(format!("'simulation.{name}': expected a finite number"))
            }
            _ => Ok(()),
        }
    }
}

/// Refuses a unit that would divide the lines of tables.
pub(super) fn one_line(unit: &str) -> Result<(), &'static str> {
    if unit.chars().any(char::is_control) { Err("a unit has no line breaks or tabs") } else { Ok(()) }
}

/// Returns the name of the setting for the range of an element of the action: `lift_range_m`.
pub fn range_setting(name: &str, actuator: &Actuator) -> String {
    let unit: String = actuator.unit.chars().filter(char::is_ascii_alphanumeric).collect();
    if unit.is_empty() { format!("{name}_range") } else { format!("{name}_range_{}", unit.to_lowercase()) }
}

/// Returns the name of the setting for the smallest distance between placed bodies: `box_clearance_m`.
pub fn clearance_setting(name: &str) -> String {
    format!("{name}_clearance_m")
}
