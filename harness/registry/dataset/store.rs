//! Simulated datasets on disk. Each episode is a Parquet file, in a folder whose name is determined by the content.

use super::DatasetError;
use super::description::{Description, FORMAT, MODEL, MODEL_TEXT, identify};
use super::episode_file::{episode_file, open_episode, read_episode};
use super::version::WorldVersion;
use harness_samples::Recording;
use harness_shared::files::write_bytes;
use harness_shared::progress::{Progress, Silent};
use harness_shared::seal::hex;
use harness_spec::{Definition, Episode, Factor, Layout, Property, Scenario, Simulation, World};
use harness_tables::schema::{image_columns, sample_columns};
use harness_tables::{Stamp, TableError, write_table};
use polars::prelude::*;
use rayon::prelude::*;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A simulated dataset on disk.
#[derive(Debug, Clone)]
pub struct Dataset {
    folder: PathBuf,
    name: String,
    scenario: Scenario,
    spec: Simulation,
    layout: Arc<Layout>,
    description: serde_json::Value,
}

/// The compiled model of a world and the files beside it, which determine a dataset's content together with its world
/// and spec.
#[derive(Debug, Clone, Copy)]
pub struct CompiledModel<'a> {
    /// Layout of the samples.
    pub layout: &'a Arc<Layout>,
    /// SHA-256 of the model, in hexadecimal.
    pub sha256: &'a str,
    /// Version of the MuJoCo library.
    pub mujoco_version: &'a str,
    /// SHA-256 of the recorded course that the setpoints follow, in hexadecimal; `None` without one.
    pub course_sha256: Option<&'a str>,
    /// The rules by which the model is simulated and recorded; `None` if they are the first ones.
    pub rule: Option<u32>,
}

impl Dataset {
    /// Returns the dataset of a world, its compiled model and a spec, in the folder `root`. Reads and writes nothing.
    pub fn new(root: &Path, world: &World, model: CompiledModel, spec: &Simulation) -> Self {
        let scenario = world.scenario();
        let spec = world.complete(spec);
        let mut description = json!({
            "format": FORMAT,
            "scenario": scenario.name(),
            "simulation": spec.stored(),
            "model_sha256": model.sha256,
            "mujoco": model.mujoco_version,
        });
        let factors: serde_json::Map<String, serde_json::Value> =
            world.factors(&spec).map(|(name, factor)| (name.to_owned(), json!(factor))).collect();
        if !factors.is_empty() {
            description["factors"] = factors.into();
        }
        // Datasets with these factors were simulated by other rules before.
        let is_of_rule =
            |factor: &Factor| [Property::GeomFriction, Property::GeomSize].contains(&factor.property().0);
        if world.factors(&spec).any(|(_, factor)| is_of_rule(factor)) {
            description["factor_rule"] = json!(2);
        }
        if let Some(rule) = model.rule {
            description["model_rule"] = json!(rule);
        }
        if let Some(course) = model.course_sha256 {
            description["course_sha256"] = json!(course);
        }
        description["world"] = world.identity();
        let (name, layout) = (identify(scenario, &description), model.layout.clone());
        description["layout"] = json!(*layout);
        Self { folder: root.join(&name), name, scenario, spec, layout, description }
    }

    /// Returns the dataset in a folder, with the number of episodes in its description.
    ///
    /// # Errors
    /// When the folder has no description, or its description is of another dataset or has another format.
    pub fn at(folder: &Path) -> Result<Self, DatasetError> {
        let path = folder.join(Description::FILE);
        let damaged = |problem: &str| DatasetError::Damaged { path: path.clone(), problem: problem.into() };
        let description = Description::read(folder).map_err(|problem| damaged(&problem))?;
        if !description.is_current() {
            return Err(damaged("it has another format; collect the dataset again"));
        }
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let (scenario, spec) = description
            .simulated(&name)
            .ok_or_else(|| damaged("it does not describe the dataset of its folder"))?;
        let layout = description.layout().map_err(|problem| damaged(&problem))?;
        Ok(Self { folder: folder.to_owned(), name, scenario, spec, layout, description: description.0 })
    }

    /// Returns the simulated scenario.
    pub fn scenario(&self) -> Scenario {
        self.scenario
    }

    /// Returns the name of the folder: the scenario and the hash of what determines the content.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the dataset's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the number of samples in the whole dataset.
    pub fn samples(&self) -> usize {
        self.spec.episodes as usize * self.spec.samples_per_episode()
    }

    /// The dataset, from which these modalities alone are read.
    pub(super) fn with_modalities_of(&self, layout: &Arc<Layout>) -> Self {
        Self { layout: layout.clone(), ..self.clone() }
    }

    /// Returns the settings of the simulation.
    pub fn spec(&self) -> &Simulation {
        &self.spec
    }

    /// Returns the layout of the samples.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    fn episode_path(&self, index: u32) -> PathBuf {
        self.folder.join(episode_file(index))
    }

    /// Returns the number of episodes that have a file. It may be damaged.
    pub fn files(&self) -> usize {
        (0..self.spec.episodes).filter(|index| self.episode_path(*index).exists()).count()
    }

    /// Returns the indices of the episodes that are missing or damaged.
    pub fn missing(&self) -> Vec<u32> {
        self.to_make(&Silent)
    }

    /// Returns the indices of the episodes that are missing or damaged, and reports each damaged one.
    pub fn to_make(&self, progress: &dyn Progress) -> Vec<u32> {
        let faults = (0..self.spec.episodes).into_par_iter().filter_map(|index| {
            let fault = self.check(index).err()?;
            Some((index, self.episode_path(index).exists().then_some(fault)))
        });
        let faults: Vec<(u32, Option<DatasetError>)> = faults.collect();
        for fault in faults.iter().filter_map(|(_, fault)| fault.as_ref()) {
            progress.say(&format!("{fault}; the episode is collected again"));
        }
        faults.into_iter().map(|(index, _)| index).collect()
    }

    /// Checks the file of an episode. Fails if it is damaged, is not this episode of this dataset, or lacks a column,
    /// because an earlier version of the program recorded less.
    fn check(&self, index: u32) -> Result<(), DatasetError> {
        let path = self.episode_path(index);
        let file = open_episode(&path, &self.name, index, self.spec.samples_per_episode())?;
        let found = file.footer()?.columns;
        let wanted = self.layout.stored_vectors().flat_map(Definition::columns);
        match wanted.into_iter().find(|column| !found.contains(column)) {
            Some(column) => {
                let problem = format!("an earlier version did not record the column {column}");
                Err(DatasetError::Damaged { path, problem })
            }
            None => Ok(()),
        }
    }

    /// Returns the version of the world that the episodes are simulated in.
    pub fn world_version(&self) -> WorldVersion {
        WorldVersion::of(&self.description)
    }

    /// Writes the dataset's description to its folder and, unless it is there undamaged, the compiled model as MJCF,
    /// which `mjcf` returns if it can be written. Only people and `harness diff` read the model.
    pub fn describe(&self, mjcf: impl FnOnce() -> Option<String>) -> Result<(), DatasetError> {
        let mut description = self.description.clone();
        let there = Description::read(&self.folder).ok();
        let there = there.filter(|there| there.fault_of_model(&self.folder).is_none());
        let sha256 = there.map(|there| there.0[MODEL_TEXT].clone()).filter(|sha256| sha256.is_string());
        if let Some(sha256) = sha256 {
            description[MODEL_TEXT] = sha256;
        } else if let Some(mjcf) = mjcf() {
            write_bytes(&self.folder.join(MODEL), mjcf.as_bytes())?;
            description[MODEL_TEXT] = hex(&Sha256::digest(mjcf)).into();
        }
        let text = format!("{description:#}\n");
        Ok(write_bytes(&self.folder.join(Description::FILE), text.as_bytes())?)
    }

    /// Writes one episode to its file.
    pub fn save(&self, episode: &Episode) -> Result<(), DatasetError> {
        let stamp = Stamp::from([
            ("dataset".into(), self.name.clone()),
            ("episode".into(), episode.index.to_string()),
            ("simulation_seed".into(), self.spec.seed.to_string()),
            ("mujoco_version".into(), self.description["mujoco"].as_str().unwrap_or_default().into()),
            ("harness_version".into(), env!("CARGO_PKG_VERSION").into()),
            ("renderer".into(), episode.renderer.clone()),
        ]);
        let columns = [sample_columns(&self.layout), image_columns(&self.layout)].concat();
        let table = self.table(episode).map_err(TableError::from)?;
        Ok(write_table(&self.episode_path(episode.index), table, &columns, &stamp)?)
    }

    /// Removes the files of episodes that are there, and the whole folder if it has no other episodes. The caller must
    /// hold the folder's lock.
    pub fn discard(&self, episodes: &[u32]) -> std::io::Result<()> {
        for path in episodes.iter().map(|index| self.episode_path(*index)).filter(|path| path.exists()) {
            std::fs::remove_file(path)?;
        }
        let is_episode = |entry: &std::fs::DirEntry| entry.path().extension() == Some("parquet".as_ref());
        let has_others =
            std::fs::read_dir(&self.folder)?.any(|entry| entry.is_ok_and(|entry| is_episode(&entry)));
        if has_others { Ok(()) } else { std::fs::remove_dir_all(&self.folder) }
    }

    fn table(&self, episode: &Episode) -> PolarsResult<DataFrame> {
        let samples = episode.samples;
        let times = (0..samples).map(|sample| sample as f64 / self.spec.sample_rate_hz);
        let mut columns: Vec<Column> = vec![
            Column::new_scalar("dataset".into(), Scalar::from(PlSmallStr::from_str(&self.name)), samples),
            Column::new_scalar(
                "scenario".into(),
                Scalar::from(PlSmallStr::from_str(self.scenario.name())),
                samples,
            ),
            Column::new_scalar("episode".into(), Scalar::from(episode.index), samples),
            Column::new("sample".into(), (0..samples as u32).collect::<Vec<_>>()),
            Column::new("time".into(), times.collect::<Vec<_>>()),
        ];
        for definition in self.layout.stored_vectors() {
            let (width, values) = (definition.width(), episode.vector(definition.name));
            for (index, name) in definition.columns().enumerate() {
                let values: Vec<f32> = values.iter().skip(index).step_by(width).copied().collect();
                columns.push(Column::new(name.into(), values));
            }
        }
        for definition in self.layout.stored_images() {
            let pixels = episode.image(definition.name).chunks_exact(definition.width());
            let frames: BinaryChunked = pixels.map(Some).collect();
            columns.push(frames.with_name(definition.name.name().into()).into_series().into());
        }
        DataFrame::new(samples, columns)
    }

    /// Returns the properties that all samples share.
    pub fn recording(&self) -> Recording {
        let Simulation { sample_rate_hz, seed, .. } = self.spec;
        Recording { sample_rate_hz, seed }
    }

    /// Reads one episode, with or without its frames. The whole file is compared with its seal in both cases.
    pub fn read(&self, index: u32, frames: bool) -> Result<Episode, DatasetError> {
        let (path, samples) = (self.episode_path(index), self.spec.samples_per_episode());
        read_episode(&path, &self.name, index, samples, frames, &self.layout)
    }
}
