//! Simulated datasets on disk. Each episode is a Parquet file, in a folder whose name is determined by the content.

use super::imported::Content;
use super::{DatasetError, FramePlace, Recording, Samples};
use harness_shared::files::write_bytes;
use harness_shared::progress::{Progress, Silent};
use harness_shared::seal::hex;
use harness_spec::{Definition, Episode, Layout, Scenario, Simulation, World};
use harness_tables::schema::{image_columns, sample_columns};
use harness_tables::{Stamp, TableError, TableFile, write_table};
use polars::prelude::*;
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Version of the recordings. It is raised whenever the same spec would give other recordings than before.
const FORMAT: u32 = 2;

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

/// The compiled model of a world, which determines a dataset's content together with its world and spec.
#[derive(Debug, Clone, Copy)]
pub struct CompiledModel<'a> {
    /// Layout of the samples.
    pub layout: &'a Arc<Layout>,
    /// SHA-256 of the model, in hexadecimal.
    pub sha256: &'a str,
    /// Version of the MuJoCo library.
    pub mujoco_version: &'a str,
}

impl Dataset {
    /// Returns the dataset of a world, its compiled model and a spec, in the folder `root`. Reads and writes nothing.
    pub fn new(root: &Path, world: &World, model: CompiledModel, spec: &Simulation) -> Self {
        let scenario = world.scenario();
        let spec = world.complete(spec);
        let mut description = json!({
            "format": FORMAT,
            "scenario": scenario.name(),
            "simulation": spec,
            "model_sha256": model.sha256,
            "mujoco": model.mujoco_version,
        });
        let factors: serde_json::Map<String, serde_json::Value> =
            world.factors(&spec).map(|(name, factor)| (name.to_owned(), json!(factor))).collect();
        if !factors.is_empty() {
            description["factors"] = factors.into();
        }
        if let Some(world) = world.identity() {
            description["world"] = world;
        }
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
    pub fn len(&self) -> usize {
        self.spec.episodes as usize * self.spec.samples_per_episode()
    }

    /// Whether the dataset has no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
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

    /// Returns the indices of the episodes that are missing or damaged.
    pub fn missing(&self) -> Vec<u32> {
        self.to_make(&Silent)
    }

    /// Returns the indices of the episodes that are missing or damaged, and reports each damaged one.
    pub fn to_make(&self, progress: &dyn Progress) -> Vec<u32> {
        let faults = (0..self.spec.episodes).into_par_iter().filter_map(|index| {
            let fault = self.open(index).err()?;
            Some((index, self.episode_path(index).exists().then_some(fault)))
        });
        let faults: Vec<(u32, Option<DatasetError>)> = faults.collect();
        for fault in faults.iter().filter_map(|(_, fault)| fault.as_ref()) {
            progress.say(&format!("{fault}; the episode is collected again"));
        }
        faults.into_iter().map(|(index, _)| index).collect()
    }

    /// Opens the file of an episode. Fails if it is damaged, or is not this episode of this dataset.
    fn open(&self, index: u32) -> Result<TableFile, DatasetError> {
        open_episode(&self.episode_path(index), &self.name, index, self.spec.samples_per_episode())
    }

    /// Writes the dataset's description to its folder.
    pub fn describe(&self) -> Result<(), DatasetError> {
        let text = format!("{:#}\n", self.description);
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

    /// Reads the whole dataset into memory. The frames are stored where `frames` says.
    ///
    /// # Errors
    /// When an episode is missing or damaged, frames can't be written to disk, or the caller cancels.
    pub fn load(&self, frames: FramePlace, progress: &dyn Progress) -> Result<Samples, DatasetError> {
        let Simulation { sample_rate_hz, seed, .. } = self.spec;
        let recording = Recording { sample_rate_hz, seed };
        let mut samples = Samples::new(recording, self.layout.clone(), self.len(), frames, &self.folder)?;
        let read = |index: u32| self.read(index, frames != FramePlace::Nowhere);
        progress.begin(&format!("loading {}", self.scenario), self.len() as u64, "samples");
        push_all(&mut samples, self.spec.episodes, read, progress)?;
        progress.end();
        Ok(samples)
    }

    /// Reads one episode, with or without its frames. The whole file is compared with its seal in both cases.
    pub fn read(&self, index: u32, frames: bool) -> Result<Episode, DatasetError> {
        let (path, samples) = (self.episode_path(index), self.spec.samples_per_episode());
        read_episode(&path, &self.name, index, samples, frames, &self.layout)
    }
}

/// Returns the name of an episode's file.
pub(super) fn episode_file(index: u32) -> String {
    format!("episode_{index:05}.parquet")
}

/// Appends episodes in order. As many episodes as there are threads are read at the same time, so only these are in
/// memory.
pub(super) fn push_all(
    samples: &mut Samples,
    episodes: u32,
    read: impl Fn(u32) -> Result<Episode, DatasetError> + Sync,
    progress: &dyn Progress,
) -> Result<(), DatasetError> {
    let at_once = rayon::current_num_threads();
    for first in (0..episodes).step_by(at_once) {
        if progress.cancelled() {
            return Err(DatasetError::Cancelled);
        }
        let indices = first..episodes.min(first + at_once as u32);
        let read: Vec<_> = indices.into_par_iter().map(&read).collect();
        for episode in read {
            let episode = episode?;
            samples.push(&episode)?;
            progress.advance(episode.samples as u64);
        }
    }
    Ok(())
}

/// Reads the file of episode `index` of the dataset `dataset`. It must have `samples` samples of this layout.
pub(super) fn read_episode(
    path: &Path,
    dataset: &str,
    index: u32,
    samples: usize,
    frames: bool,
    layout: &Arc<Layout>,
) -> Result<Episode, DatasetError> {
    let damaged = |problem: &str| DatasetError::Damaged { path: path.to_owned(), problem: problem.into() };
    let mut wanted: Vec<String> = layout.stored_vectors().flat_map(Definition::columns).collect();
    if frames {
        wanted.extend(layout.stored_images().map(|image| image.name.name().to_owned()));
    }
    let table = open_episode(path, dataset, index, samples)?.table(Some(wanted))?;
    let mut episode = Episode::new(layout.clone(), index, samples);
    for (place, definition) in layout.modalities.iter().enumerate() {
        if definition.difference_of.is_some() {
            continue;
        }
        if !definition.is_image() {
            let values = interleave(&table, definition).map_err(|_| damaged("a column is missing"))?;
            episode.vectors[place] = values;
        } else if frames {
            let column = table.column(definition.name.name()).and_then(|column| column.binary().cloned());
            for frame in column.map_err(|_| damaged("it has no frames"))?.iter() {
                let frame = frame.filter(|frame| frame.len() == definition.width());
                let frame = frame.ok_or_else(|| damaged("a frame has the wrong size"))?;
                episode.images[place].extend_from_slice(frame);
            }
        }
    }
    Ok(episode)
}

/// Returns a simulated dataset's name: its scenario and the hash of what determines its content.
fn identify(scenario: Scenario, description: &serde_json::Value) -> String {
    let mut identity = description.clone();
    // The number of episodes does not change their contents, so a longer dataset extends a shorter one.
    identity["simulation"]["episodes"].take();
    // The layout follows from the rest of the description.
    if let Some(fields) = identity.as_object_mut() {
        fields.remove("layout");
    }
    named_by_hash(scenario.name(), identity)
}

/// Returns `name` followed by the first digits of the hash of `identity`. The order of keys does not matter.
fn named_by_hash(name: &str, mut identity: serde_json::Value) -> String {
    identity.sort_all_objects();
    let hash = hex(&Sha256::digest(identity.to_string()));
    format!("{name}-{}", &hash[..16])
}

/// The contents of `dataset.json`.
pub(super) struct Description(serde_json::Value);

impl Description {
    pub const FILE: &str = "dataset.json";

    /// Reads the description in a dataset's folder. The error says why it can't be read.
    pub fn read(folder: &Path) -> Result<Self, String> {
        let bytes = std::fs::read(folder.join(Self::FILE)).map_err(|error| error.to_string())?;
        serde_json::from_slice(&bytes).map(Self).map_err(|error| error.to_string())
    }

    /// Whether this version of the program reads and writes the dataset's format.
    pub fn is_current(&self) -> bool {
        self.0["format"] == FORMAT
    }

    /// Returns the scenario and the settings of a simulated dataset; `None` if this does not describe the dataset
    /// `name`. The name is a hash of everything except the number of episodes.
    pub fn simulated(&self, name: &str) -> Option<(Scenario, Simulation)> {
        let scenario = Scenario::new(self.0["scenario"].as_str()?)?;
        let simulation = serde_json::from_value(self.0["simulation"].clone()).ok()?;
        (identify(scenario, &self.0) == name).then_some((scenario, simulation))
    }

    /// Returns the layout of the samples. Descriptions from before layouts existed have the layout of the finger.
    pub fn layout(&self) -> Result<Arc<Layout>, String> {
        match self.0.get("layout") {
            Some(layout) => {
                let layout = Layout::deserialize(layout).map_err(|error| format!("its layout: {error}"))?;
                Ok(Arc::new(layout))
            }
            None => Ok(Layout::finger()),
        }
    }

    /// Returns the description of an imported dataset; `None` if this does not describe the dataset `name`. The name
    /// ends in a hash of the content.
    pub fn imported(&self, name: &str) -> Option<Content> {
        let content = self.0.get("imported")?;
        let identity = json!({ "format": FORMAT, "imported": content });
        let own_name = content["name"].as_str()?;
        let described = self.is_current() && named_by_hash(own_name, identity) == name;
        serde_json::from_value(content.clone()).ok().filter(|_| described)
    }
}

/// Returns the layout of the samples of the dataset in a folder. The dataset can be simulated or imported.
///
/// # Errors
/// When the description can't be read.
pub fn layout_of(folder: &Path) -> Result<Arc<Layout>, DatasetError> {
    let described = || {
        let description = Description::read(folder)?;
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        match description.imported(&name) {
            Some(content) => Ok(content.layout()),
            None => description.layout(),
        }
    };
    described().map_err(|problem| DatasetError::Damaged { path: folder.join(Description::FILE), problem })
}

/// Opens the file of episode `index` of the dataset `dataset`. It must have `samples` samples.
pub(super) fn open_episode(
    path: &Path,
    dataset: &str,
    index: u32,
    samples: usize,
) -> Result<TableFile, DatasetError> {
    let damaged = |problem: String| DatasetError::Damaged { path: path.to_owned(), problem };
    let file = TableFile::open(path).map_err(|error| match error {
        TableError::Read { path, reason } => DatasetError::Damaged { path, problem: reason },
        other => other.into(),
    })?;
    let footer = file.footer()?;
    let says = |key: &str, value: &str| footer.stamp.get(key).is_some_and(|found| found == value);
    if !says("dataset", dataset) || !says("episode", &index.to_string()) {
        return Err(damaged(format!("it is not episode {index} of {dataset}")));
    }
    if footer.rows != samples {
        return Err(damaged(format!("it has {} samples instead of {samples}", footer.rows)));
    }
    Ok(file)
}

/// Joins the columns of a vector, `[samples, elements]`.
fn interleave(table: &DataFrame, definition: &Definition) -> PolarsResult<Vec<f32>> {
    let width = definition.width();
    let mut values = vec![0.0; table.height() * width];
    for (index, name) in definition.columns().enumerate() {
        let column = table.column(&name)?.f32()?;
        for (row, value) in values.chunks_exact_mut(width).zip(column.iter()) {
            row[index] = value.ok_or_else(|| PolarsError::NoData("an empty cell".into()))?;
        }
    }
    Ok(values)
}
